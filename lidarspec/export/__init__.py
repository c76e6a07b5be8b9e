"""What a spec says, in the languages of other tools: kinds of exports by name.

An export is a function from a `Sensor` to a text. It is made from the frame trees of `lidarspec.export.messages`, and refused, with
the reason, where its target cannot say what the spec says.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from lidarspec.errors import UnknownName, UsageError

if TYPE_CHECKING:
    from lidarspec.spec import Sensor

#: kind -> "module:function"; each takes a Sensor and returns the text of the export.
EXPORTS: dict[str, str] = {
    "wireshark": "lidarspec.export.wireshark:dissector",
    "c": "lidarspec.export.c:header",
}


class Refused(UsageError):
    """An export that cannot say what the spec says, with the reason."""


class UnknownExport(UnknownName):
    """There is no export of this kind."""

    what = "export"


def export(kind: str, sensor: Sensor) -> str:
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
