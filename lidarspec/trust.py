"""Whose files are believed, and what the others may say.

Plugins that are installed and the user's own settings are believed; so is a folder that the user
has allowed once. Whatever else is read is data: no code runs because a file names it, and paths in
it lead to what lies beside it and nowhere else.
"""

from __future__ import annotations

import os
import re
import stat
from typing import TYPE_CHECKING, Any, Literal

from lidarspec.errors import UsageError, system_errors

if TYPE_CHECKING:
    from pathlib import Path

#: bytes of a file that are read at most: of JSON, which has frames in it, and of TOML, where the
#: time to read grows faster than the file.
LARGEST = {"JSON": 1 << 22, "TOML": 1 << 18}
#: a key of so many parts that reading it would take minutes.
_ENDLESS_KEY = re.compile(rb"(?:\.[^.=,\]\n]{0,80}){32}")
#: the name of a settings file.
FILE = "lidarspec.toml"
#: the file of the folders that are allowed, a line each, and the variable that names one for a
#: single run.
TRUSTED = "trusted"
VARIABLE = "LIDARSPEC_TRUST"
_WRITABLE_BY_ALL = stat.S_IWOTH


def user_folder() -> Path:
    """The folder of the user's own settings."""
    from pathlib import Path

    if os.name == "nt":
        return Path(os.environ.get("APPDATA") or Path.home() / "AppData" / "Roaming") / "lidarspec"
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "lidarspec"


def own_settings() -> Path:
    """The user's own settings file, which need not be there."""
    return user_folder() / FILE


def foreign(path: Path) -> str:
    """Why a file is not the user's own, such as "/tmp belongs to user 0"; "" where it is.

    It and its folder have to belong to the user, and nobody else may write there; a group may,
    which is often the user's alone. Where a system has no such owners, the user's own is what lies
    in the user's folder.
    """
    if not hasattr(os, "getuid"):
        home = os.path.expanduser("~")
        if path.resolve().is_relative_to(home):
            return ""
        return f"{path} is not in {home}"
    for place in (path, path.parent):
        with system_errors(place):
            status = place.stat()
        if reason := describe_sharing(status, _WRITABLE_BY_ALL):
            return f"{place} {reason}"
    return ""


def describe_sharing(status: os.stat_result, others: int) -> str:
    """Why something is not the user's own, such as "belongs to user 0"; "" where it is, and on
    Windows, where a user's folders are.

    Args:
        others: the bits of its mode that only its user may have.
    """
    if os.name == "nt":
        return ""
    if status.st_uid != os.geteuid():
        return f"belongs to user {status.st_uid}"
    mode = stat.S_IMODE(status.st_mode)
    if mode & others:
        return f"is open to others: chmod {mode & ~others:o} makes it yours"
    return ""


def is_trusted(folder: Path) -> bool:
    """Whether the user has allowed what the files of a folder name."""
    file = user_folder() / TRUSTED
    with system_errors(file):
        if file.is_file():
            allowed = file.read_text(encoding="utf-8").splitlines()
        else:
            allowed = []
    once = os.environ.get(VARIABLE)
    return str(folder.resolve()) in (*allowed, *([os.path.realpath(once)] if once else []))


def trust(folder: str | Path) -> Path:
    """The folder, by its whole path, whose files may from now on name Python files, and paths
    anywhere.

    Raises:
        UsageError: where it is no folder of the user's own.
        SourceError: where this cannot be written down.
    """
    from pathlib import Path

    found = Path(folder).resolve()
    if not found.is_dir() or len(str(found).splitlines()) > 1:
        raise UsageError(f"{folder} is no folder")
    if reason := foreign(found / "."):
        raise UsageError(f"{reason}; whoever writes there could run programs as you")
    file = user_folder() / TRUSTED
    if not is_trusted(found):
        with system_errors(file):
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with file.open("a", encoding="utf-8") as lines:
                lines.write(f"{found}\n")
    return found


def beside(folder: Path, value: object) -> Path:
    """The file that a file in `folder` names: one in it or below it.

    Raises:
        UsageError: for any other path, and for what is no path or no regular file.
    """
    if isinstance(value, str) and "\0" not in value:
        found = folder / value
    else:
        found = folder
    if not found.is_file() or not found.resolve().is_relative_to(folder.resolve()):
        raise UsageError(f"{value!r} is no file beside it")
    return found


def document(path: Path, kind: Literal["TOML", "JSON"] = "TOML") -> Any:
    """What a TOML or JSON file holds.

    Raises:
        UsageError: where it is none, or none of a reasonable size.
        SourceError: where it cannot be read.
    """
    import json  # where only an installed sensor is looked for, nobody waits for these
    import tomllib

    parse = json.loads if kind == "JSON" else tomllib.loads
    with system_errors(path), path.open("rb") as file:
        data = file.read(LARGEST[kind] + 1)
    reason: object = f"it is longer than {LARGEST[kind] >> 10} kB"
    try:
        if len(data) <= LARGEST[kind]:
            if kind == "TOML" and _ENDLESS_KEY.search(data):
                raise ValueError("a key has more than 32 parts")
            return parse(data.decode())
    except RecursionError:
        reason = "its brackets are nested too deeply"
    except UnicodeDecodeError:
        reason = "it is no text in UTF-8"
    except ValueError as error:
        reason = error
    raise UsageError(f"{path}: not {kind}: {reason}")
