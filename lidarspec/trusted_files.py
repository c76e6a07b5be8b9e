"""Decide which files are trusted, and read other files safely.

Installed plugins, the user's own settings, and folders that the user has allowed are trusted. All
other files are data: they cannot cause code to run, and a path in such a file must lead to a file
in the same folder or below.
"""

from __future__ import annotations

import os
import re
import stat
from typing import TYPE_CHECKING, Any, Literal

from lidarspec.errors import UsageError, system_errors

if TYPE_CHECKING:
    from pathlib import Path

#: Maximum size of a file in bytes. JSON files may contain frames and be large. The time for reading
#: TOML grows faster than its size.
MAX_BYTES = {"JSON": 1 << 22, "TOML": 1 << 18}
#: Pattern of a TOML key with at least 32 parts, because reading a very long key takes minutes.
_ENDLESS_KEY = re.compile(rb"(?:\.[^.=,\]\n]{0,80}){32}")
#: Name of a settings file.
FILE = "lidarspec.toml"
#: Name of the file with the allowed folders, one in each line, and of the environment variable that
#: allows a folder for a single run.
TRUSTED = "trusted"
VARIABLE = "LIDARSPEC_TRUST"
_WRITABLE_BY_ALL = stat.S_IWOTH


def user_folder() -> Path:
    """Return the folder of the user's own settings."""
    from pathlib import Path

    if os.name == "nt":
        return Path(os.environ.get("APPDATA") or Path.home() / "AppData" / "Roaming") / "lidarspec"
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "lidarspec"


def user_settings_path() -> Path:
    """Return the path of the user's own settings file; the file may be missing."""
    return user_folder() / FILE


def find_distrust(path: Path) -> str:
    """Return the reason why a file cannot be trusted as the user's own; "" if it can.

    The file and its folder must belong to the user, and must not be writable by all users. On
    systems without file owners, all files in the user's folder are the user's own.
    """
    if not hasattr(os, "getuid"):
        home = os.path.expanduser("~")
        if path.resolve().is_relative_to(home):
            return ""
        return f"{path} is not in {home}"
    for checked in (path, path.parent):
        with system_errors(checked):
            status = checked.stat()
        if reason := describe_sharing(status, _WRITABLE_BY_ALL):
            return f"{checked} {reason}"
    return ""


def describe_sharing(status: os.stat_result, others: int) -> str:
    """Return why other users can access a file, such as "belongs to user 0".

    Returns "" if no other user can, and always on Windows.

    Args:
        others: mode bits that the file must not have.
    """
    if os.name == "nt":
        return ""
    if status.st_uid != os.geteuid():
        return f"belongs to user {status.st_uid}"
    mode = stat.S_IMODE(status.st_mode)
    if mode & others:
        return f"is accessible to other users: run chmod {mode & ~others:o}"
    return ""


def is_trusted(folder: Path) -> bool:
    """Return whether the user has allowed a folder."""
    file = user_folder() / TRUSTED
    with system_errors(file):
        if file.is_file():
            allowed = file.read_text(encoding="utf-8").splitlines()
        else:
            allowed = []
    once = os.environ.get(VARIABLE)
    return str(folder.resolve()) in (*allowed, *([os.path.realpath(once)] if once else []))


def trust(folder: str | Path) -> Path:
    """Trust the files of a folder: they may refer to Python files and to any path.

    Returns:
        The absolute path of the folder.

    Raises:
        UsageError: if `folder` is not a folder, or not the user's own.
        SourceError: if the list of allowed folders cannot be written.
    """
    from pathlib import Path

    allowed = Path(folder).resolve()
    if not allowed.is_dir() or len(str(allowed).splitlines()) > 1:
        raise UsageError(f"{folder} is not a folder")
    if reason := find_distrust(allowed / "."):
        raise UsageError(f"other users could run programs as you, because {reason}")
    file = user_folder() / TRUSTED
    if not is_trusted(allowed):
        with system_errors(file):
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with file.open("a", encoding="utf-8") as lines:
                lines.write(f"{allowed}\n")
    return allowed


def resolve_inside(folder: Path, value: object) -> Path:
    """Return the path of a file in a folder or below.

    Args:
        value: the path of the file relative to the folder, from an untrusted source.

    Raises:
        UsageError: if `value` is not the path of a regular file in the folder or below.
    """
    if isinstance(value, str) and "\0" not in value:
        path = folder / value
    else:
        path = folder
    if not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
        raise UsageError(f"{value!r} is not a file in {folder}")
    return path


def read_document(path: Path, kind: Literal["TOML", "JSON"] = "TOML") -> Any:
    """Return the content of a TOML or JSON file.

    Raises:
        UsageError: if the file is invalid or too large.
        SourceError: if the file cannot be read.
    """
    import json  # imported here because finding an installed sensor does not need them
    import tomllib

    parse = json.loads if kind == "JSON" else tomllib.loads
    with system_errors(path), path.open("rb") as file:
        data = file.read(MAX_BYTES[kind] + 1)
    reason: object = f"the file is longer than {MAX_BYTES[kind] >> 10} kB"
    try:
        if len(data) <= MAX_BYTES[kind]:
            if kind == "TOML" and _ENDLESS_KEY.search(data):
                raise ValueError("a key has more than 32 parts")
            return parse(data.decode())
    except RecursionError:
        reason = "the brackets are nested too deeply"
    except UnicodeDecodeError:
        reason = "the file is not UTF-8"
    except ValueError as error:
        reason = error
    raise UsageError(f"{path}: not {kind}: {reason}")
