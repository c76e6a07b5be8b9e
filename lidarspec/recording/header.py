"""What a recording says of itself: the JSON of its first record."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from lidarspec.errors import UsageError, WireError
from lidarspec.plugins import sensor as named_sensor
from lidarspec.spec import Sensor

VERSION = 1
_ID = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_WORD = re.compile(r"[A-Za-z0-9_+-]{1,40}")


@dataclass(frozen=True)
class Header:
    """What a recording says of itself.

    Attributes:
        sensor, options: id and options of the sensor; "" where it was recorded raw.
        source: the SOURCE that it came from.
        datagrams: whether the link carried datagrams.
        baud: of a serial port.
        versions: of lidarspec and of the sensor's distribution.
        created: date and time with the zone, ISO 8601.
        wall_ns, monotonic_ns: the same moment on both clocks of the recording machine.
        version: of the format.
    """

    sensor: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    source: str = ""
    datagrams: bool = False
    baud: int | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    created: str = ""
    wall_ns: int = 0
    monotonic_ns: int = 0
    version: int = VERSION

    def to_json(self) -> bytes:
        """The header as it stands in the file; an option that JSON does not know stands as its text."""
        return json.dumps({item.name: getattr(self, item.name) for item in fields(self)}, default=_plain).encode()

    def known_sensor(self) -> Sensor:
        """The installed sensor that it names, with the options of then.

        Raises:
            UsageError: where it names none, or one with an option that only the caller should give, such as a file.
            UnknownSensor: where that one is not installed.
        """
        if not _ID.fullmatch(self.sensor):
            raise UsageError(f"its header gives {self.sensor[:40]!r} for the id of a sensor" if self.sensor else "it names no sensor")
        for name, value in self.options.items():
            if not isinstance(value, bool | int | float) and not (isinstance(value, str) and _WORD.fullmatch(value)):
                raise UsageError(f"it was recorded with {name}={value!r}: give the sensor, configured so")
        found = named_sensor(self.sensor)
        return found.configure(**self.options) if self.options else found


_BLANK = Header()
_KINDS: dict[str, type | tuple[type, ...]] = {
    "sensor": str,
    "options": dict,
    "source": str,
    "datagrams": bool,
    "baud": (int, type(None)),
    "versions": dict,
    "created": str,
    "wall_ns": int,
    "monotonic_ns": int,
    "version": int,
}


def read_header(data: bytes) -> Header:
    """The header that bytes stand for; names that this version does not know are passed over.

    Raises:
        WireError: for bytes that are none.
    """
    try:
        values = json.loads(data)
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict):
        raise WireError("the header of the recording is no JSON object", data=data[:16])
    known = {name: values.get(name, getattr(_BLANK, name)) for name in _KINDS}
    for name, kind in _KINDS.items():
        if not isinstance(known[name], kind) or (isinstance(known[name], bool) and kind is not bool):
            raise WireError(f"the header of the recording has {name} = {str(known[name])[:40]!r}", path=name, got=known[name])
    return Header(**known)


def _plain(value: Any) -> Any:
    return dict(value) if isinstance(value, Mapping) else str(value)
