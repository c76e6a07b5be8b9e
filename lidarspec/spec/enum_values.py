"""Values of enum fields: the number on the wire, with its name."""

from __future__ import annotations

from typing import Any

from lidarspec.spec.tree import FieldInfo

#: named raw values below this are shown in decimal, others in hexadecimal, as in most manuals.
FIRST_HEX_CODE = 10

#: the text after a number that has no name.
UNKNOWN_CODE = "unknown code"


class EnumValue(int):
    """A number with a name; its text contains both: "strongest (0x37)".

    Args:
        raw: the number on the wire.
        name: the name of the number; "" if the Enum has no name for it.
    """

    name: str

    def __new__(cls, raw: int, name: str = "") -> EnumValue:
        """Return a number with its name."""
        value = super().__new__(cls, raw)
        value.name = name
        return value

    def __repr__(self) -> str:
        """Return the name and the number, or the number alone if it has no name."""
        if self.name:
            return format_code(int(self), self.name)
        return int.__repr__(self)

    __str__ = __repr__


def format_code(raw: int, name: str) -> str:
    """Return a raw value and its name as text: "idle (1)" or "strongest (0x37)"."""
    if 0 <= raw < FIRST_HEX_CODE:
        return f"{name} ({raw})"
    return f"{name} ({raw:#x})"


def to_enum_value(info: FieldInfo, value: Any) -> Any:
    """Return a raw value as an `EnumValue` if its field has an Enum, else unchanged."""
    if info.labels and isinstance(value, int):
        return EnumValue(value, info.labels.get(value, ""))
    return value


def find_code(info: FieldInfo, value: Any) -> Any:
    """Return the raw value of a name in the field's Enum; other values unchanged."""
    if isinstance(value, str):
        return next((raw for raw, name in info.labels.items() if name == value), value)
    return value
