"""Decode frames from the JSON of a spec alone, to show that it is complete.

The decoder was written from docs/reference/spec-json.md.
"""

from __future__ import annotations

import struct
from typing import Any

FLOATS = {2: "e", 4: "f", 8: "d"}
OPERATIONS = {
    "+": lambda a, b: a + b,
    "-": lambda a, b=None: -a if b is None else a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "//": lambda a, b: a // b,
    "%": lambda a, b: a % b,
    "&": lambda a, b: a & b,
    "|": lambda a, b: a | b,
    "^": lambda a, b: a ^ b,
    "<<": lambda a, b: a << b,
    ">>": lambda a, b: a >> b,
    "==": lambda a, b: a == b,
    "!=": lambda a, b: a != b,
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
    "not": lambda a: not a,
}


class Decoder:
    """Decodes one frame; it has the bytes, the current offset, and values by path."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at, self.known = data, 0, {}

    def read(self, part: dict[str, Any]) -> Any:
        """Return the value of the part at this offset."""
        return getattr(self, "read_" + part["kind"])(part)

    def taken(self, size: int) -> bytes:
        self.at += size
        assert self.at <= len(self.data)
        return self.data[self.at - size : self.at]

    def value(self, formula: Any) -> int:
        if isinstance(formula, int):
            return formula
        if "field" in formula:
            return self.known[formula["field"]]
        return OPERATIONS[formula["op"]](*(self.value(arg) for arg in formula["args"]))

    def read_struct(self, part: dict[str, Any]) -> Any:
        found = {}
        for member in part["members"]:
            value = self.read(member)
            if member["name"]:
                found[member["name"]] = value
        return found

    def read_computed(self, part: dict[str, Any]) -> Any:
        return self.value(part["value"])

    def read_uint(self, part: dict[str, Any], *, signed: bool = False) -> int:
        self.known[part["path"]] = int.from_bytes(
            self.taken(part["bytes"]), part["order"], signed=signed
        )
        return self.known[part["path"]]

    def read_int(self, part: dict[str, Any]) -> int:
        return self.read_uint(part, signed=True)

    def read_float(self, part: dict[str, Any]) -> float:
        (value,) = struct.unpack(
            ("<" if part["order"] == "little" else ">") + FLOATS[part["bytes"]],
            self.taken(part["bytes"]),
        )
        return value

    def read_bytes(self, part: dict[str, Any]) -> bytes:
        ending = part.get("ending")
        if ending is None:
            return self.taken(self.value(part["bytes"]))
        mark, mask = bytes.fromhex(ending["mark"]), bytes.fromhex(ending["mask"])
        found = b""
        if not mark:
            return self.taken(len(self.data) - self.at)
        while True:
            unit = self.taken(len(mark))
            is_mark = bytes(byte & bits for byte, bits in zip(unit, mask, strict=True)) == mark
            if not is_mark or ending["is_content"]:
                found += unit
            if is_mark:
                self.known[part["bytes"]["field"]] = len(found)
                return found

    def read_block(self, part: dict[str, Any]) -> Any:
        block = self.taken(part["bytes"])
        found: Any = {}
        for bits in part["parts"]:
            value = sum(
                (block[run["byte"]] >> run["low"]) % (1 << run["width"]) << run["target"]
                for run in bits["runs"]
            )
            if bits["signed"] and value >> bits["width"] - 1:
                value -= 1 << bits["width"]
            self.known[bits["path"]] = value
            if not bits["name"]:
                return value
            found[bits["name"]] = value
        return found

    def read_array(self, part: dict[str, Any]) -> Any:
        return [self.read(part["element"]) for _ in range(self.value(part["count"]))]

    def read_parts(self, part: dict[str, Any]) -> Any:
        found, start = list[Any](), self.at
        count, following, within = (
            None if part[rule] is None else self.value(part[rule])
            for rule in ("count", "size", "within")
        )
        while (
            len(found) < count
            if count is not None
            else following
            if within is None
            else self.at - start < within
        ):
            begun = self.at
            value, kind = self.read_one(part["kinds"])
            found.append(value)
            if following is not None:
                assert self.at - begun == following
                following = self.value(kind["following"])
        self.known[f"{part['name']}.size"] = self.at - start
        return found

    def read_one(self, kinds: list[dict[str, Any]]) -> tuple[Any, dict[str, Any]]:
        """Return a part, decoded as the first type with matching constants."""
        start = self.at
        for kind in kinds:
            self.at = start
            try:
                value = self.read(kind["part"])
            except AssertionError:  # longer than the remaining bytes
                continue
            constants = {
                member["name"]: member.get("const")
                for member in kind["part"]["members"]
                if member.get("const") is not None
            }
            if all(value[name] == const for name, const in constants.items()):
                return value, kind
        raise AssertionError("a part of no kind")

    def read_if(self, part: dict[str, Any]) -> Any:
        return self.read(part["then"] if self.value(part["condition"]) else part["else"])

    def read_switch(self, part: dict[str, Any]) -> Any:
        key = self.value(part["key"])
        return self.read(
            next((case["part"] for case in part["cases"] if case["value"] == key), part["default"])
        )

    def read_check(self, part: dict[str, Any]) -> None:
        assert self.value(part["condition"])

    def read_nothing(self, part: dict[str, Any]) -> None:
        return None
