"""``lidarspec.toml``: devices by name, with their source, sensor and mount.

    [device.front]
    source = "serial:///dev/ttyUSB0"
    sensor = "vendor-model"
    mount = {x = 0.2, yaw_deg = 90, inverted = true}
    options = {calibration = "./angles.csv"}

A name can be given instead of a SOURCE. To read a file called front, give ``./front``.

Two settings files are read: the file in the user's configuration directory, and the nearest file
that the user owns in the working directory or above it (the project's file).

A project may be untrusted. Its file cannot replace devices of the user's file. It can run Python or
refer to paths outside the folder only if the user has allowed the folder. A mistake in a file
disables only the devices of that file.
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
from lidarspec.plugins import is_file_name, sensor as named_sensor
from lidarspec.points.mount import Mount
from lidarspec.remote_files import is_remote
from lidarspec.sensor_operations import Sensor
from lidarspec.trusted_files import (
    FILE,
    find_distrust,
    is_trusted,
    read_document,
    resolve_inside,
    user_settings_path,
)

#: pattern of a valid name. Such a name cannot be mistaken for a file, a URL, or a port on Windows.
_NAME = re.compile(r"(?!(?i:com|lpt)\d+$)[A-Za-z][A-Za-z0-9_-]*")
_KEYS = ("source", "sensor", "mount", "options")


@dataclass(frozen=True)
class NamedDevice:
    """A device of a settings file.

    Attributes:
        sensor: id, alias or path of a module; None to detect the sensor.
        mount: the pose of the sensor; None if not given.
        shadowed_file: another settings file with a device of the same name, which is ignored; "" if
            there is none.
        is_trusted: whether the settings file is the user's own, or in an allowed folder.
    """

    name: str
    source: str
    sensor: str | None = None
    mount: Mount | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    file: str = ""
    shadowed_file: str = ""
    is_trusted: bool = True

    def configure(self) -> Sensor | None:
        """Return the sensor with its options; None if it has to be detected.

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
                options = sensor.configure.check_untrusted_options(
                    self.options, Path(self.file).parent
                )
        except UsageError as error:
            raise self._suggest_trust(UsageError(f"{place}: {error}")) from None
        try:
            configured: Sensor = sensor.configure(**options)
        except UsageError as error:
            raise UsageError(f"{place}: {error}") from None
        return configured

    def find_refusal(self) -> UsageError | None:
        """Return an error if the device is not allowed; None if it is allowed.

        Some devices, for example with a sensor in a Python file, are allowed only in a trusted
        file.
        """
        if self.is_trusted:
            return None
        folder = Path(self.file).parent
        file = self.source.partition("?")[0]
        reason = ""
        if self.sensor is not None and is_file_name(self.sensor):
            reason = f"sensor {self.sensor!r} is a Python file, which would be executed"
        elif is_remote(self.source):
            reason = (
                f"source {self.source!r} is a URL: it could name any host, or a file outside"
                f" {folder}"
            )
        elif os.path.isfile(file):
            try:
                resolve_inside(folder, os.path.abspath(file))
            except UsageError:
                reason = f"source {self.source!r} is a file outside {folder}"
        if not reason:
            return None
        return self._suggest_trust(
            UsageError(
                f"{self.file}: [device.{self.name}]: {reason}; this is allowed only in a trusted"
                " folder"
            )
        )

    def _suggest_trust(self, error: UsageError) -> UsageError:
        """Return the error with the command that allows the folder of the file."""
        return suggest(error, f"lidarspec trust {quote(str(Path(self.file).parent))}")


def find_device(source: str | Path) -> NamedDevice | None:
    """Return the device with the name `source`; None for any other SOURCE.

    Raises:
        UsageError: if the settings file has a mistake, or if the device is not allowed; or if
            devices are declared, but `source` is a plain word (not a URL or path) that names
            neither a device nor a file.
        SourceError: if the settings file cannot be read.
    """
    word = str(source)
    if not isinstance(source, str) or not _NAME.fullmatch(word):
        return None
    by_name, errors = _read_all()
    if word not in by_name and not os.path.exists(word):
        if errors:
            raise errors[0]
        if by_name:
            paths = sorted({device.file for device in by_name.values()})
            suggestion = _make_suggestion(word, by_name)
            raise UsageError(
                f"{word!r} is neither a file nor a device of {', '.join(paths)}{suggestion}"
            )
    for error in errors:
        warnings.warn(f"{error}; its devices are ignored", stacklevel=2)
    device = by_name.get(word)
    if device is None:
        return None
    if refusal := device.find_refusal():
        raise refusal
    if device.shadowed_file:
        warnings.warn(
            f"{word}: using the device that {device.file} defines, and ignoring the one in"
            f" {device.shadowed_file}",
            stacklevel=2,
        )
    return device


def read_devices() -> dict[str, NamedDevice]:
    """Return the devices of all valid settings files by name, the user's file first."""
    return _read_all()[0]


def _read_all() -> tuple[dict[str, NamedDevice], list[LidarSpecError]]:
    """Return all devices by name, and the errors of invalid files."""
    by_name: dict[str, NamedDevice] = {}
    errors = []
    for path in find_settings_files():
        try:
            devices = read_settings_file(path)
        except LidarSpecError as error:
            errors.append(error)
            continue
        for name, device in devices.items():
            if name in by_name:
                by_name[name] = replace(by_name[name], shadowed_file=device.file)
            else:
                by_name[name] = device
    return by_name, errors


def find_settings_files() -> list[Path]:
    """Return the settings files that apply in the working directory.

    Files of other users are skipped with a warning.
    """
    own = user_settings_path()
    here = Path.cwd()
    paths = [own] if os.path.isfile(own) else []
    for path in (folder / FILE for folder in (here, *here.parents)):
        if path == own or not os.path.isfile(path):
            continue
        if not (reason := find_distrust(path)):
            return [*paths, path]
        warnings.warn(f"cannot read {path}: {reason}", stacklevel=2)
    return paths


def read_settings_file(path: Path) -> dict[str, NamedDevice]:
    """Return the devices of one settings file by name.

    Raises:
        UsageError: for a mistake in the file.
        SourceError: if the file cannot be read.
    """
    content = read_document(path)
    is_own = path == user_settings_path()
    if "owners" in content and not is_own:
        raise UsageError(
            f"{path}: [owners] is only allowed in your own settings, {user_settings_path()}"
        )
    _check_keys(path, "", content, ["device", "owners"])
    tables = content.get("device", {})
    if not isinstance(tables, dict) or not all(
        isinstance(table, dict) for table in tables.values()
    ):
        raise UsageError(f"{path}: write each device as a table of its own, such as [device.front]")
    is_trusted_file = is_own or is_trusted(path.parent)
    return {
        name: replace(_make_device(path, name, table), is_trusted=is_trusted_file)
        for name, table in tables.items()
    }


def _make_device(path: Path, name: str, table: Mapping[str, Any]) -> NamedDevice:
    place = f"[device.{name}]"
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{path}: {place}: invalid name: expected a letter followed by letters, digits, '-' or"
            " '_'; the name of a port, such as COM4, is not allowed"
        )
    _check_keys(path, place, table, _KEYS)
    if "source" not in table:
        raise UsageError(
            f"{path}: {place}: source is missing: expected for example source ="
            ' "serial:///dev/ttyUSB0"'
        )
    for key, kind, expected in (
        ("source", str, "text"),
        ("sensor", str, "text"),
        ("mount", dict, "a table"),
        ("options", dict, "a table"),
    ):
        if key in table and not isinstance(table[key], kind):
            raise UsageError(f"{path}: {place}: {key} must be {expected}, got {shown(table[key])}")
    options = {key: _resolve_path(path, value) for key, value in table.get("options", {}).items()}
    if "mount" in table:
        mount = _make_mount(path, place, table["mount"])
    else:
        mount = None
    sensor = table.get("sensor")
    if options and sensor is None:
        raise UsageError(f'{path}: {place}: options require a sensor: add sensor = "ID"')
    source = _resolve_path(path, table["source"])
    if _NAME.fullmatch(source) and not os.path.exists(source):
        raise UsageError(
            f"{path}: {place}: source {source!r} is the name of another device: expected a"
            " port, address or file"
        )
    return NamedDevice(
        name,
        source,
        None if sensor is None else _resolve_path(path, sensor),
        mount,
        options,
        str(path),
    )


def _make_mount(path: Path, place: str, table: Mapping[str, Any]) -> Mount:
    kinds = {f.name: type(f.default) for f in fields(Mount)}
    _check_keys(path, f"{place} mount", table, kinds)
    for key, value in table.items():
        if kinds[key] is bool:
            is_valid = isinstance(value, bool)
        else:
            is_valid = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_valid or value in (float("inf"), float("-inf")) or value != value:
            if kinds[key] is bool:
                expected = "true or false"
            else:
                expected = "a number"
            raise UsageError(f"{path}: {place}: mount.{key} must be {expected}, got {shown(value)}")
    return Mount(**table)


def _check_keys(path: Path, place: str, keys: Iterable[str], allowed: Iterable[str]) -> None:
    for key in keys:
        if key not in allowed:
            raise UsageError(
                f"{path}: {place + ': ' if place else ''}unknown {'key' if place else 'table'}"
                f" {key!r}{_make_suggestion(key, allowed)}"
            )


def _make_suggestion(word: str, words: Iterable[str]) -> str:
    return did_you_mean(word, words) or f" (known: {', '.join(words)})"


def _resolve_path(path: Path, value: Any) -> Any:
    """Resolve a path starting with ./ or ../ against the folder of the settings file."""
    if isinstance(value, str) and value.startswith(("./", "../")):
        return str(path.parent / value)
    return value
