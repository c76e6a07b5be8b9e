"""``lidarspec.toml``: devices by name, with their source, sensor and mount.

    [device.front]
    source = "serial:///dev/ttyUSB0"
    sensor = "vendor-model"
    mount = {x = 0.2, yaw_deg = 90, inverted = true}
    options = {calibration = "./angles.csv"}

The nearest file in the working directory or above counts, then the one in the user's configuration directory. A name
stands for its device wherever a SOURCE is asked for; ``./front`` is the file of that name.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from lidarspec.errors import UsageError, did_you_mean, system_errors
from lidarspec.plugins import sensor as named_sensor
from lidarspec.points.cloud import Mount
from lidarspec.spec.sensor import Sensor

FILE = "lidarspec.toml"
#: what can be a name: nothing that has a suffix, a scheme or a folder, and no port of a system that calls them by letters.
_NAME = re.compile(r"(?!(?i:com|lpt)\d+$)[A-Za-z][A-Za-z0-9_-]*")
_KEYS = ("source", "sensor", "mount", "options")


@dataclass(frozen=True)
class Named:
    """A device of a settings file.

    Attributes:
        name: how it is called.
        source: a SOURCE.
        sensor: id, alias or path of a module; None where it is to be detected.
        mount: how it is mounted; None where nothing is said.
        options: what the sensor is configured with.
        file: where it stands.
    """

    name: str
    source: str
    sensor: str | None = None
    mount: Mount | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    file: str = ""

    def configured(self) -> Sensor | None:
        """The sensor with its options; None where it is to be detected.

        Raises:
            UsageError: for a sensor that is not installed, or an option that it does not take.
        """
        if self.sensor is None:
            return None
        found = named_sensor(self.sensor)
        return found.configure(**self.options) if self.options else found


def named(source: str | Path) -> Named | None:
    """The device of this name; None for every other SOURCE.

    Raises:
        UsageError: for a mistake in a settings file, with file, table and key, and for a word that is neither a name nor a file.
        SourceError: for a settings file that cannot be read.
    """
    word = str(source)
    if not isinstance(source, str) or not _NAME.fullmatch(word):
        return None
    known = devices()
    if word in known:
        return known[word]
    if known and not Path(word).exists():
        places = sorted({device.file for device in known.values()})
        raise UsageError(f"{word!r} is no file, and no device of {', '.join(places)}{_closest(word, known)}")
    return None


def devices() -> dict[str, Named]:
    """Every device that is named here; the nearest file counts before the user's."""
    found: dict[str, Named] = {}
    for path in files():
        for name, device in read(path).items():
            found.setdefault(name, device)
    return found


def files() -> list[Path]:
    """The settings files that count here, the nearest first."""
    here = Path.cwd()
    near = [folder / FILE for folder in (here, *here.parents)]
    found = [path for path in near if path.is_file()][:1]
    user = user_folder() / FILE
    return found + [user for _ in (1,) if user.is_file() and user not in found]


def user_folder() -> Path:
    """The folder of the user's own settings."""
    if os.name == "nt":
        return Path(os.environ.get("APPDATA") or Path.home() / "AppData" / "Roaming") / "lidarspec"
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "lidarspec"


def read(path: Path) -> dict[str, Named]:
    """The devices of one file.

    Raises:
        UsageError: for a mistake in it, with table and key.
        SourceError: where it cannot be read.
    """
    try:
        with system_errors(path):
            content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not TOML: {error}") from None
    _check_keys(path, "", content, ["device"])
    tables = content.get("device", {})
    if not isinstance(tables, dict) or not all(isinstance(table, dict) for table in tables.values()):
        raise UsageError(f"{path}: devices are tables of their own: [device.front]")
    return {name: _device(path, name, table) for name, table in tables.items()}


def _device(path: Path, name: str, table: Mapping[str, Any]) -> Named:
    place = f"[device.{name}]"
    if not _NAME.fullmatch(name):
        raise UsageError(f"{path}: {place}: a name is a letter, then letters, digits, '-' and '_', and no port such as COM4")
    _check_keys(path, place, table, _KEYS)
    if "source" not in table:
        raise UsageError(f'{path}: {place}: source is missing, such as source = "serial:///dev/ttyUSB0"')
    for key, kind, told in (("source", str, "text"), ("sensor", str, "text"), ("mount", dict, "a table"), ("options", dict, "a table")):
        if key in table and not isinstance(table[key], kind):
            raise UsageError(f"{path}: {place}: {key} is {told}, not {table[key]!r}")
    options = {key: _beside(path, value) for key, value in table.get("options", {}).items()}
    mount = _mount(path, place, table["mount"]) if "mount" in table else None
    sensor = table.get("sensor")
    if options and sensor is None:
        raise UsageError(f"{path}: {place}: options are a sensor's: name the sensor as well")
    source = _beside(path, table["source"])
    if _NAME.fullmatch(source) and not Path(source).exists():
        raise UsageError(f"{path}: {place}: source {source!r} is a name again; a device names its port, address or file")
    return Named(name, source, None if sensor is None else _beside(path, sensor), mount, options, str(path))


def _mount(path: Path, place: str, given: Mapping[str, Any]) -> Mount:
    kinds = {f.name: type(f.default) for f in fields(Mount)}
    _check_keys(path, f"{place} mount", given, kinds)
    for key, value in given.items():
        right = isinstance(value, bool) if kinds[key] is bool else isinstance(value, int | float) and not isinstance(value, bool)
        if not right or value in (float("inf"), float("-inf")) or value != value:
            wanted = "true or false" if kinds[key] is bool else "a number"
            raise UsageError(f"{path}: {place}: mount.{key} is {wanted}, not {value!r}")
    return Mount(**given)


def _check_keys(path: Path, place: str, given: Iterable[str], known: Iterable[str]) -> None:
    for key in given:
        if key not in known:
            raise UsageError(f"{path}: {place + ': ' if place else ''}unknown {'key' if place else 'table'} {key!r}{_closest(key, known)}")


def _closest(word: str, known: Iterable[str]) -> str:
    return did_you_mean(word, known) or f" (known: {', '.join(known)})"


def _beside(path: Path, value: Any) -> Any:
    """A path that begins with a dot as one from the file's folder; everything else as it is."""
    return str(path.parent / value) if isinstance(value, str) and value.startswith(("./", "../")) else value
