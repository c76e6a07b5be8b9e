"""Wire forms read one character at a time, for the oracle.

The module shares no code with `lidarspec.spec.wire_forms`.
"""

from __future__ import annotations

import functools
import math
from operator import xor
from struct import pack
from typing import Any

from construct import (
    Array,
    Bytes,
    BytesInteger,
    Const,
    Construct,
    Container,
    FormatField,
    IfThenElse,
    Pass,
    Renamed,
    Struct,
    evaluate,
)

from lidarspec.spec import Echoes, Escaped, Lines, Tokens


def plain_row(form: Any, struct: Construct, data: bytes) -> tuple[bytes, int] | None:
    """Return the frame at the start of some bytes, without its wire form, and its size.

    The size is the number of bytes on the wire. Returns None if the bytes do not begin with a
    frame.
    """
    if isinstance(form, Tokens):
        return _tokens(form, struct, data)
    return _unescape(form, data) if isinstance(form, Escaped) else _lines(form, struct, data)


def _unescape(form: Escaped, data: bytes) -> tuple[bytes, int] | None:
    end = data.find(form.flag, 1)
    if not data or data[0] != form.flag or end < 2:
        return None
    row, left = bytearray(), iter(data[1:end])
    for byte in left:
        if byte != form.escape:
            row.append(byte)
            continue
        turned = next(left, form.escape)
        if turned == form.escape:
            return None
        row.append(turned ^ form.xor)
    return bytes(row), end + 1


def _lines(form: Lines, struct: Construct, data: bytes) -> tuple[bytes, int] | None:
    end = data.find(b"\n\n")
    if end < 0:
        return None
    row = b""
    lines = data[:end].split(b"\n")
    for number, characters in enumerate(lines):
        line = characters
        if form.check is not None and number >= form.bare:
            line, check = characters[:-1], characters[-1:]
            if check != bytes([(sum(line) & 63) + 48]):
                return None
        wanted = form.head[number] if number < len(form.head) else form.width
        if (
            not line
            or len(line) > wanted
            or (len(line) < wanted and (number < len(form.head) or number < len(lines) - 1))
        ):
            return None
        row += line
    if len(lines) < len(form.head):
        return None
    if form.numbers is not None and form.numbers.echoes is not None:
        row = row[: sum(form.head)] + _steps(form.numbers.echoes, row[sum(form.head) :])
    reader = _SixBitReader(row, form)
    try:
        reader.read(struct, Container(), "")
    except ValueError:
        return b"", end + 2
    return bytes(reader.row) + reader.left, end + 2


def _steps(form: Echoes, characters: bytes) -> bytes:
    row = b""
    while characters:
        echo, characters = characters[: form.size], characters[form.size :]
        row += echo
        given = 1
        while characters.startswith(form.mark) and given < form.most:
            echo, characters = characters[1 : 1 + form.size], characters[1 + form.size :]
            row += echo
            given += 1
        row += b"0" * form.size * (form.most - given)
    return row


def _tokens(form: Tokens, struct: Construct, data: bytes) -> tuple[bytes, int] | None:
    end = data.find(form.end)
    if not data.startswith(form.start) or end < 0 or form.start in data[1:end]:
        return None
    content = data[1:end]
    if form.check is not None:
        content, star, digits = content[:-3], content[-3:-2], content[-2:]
        if star != b"*" or digits.upper() != b"%02X" % functools.reduce(xor, content, 0):
            return None
    reader = _Reader(content + form.sep, form)
    try:
        reader.read(struct, Container(), "")
    except (ValueError, OverflowError):
        return None
    return (bytes(reader.row), end + len(form.end)) if not reader.left else None


class _Reader:
    """Reads the fields of a struct from the characters of a frame, one by one."""

    def __init__(self, left: bytes, form: Any) -> None:
        self.left, self.row, self._form = left, bytearray(), form
        self._texts = 0
        self._missing = 0

    def read(self, part: Construct, context: Container, name: str) -> None:
        if isinstance(part, Renamed):
            self.read(part.subcon, context, part.name)
        elif isinstance(part, Struct):
            inner = Container(_=context)
            for member in part.subcons:
                self.read(member, inner, "")
            context[name] = inner
            context.update(
                {key: value for key, value in inner.items() if key != "_"} if not name else {}
            )
        elif isinstance(part, Array):
            for _ in range(evaluate(part.count, context)):
                self.read(part.subcon, context, "")
        elif isinstance(part, IfThenElse):
            self.read(
                part.thensubcon if evaluate(part.condfunc, context) else part.elsesubcon,
                context,
                name,
            )
        elif isinstance(part, Const):
            self._text(len(part.value))
        elif isinstance(part, Bytes):
            self._text(evaluate(part.length, context))
        elif isinstance(part, FormatField | BytesInteger):
            context[name] = self._number(part)
        elif hasattr(part, "subcon"):  # a unit, a name
            self.read(part.subcon, context, name)
        elif part is not Pass:
            raise AssertionError(part)

    def _text(self, size: int) -> None:
        if not size:
            return
        self._texts += 1
        if isinstance(self._form, Tokens) and self._texts < self._form.joined:
            text, self.left = self.left[:size], self.left[size:]
            if len(text) < size or self._form.sep in text:
                raise ValueError("the first token is short")
            self.row += text
            return
        if isinstance(self._form, Tokens) and self._form.padded:
            self._padded_text(size)
            return
        text, mark, self.left = self.left[:size], self.left[size : size + 1], self.left[size + 1 :]
        if mark not in (self._form.sep, self._form.end) or not mark:
            raise ValueError("a token of another length")
        self.row += text

    def _padded_text(self, size: int) -> None:
        text, _, left = self.left.partition(self._form.sep)
        if self._form.rest and self._texts > self._form.joined:
            text, left = self.left[:-1], b""
        if not self.left:
            self._missing += 1
        if self._missing > self._form.optional or len(text) > size:
            raise ValueError("a token is missing or too long")
        self.left = left
        self.row += text.ljust(size, b"\x00")

    def _decimal(self, token: str, field: FormatField) -> None:
        digits = token[1:] if token[:1] in ("+", "-") else token
        number = digits.replace(".", "", 1)
        if token and not (number.isascii() and number.isdigit() and len(token) <= 40):
            raise ValueError(token)
        value = float(token) if token else math.nan
        self.row += pack(field.fmtstr, value)

    def _number(self, field: FormatField) -> int:
        stops = [
            self.left.find(mark) for mark in (self._form.sep, self._form.end) if mark in self.left
        ]
        if not stops:
            raise ValueError("no token")
        token, self.left = self.left[: min(stops)].decode("latin-1"), self.left[min(stops) + 1 :]
        if field.fmtstr[-1] in "fd" and self._form.base == 10:
            self._decimal(token, field)
            return 0
        digits = token[1:] if token[:1] in ("+", "-") else token
        if not digits or len(digits) > 16 or not set(digits) <= set("0123456789abcdefABCDEF"):
            raise ValueError(token)
        signed = digits != token
        bits = 8 * field.length
        value = int(digits, 10 if signed else self._form.base)
        is_signed, is_float = field.fmtstr[-1].islower(), field.fmtstr[-1] in "fd"
        limits = (-(2 ** (bits - 1)) if is_signed else 0, 2 ** (bits - is_signed))
        if signed and int(token) and (is_float or not limits[0] <= int(token) < limits[1]):
            raise ValueError(token)
        if not signed and value >= 2**bits:
            raise ValueError(token)
        value = int(token) if signed else value
        self.row += (value % 2**bits).to_bytes(field.length, "big")
        return value


class _SixBitReader(_Reader):
    """Reads numbers in characters of six bits; all other fields are text.

    A number has as many characters as its field has bytes.
    """

    def _text(self, size: int) -> None:
        self.row += self.left[:size]
        self.left = self.left[size:]

    def _number(self, field: Construct) -> int:
        size = field.sizeof()
        characters, self.left = self.left[:size], self.left[size:]
        if len(characters) < size or any(not 48 <= character < 112 for character in characters):
            raise ValueError(characters)
        value = 0
        for character in characters:
            value = value * 64 + character - 48
        self.row += value.to_bytes(size, "big")
        return value
