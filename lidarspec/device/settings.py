"""``lidarspec.toml``: devices by name, with their source, sensor and mount.

    [device.front]
    source = "serial:///dev/ttyUSB0"
    sensor = "vendor-model"
    mount = {x = 0.2, yaw_deg = 90, inverted = true}
    options = {calibration = "./angles.csv"}

A name can be used as any SOURCE; ``./front`` is the file of that name. The file in the user's
configuration directory is read first, and then the nearest one of the user in the working directory
or above it, which adds names but replaces none. A project may be untrusted, so its file runs no
Python and refers to no path outside its folder, unless the user has allowed that folder. A mistake
in a file disables the devices of that file only.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from reprlib import repr as shown
from shlex import quote
from typing import Any

from lidarspec.errors import LidarSpecError, UsageError, did_you_mean, suggest
from lidarspec.plugins import names_file, sensor as named_sensor
from lidarspec.points.mount import Mount
from lidarspec.remote_files import is_stored
from lidarspec.sensor_operations import Sensor
from lidarspec.trusted_files import (
    FILE,
    find_distrust,
    is_trusted,
    own_settings,
    read_document,
    resolve_beside,
)

#: a valid name: no suffix, scheme or folder, and not the name of a port on Windows.
_NAME = re.compile(r"(?!(?i:com|lpt)\d+$)[A-Za-z][A-Za-z0-9_-]*")
_KEYS = ("source", "sensor", "mount", "options")


@dataclass(frozen=True)
class NamedDevice:
    """A device of a settings file.

    Attributes:
        name: its name.
        source: a SOURCE.
        sensor: id, alias or path of a module; None to detect it.
        mount: its pose; None if not given.
        options: options of the sensor.
        file: the settings file.
        hidden: another file with a device of this name, which is not used.
        is_trusted: whether the file is trusted: the user's own, or in a folder that the user has
            allowed.
    """

    name: str
    source: str
    sensor: str | None = None
    mount: Mount | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    file: str = ""
    hidden: str = ""
    is_trusted: bool = True

    def configure(self) -> Sensor | None:
        """Return the sensor with its options, None if it has to be detected.

        Raises:
            UsageError: for a sensor that is not installed, or an invalid option.
        """
        if self.sensor is None:
            return None
        sensor = named_sensor(self.sensor)
        if not self.options:
            return sensor
        place = f"{self.file}: [device.{self.name}]"
        try:
            if self.is_trusted:
                options = self.options
            else:
                options = sensor.configure.options_of_file(self.options, Path(self.file).parent)
        except UsageError as error:
            raise self._suggest_trust(UsageError(f"{place}: {error}")) from None
        try:
            configured: Sensor = sensor.configure(**options)
        except UsageError as error:
            raise UsageError(f"{place}: {error}") from None
        return configured

    def refusal(self) -> UsageError | None:
        """Return the reason why an untrusted file cannot have this device, else None."""
        if self.is_trusted:
            return None
        folder = Path(self.file).parent
        file = self.source.partition("?")[0]
        reason = ""
        if self.sensor is not None and names_file(self.sensor):
            reason = f"sensor {self.sensor!r} is Python, which would run"
        elif is_stored(self.source):
            reason = (
                f"source {self.source!r} is a URL, which would be contacted or lead outside"
                f" {folder}"
            )
        elif os.path.isfile(file):
            try:
                resolve_beside(folder, os.path.abspath(file))
            except UsageError:
                reason = f"source {self.source!r} is a file outside {folder}"
        error = UsageError(
            f"{self.file}: [device.{self.name}]: {reason}: that takes a folder that you have"
            " allowed"
        )
        if reason:
            return self._suggest_trust(error)
        return None

    def _suggest_trust(self, error: UsageError) -> UsageError:
        """Return the error with the command that allows the folder of the file."""
        return suggest(error, f"lidarspec trust {quote(str(Path(self.file).parent))}")


def find_device(source: str | Path) -> NamedDevice | None:
    """Return the device with this name, None for every other SOURCE.

    Raises:
        UsageError: for a mistake in the device's file, with table and key; for a device that is
            only allowed in a trusted folder; and for a word that is neither a name nor a file.
        SourceError: for a settings file that cannot be read.
    """
    word = str(source)
    if not isinstance(source, str) or not _NAME.fullmatch(word):
        return None
    by_name, faults = _read_all()
    if word not in by_name and not os.path.exists(word):
        if faults:
            raise faults[0]
        if by_name:
            places = sorted({device.file for device in by_name.values()})
            closest = _closest(word, by_name)
            raise UsageError(f"{word!r} is no file, and no device of {', '.join(places)}{closest}")
    for fault in faults:
        warnings.warn(f"{fault}; its devices are left out", stacklevel=2)
    device = by_name.get(word)
    if device is None:
        return None
    if refused := device.refusal():
        raise refused
    if device.hidden:
        warnings.warn(
            f"{word}: the device of {device.file}, not that of {device.hidden}", stacklevel=2
        )
    return device


def devices() -> dict[str, NamedDevice]:
    """Return all devices of files without a mistake, the user's own first."""
    return _read_all()[0]


def _read_all() -> tuple[dict[str, NamedDevice], list[LidarSpecError]]:
    """Return all devices, and the errors of files that could not be read."""
    by_name: dict[str, NamedDevice] = {}
    faults = []
    for path in files():
        try:
            devices = read(path)
        except LidarSpecError as fault:
            faults.append(fault)
            continue
        for name, device in devices.items():
            by_name[name] = (
                replace(by_name[name], hidden=device.file) if name in by_name else device
            )
    return by_name, faults


def files() -> list[Path]:
    """Return the settings files that apply here.

    They are the user's own and the nearest one of a project. Files of other users are skipped with
    a warning.
    """
    own = own_settings()
    here = Path.cwd()
    paths = [own] if os.path.isfile(own) else []
    for path in (folder / FILE for folder in (here, *here.parents)):
        if path == own or not os.path.isfile(path):
            continue
        if not (reason := find_distrust(path)):
            return [*paths, path]
        warnings.warn(f"{path} is not read: {reason}", stacklevel=2)
    return paths


def read(path: Path) -> dict[str, NamedDevice]:
    """Return the devices of one file.

    Raises:
        UsageError: for a mistake in it, with table and key.
        SourceError: if it cannot be read.
    """
    content = read_document(path)
    is_own = path == own_settings()
    if "owners" in content and not is_own:
        raise UsageError(f"{path}: [owners] stands in your own settings alone, {own_settings()}")
    _check_keys(path, "", content, ["device", "owners"])
    tables = content.get("device", {})
    if not isinstance(tables, dict) or not all(
        isinstance(table, dict) for table in tables.values()
    ):
        raise UsageError(f"{path}: devices are tables of their own: [device.front]")
    is_trusted_file = is_own or is_trusted(path.parent)
    return {
        name: replace(_device(path, name, table), is_trusted=is_trusted_file)
        for name, table in tables.items()
    }


def _device(path: Path, name: str, table: Mapping[str, Any]) -> NamedDevice:
    place = f"[device.{name}]"
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{path}: {place}: a name is a letter, then letters, digits, '-' and '_', and no port"
            " such as COM4"
        )
    _check_keys(path, place, table, _KEYS)
    if "source" not in table:
        raise UsageError(
            f'{path}: {place}: source is missing, such as source = "serial:///dev/ttyUSB0"'
        )
    for key, kind, expected in (
        ("source", str, "text"),
        ("sensor", str, "text"),
        ("mount", dict, "a table"),
        ("options", dict, "a table"),
    ):
        if key in table and not isinstance(table[key], kind):
            raise UsageError(f"{path}: {place}: {key} is {expected}, not {shown(table[key])}")
    options = {key: _resolve_path(path, value) for key, value in table.get("options", {}).items()}
    if "mount" in table:
        mount = _mount(path, place, table["mount"])
    else:
        mount = None
    sensor = table.get("sensor")
    if options and sensor is None:
        raise UsageError(f"{path}: {place}: options are a sensor's: name the sensor as well")
    source = _resolve_path(path, table["source"])
    if _NAME.fullmatch(source) and not os.path.exists(source):
        raise UsageError(
            f"{path}: {place}: source {source!r} is a name again; a device names its port, address"
            " or file"
        )
    return NamedDevice(
        name,
        source,
        None if sensor is None else _resolve_path(path, sensor),
        mount,
        options,
        str(path),
    )


def _mount(path: Path, place: str, table: Mapping[str, Any]) -> Mount:
    kinds = {f.name: type(f.default) for f in fields(Mount)}
    _check_keys(path, f"{place} mount", table, kinds)
    for key, value in table.items():
        if kinds[key] is bool:
            right = isinstance(value, bool)
        else:
            right = isinstance(value, int | float) and not isinstance(value, bool)
        if not right or value in (float("inf"), float("-inf")) or value != value:
            if kinds[key] is bool:
                wanted = "true or false"
            else:
                wanted = "a number"
            raise UsageError(f"{path}: {place}: mount.{key} is {wanted}, not {shown(value)}")
    return Mount(**table)


def _check_keys(path: Path, place: str, keys: Iterable[str], allowed: Iterable[str]) -> None:
    for key in keys:
        if key not in allowed:
            raise UsageError(
                f"{path}: {place + ': ' if place else ''}unknown {'key' if place else 'table'}"
                f" {key!r}{_closest(key, allowed)}"
            )


def _closest(word: str, words: Iterable[str]) -> str:
    return did_you_mean(word, words) or f" (known: {', '.join(words)})"


def _resolve_path(path: Path, value: Any) -> Any:
    """Return a path that begins with a dot relative to the file's folder.

    Other values are unchanged.
    """
    if isinstance(value, str) and value.startswith(("./", "../")):
        return str(path.parent / value)
    return value
