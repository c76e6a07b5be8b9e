"""What a spec says, in the languages of other tools: kinds of exports by name.

In: a sensor. Out: a text, by `export`. An export walks the frame trees (`lidarspec.spec.tree`) that `messages` hands out, and is refused,
with the reason, where they hold Python code or its target cannot say what the spec says. Modules in reading order:

* `messages`: the frame types with their trees.
* `json`, `stubs`: the spec as data, and as types for an editor.
* `reference`, `diagram`: a page in Markdown, and packet diagrams in SVG.
* `ksy`, `wireshark`: a Kaitai Struct format, and a dissector in Lua.
* `c`, `c_fields`: a header in C: the whole of it, and what reads the fields.
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from typing import TYPE_CHECKING

from lidarspec.errors import UnknownFrame, UnknownName, UsageError
from lidarspec.spec.description import with_frames

if TYPE_CHECKING:
    from lidarspec.spec.sensor import Sensor

#: kind -> "module:function"; each takes a Sensor and returns the text of the export.
EXPORTS: dict[str, str] = {
    "wireshark": "lidarspec.exports.wireshark:dissector",
    "c": "lidarspec.exports.c:header",
    "ksy": "lidarspec.exports.ksy:ksy",
    "md": "lidarspec.exports.reference:page",
    "svg": "lidarspec.exports.diagram:svg",
    "json": "lidarspec.exports.json:text",
    "pyi": "lidarspec.exports.stubs:pyi",
}


class Refused(UsageError):
    """An export that cannot say what the spec says, with the reason."""


class UnknownExport(UnknownName):
    """There is no export of this kind."""

    what = "export"


def narrowed(sensor: Sensor, frame: str) -> Sensor:
    """The sensor with one frame type alone, and no commands: what exports of a single message are made from.

    Raises:
        UnknownFrame: if it has no frame type of this name.
    """
    if frame not in sensor.frames:
        raise UnknownFrame(frame, sensor.frames, place=sensor.id)
    return with_frames(sensor, {frame: replace(sensor.frames[frame], after=None)})


def export(sensor: Sensor, kind: str) -> str:
    """The text of an export of a sensor.

    Args:
        kind: one of `EXPORTS`.

    Raises:
        Refused: where the target cannot say what the spec says.
        UnknownExport: for a kind that is none of them.
    """
    if kind not in EXPORTS:
        raise UnknownExport(kind, EXPORTS)
    module, _, function = EXPORTS[kind].partition(":")
    text: str = getattr(importlib.import_module(module), function)(sensor)
    return text
