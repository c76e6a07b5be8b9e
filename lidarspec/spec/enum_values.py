"""Values of codes: the number on the wire, with its name.

A field with construct's `Enum` has an `EnumValue` in a parsed frame. It is a number in all respects
except its text, so that programs compare and rebuild numbers, and readers see names.
"""

from __future__ import annotations

from typing import Any

from lidarspec.spec.tree import FieldInfo

#: codes below this are shown in decimal, others in hexadecimal, as in most manuals.
FIRST_HEX_CODE = 10

#: the text after a code that has no name.
UNKNOWN_CODE = "unknown code"


class EnumValue(int):
    """A code, which equals its number; its text has the name: "strongest (0x37)".

    Args:
        raw: the number on the wire.
        name: the name of the code; "" if the Enum has no name for it.
    """

    name: str

    def __new__(cls, raw: int, name: str = "") -> EnumValue:
        """Return the value of a code."""
        value = super().__new__(cls, raw)
        value.name = name
        return value

    def __repr__(self) -> str:
        """Return the name and the number; the number alone if it has no name."""
        if self.name:
            return format_code(int(self), self.name)
        return int.__repr__(self)

    __str__ = __repr__


def format_code(raw: int, name: str) -> str:
    """Return a code as text, for example "idle (1)" or "strongest (0x37)"."""
    if 0 <= raw < FIRST_HEX_CODE:
        return f"{name} ({raw})"
    return f"{name} ({raw:#x})"


def name_value(info: FieldInfo, value: Any) -> Any:
    """Return a raw value of a field with an Enum as `EnumValue`; other values unchanged."""
    if info.labels and isinstance(value, int):
        return EnumValue(value, info.labels.get(value, ""))
    return value


def find_code(info: FieldInfo, value: Any) -> Any:
    """Return the raw value of a name of an Enum; other values unchanged."""
    if isinstance(value, str):
        return next((raw for raw, name in info.labels.items() if name == value), value)
    return value
