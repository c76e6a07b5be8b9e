"""Wire forms: frames without fixed field offsets, as text or with escaped bytes.

A wire form encodes and decodes one frame at a time. `find_end` finds the end of an encoded frame,
`decode` converts it to the bytes of the struct, and `encode` converts the bytes of the struct to
the encoded frame.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.spec.checksums import Checksum, Xor

Offsets = NDArray[np.intp]
Values = NDArray[np.uint64]
#: The bytes of a text; None for a byte that varies.
Characters = Sequence[int | None]

#: `WireForm.find_end` returns the first value if the end of the frame has not arrived, and the
#: second value if the bytes do not begin a frame.
NO_END = 0
NO_FRAME = -1
#: The maximum number of digits of a number in a token.
MAX_DIGITS = 16
#: The maximum number of characters of a decimal fraction, and its pattern.
MAX_DECIMAL_CHARACTERS = 40
_DECIMAL = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)")
#: The number of decimal digits that a float always keeps, by its size in bytes.
EXACT_DIGITS = {2: 3, 4: 6, 8: 15}
#: The largest unsigned value, by size in bytes.
LARGEST_OF_BYTES = np.array([256**size - 1 for size in range(9)], np.uint64)
#: The number of bits in a character of `SixBits`.
CHARACTER_BITS = 6
NEWLINE = 0x0A
PLUS = 0x2B
MINUS = 0x2D


@dataclass(frozen=True)
class TextRun:
    """A field of bytes, which is text in the encoded frame.

    Attributes:
        size: the size of the field in bytes.
    """

    size: int

    def __len__(self) -> int:
        return 1

    @property
    def sizes(self) -> Offsets:
        """The size of each field of the run in bytes, (1,)."""
        return np.array([self.size], np.intp)


@dataclass(frozen=True, eq=False)
class NumberRun:
    """Consecutive numbers of a struct.

    Attributes:
        sizes: the size of each number in bytes, (n,).
        kinds: "u", "i" or "f" for each number, as in `numpy.dtype.kind`, (n,).
        is_little: whether each number is little-endian, (n,).
        paths: the path of the field of each number.
    """

    sizes: Offsets
    kinds: NDArray[np.str_]
    is_little: NDArray[np.bool_]
    paths: Sequence[str]

    def __len__(self) -> int:
        return len(self.sizes)

    @cached_property
    def float_indices(self) -> Sequence[int]:
        """The indices of the floats."""
        indices: Sequence[int] = np.flatnonzero(self.kinds == "f").tolist()
        return indices

    @cached_property
    def ends(self) -> Offsets:
        """The offset after each number, counted from the first byte of the run, (n,)."""
        return np.cumsum(self.sizes)

    @cached_property
    def owners(self) -> Offsets:
        """The index of the number that contains each byte of the run, (bytes,)."""
        return np.arange(len(self)).repeat(self.sizes)

    @cached_property
    def remaining(self) -> Offsets:
        """How many bytes of the same number follow each byte of the run, (bytes,)."""
        return self.ends[self.owners] - 1 - np.arange(len(self.owners))

    @cached_property
    def largest(self) -> Values:
        """The largest unsigned value of each number, with all bits set, (n,)."""
        return LARGEST_OF_BYTES[self.sizes]

    @cached_property
    def highest(self) -> Values:
        """The largest value that each number can have, (n,); 0 for a float."""
        highest = np.where(self.kinds == "i", self.largest >> np.uint64(1), self.largest)
        return np.where(self.kinds == "f", np.uint64(0), highest)

    @cached_property
    def lowest(self) -> Values:
        """The absolute value of the lowest value that each number can have, (n,).

        For example, it is 128 for a signed byte. It is 0 for unsigned numbers and floats.
        """
        lowest = (self.largest >> np.uint64(1)) + np.uint64(1)
        return np.where(self.kinds == "i", lowest, np.uint64(0))

    @cached_property
    def _word_offsets(self) -> Offsets:
        """The offset of each byte if each number is a big-endian word of 8 bytes."""
        significance = np.where(
            self.is_little[self.owners],
            self.sizes[self.owners] - 1 - self.remaining,
            self.remaining,
        )
        return 8 * self.owners + 7 - significance

    def to_bytes(self, values: Values) -> bytes:
        """Return values of numbers as bytes of the struct.

        Args:
            values: the values of the first numbers of the run, or of all numbers.
        """
        size = self.ends.item(len(values) - 1) if len(values) else 0
        words = values.astype(">u8").view(np.uint8)
        return words[self._word_offsets[:size]].tobytes()

    def from_bytes(self, data: bytes) -> Values:
        """Return the bits of all numbers of the run as unsigned integers, (n,)."""
        words = np.zeros(8 * len(self), np.uint8)
        words[self._word_offsets] = np.frombuffer(data, np.uint8)
        return words.view(">u8").astype(np.uint64)


Run = TextRun | NumberRun
#: A function of the first bytes of a struct. It returns the next runs of fields, as far as these
#: bytes determine them. The result is empty if the struct is complete, or if no frame begins with
#: these bytes.
NextRuns = Callable[[bytes], Sequence[Run]]


@dataclass(frozen=True)
class Problem:
    """The first error in bytes that are not a valid frame of a wire form.

    Attributes:
        offset: the offset of the error in the frame.
        reason: a description of the error; "" for a field that cannot be decoded.
        is_checksum: whether a checksum of the wire form is wrong.
        path: the path of the field with the error.
    """

    offset: int
    reason: str = ""
    is_checksum: bool = False
    path: str = ""
    expected: Any = None
    got: Any = None


@dataclass(frozen=True, eq=False)
class Decoded:
    """The decoded bytes of a frame, up to the first error.

    Attributes:
        struct: the bytes of the struct.
        spans: for each run, the offsets of its fields in the encoded frame, and the sizes of the
            fields in the struct.
        end: the offset after the last field in the encoded frame.
        problem: the first error; None if the whole frame was decoded.
    """

    struct: bytes
    spans: Sequence[tuple[Offsets, Offsets]]
    end: int
    problem: Problem | None = None

    @property
    def offsets(self) -> list[int]:
        """The offsets in the encoded frame, one for each byte of the struct, and `end`.

        The offset of a byte is the offset at which the field that contains this byte begins.
        """
        starts = [begins.repeat(sizes) for begins, sizes in self.spans]
        return [*np.concatenate([np.zeros(0, np.intp), *starts]).tolist(), self.end]

    def offset(self, place: int) -> int:
        """Return where the field of a byte begins in the encoded frame.

        Args:
            place: the offset of the byte in the struct.
        """
        return self.offsets[min(place, len(self.struct))]


class WireForm(Protocol):
    """The encoding of the frames of one type.

    A subclass defines `find_end`, `decode` and `encode`.

    Attributes:
        is_text: whether fields of bytes contain printable characters; by default False.
    """

    is_text: ClassVar[bool] = False

    def begins(self, texts: Sequence[Characters]) -> Characters:
        """Return the bytes with which every encoded frame begins.

        The result has None in place of a byte that varies. It ends before the first byte without a
        fixed offset. By default, the result is empty.

        Args:
            texts: for each field of bytes at the start of the struct, the bytes of the field, with
                None in place of a byte that varies.
        """
        return ()

    def find_end(self, data: bytes) -> int:
        """Return the size of the encoded frame at the start of some bytes.

        Returns `NO_END` if more bytes are needed to find the end of the frame, and `NO_FRAME` if no
        frame begins with these bytes.
        """

    def decode(self, data: bytes, next_runs: NextRuns) -> Decoded:
        """Decode one frame, or its first bytes if the rest is missing; see `decode_runs`."""

    def encode(self, struct: bytes, runs: Sequence[Run]) -> bytes:
        """Return the encoded frame for the bytes of a struct.

        For a value that cannot be encoded, the result may be any bytes.
        """

    def largest(self, size: int) -> int:
        """Return the largest number that can be encoded for a field of `size` bytes.

        By default, all numbers can be encoded.
        """
        return int(256**size - 1)


#: The members of a wire form, and those that a subclass of `WireForm` must define itself.
_MEMBERS = ("is_text", "begins", "find_end", "decode", "encode", "largest")
_OWN_METHODS = ("find_end", "decode", "encode")


def check_wire_form(form: object) -> None:
    """Raise SpecError if an object lacks members of `WireForm`."""
    kind = type(form)
    missing = [name for name in _MEMBERS if not hasattr(form, name)]
    missing += [
        name for name in _OWN_METHODS if getattr(kind, name, None) is getattr(WireForm, name)
    ]
    if missing:
        advice = (
            ""
            if WireForm in kind.__mro__
            else "; derive the class from WireForm, which defines defaults"
        )
        raise SpecError(
            f"{kind.__name__} does not define {', '.join(missing)}{advice}", path="wire"
        )


@runtime_checkable
class BulkEnds(Protocol):
    """A wire form that is fast because it finds the sizes of many candidates at once."""

    def find_ends(self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets) -> Offsets:
        """Return the size of the frame at each offset, or `NO_END` or `NO_FRAME`, (n,).

        For a valid frame, the result is the same as that of `find_end`. For an invalid frame, the
        result is either the same as that of `find_end`, or `NO_FRAME`.

        Args:
            buffer: the input.
            offsets: the offsets of the candidates, ascending.
            stops: the offset after the last available byte of each candidate.
        """


@runtime_checkable
class LimitsValues(Protocol):
    """A wire form that cannot encode every value up to `largest`.

    Random values are converted to values that can be encoded.
    """

    def to_encodable(self, run: NumberRun, values: Values) -> Values:
        """Return values that can be encoded, (n,).

        Args:
            run: the numbers.
            values: random bits from which the returned values are made, (n,).
        """


class RunReader(Protocol):
    """Reads the fields of one frame in order."""

    @property
    def position(self) -> int:
        """The offset of the next field in the frame, or the end of the frame."""

    def read(self, run: Run) -> tuple[bytes, Offsets]:
        """Read consecutive fields, up to the first invalid field.

        Returns:
            The bytes of the struct, and the offset of each field in the frame.
        """


def decode_runs(reader: RunReader, next_runs: NextRuns, size: int | None) -> Decoded:
    """Read the fields of a frame.

    Args:
        size: the `position` that the reader has after it has read all fields of the frame; None if
            the end of the frame has not arrived. This position is after the separator or end mark
            that follows the last field, so the fields end at ``size - 1``.
    """
    struct = b""
    spans = list[tuple[Offsets, Offsets]]()
    is_readable = True
    while is_readable and (runs := next_runs(struct)):
        for run in runs:
            part, begins = reader.read(run)
            struct += part
            spans.append((begins, run.sizes[: len(begins)]))
            is_readable = len(begins) == len(run)
            if not is_readable:
                break
    position = reader.position
    if is_readable and position == size:
        return Decoded(struct, spans, size - 1)
    end = position if size is None else min(position, size - 1)
    return Decoded(struct, spans, end, Problem(position))


def find_next_offsets(places: Offsets, offsets: Offsets, none: int) -> Offsets:
    """Return, for each offset, the first of `places` at or after the offset, (n,).

    Args:
        places: the offsets of some bytes, ascending.
        offsets: the offsets, (n,).
        none: the result for an offset after all places.
    """
    return np.append(places, none)[places.searchsorted(offsets)]


@lru_cache(maxsize=64)
def _make_digit_values(base: int) -> tuple[Values, NDArray[np.bool_]]:
    """Return the value of each character as a digit, and whether it is a digit.

    Both arrays have the shape (256,), and their index is the character.
    """
    values = np.zeros(256, np.uint64)
    is_digit = np.zeros(256, np.bool_)
    for value, character in enumerate("0123456789ABCDEF"[:base]):
        for code in (ord(character), ord(character.lower())):
            values[code] = value
            is_digit[code] = True
    return values, is_digit


@lru_cache(maxsize=64)
def _make_digit_weights(base: int) -> Values:
    """Return the factor of a digit, by its position from the end of its token."""
    return np.array([0, *(base**place for place in range(MAX_DIGITS)), 0], np.uint64)


@dataclass(frozen=True)
class HexCheck:
    """A checksum in hexadecimal digits after a mark, such as ``*5B`` of NMEA 0183.

    The checksum covers the bytes after the first byte of the frame, up to the mark.

    Args:
        algorithm: the checksum algorithm; its width determines the number of digits.
        mark: the byte before the digits.

    Raises:
        SpecError: if the mark is not one byte.
    """

    algorithm: Checksum = field(default_factory=Xor)
    mark: bytes = b"*"

    def __post_init__(self) -> None:
        if len(self.mark) != 1:
            raise SpecError("the mark before a checksum must be one byte", path="wire")

    @property
    def size(self) -> int:
        """The size of mark and digits in bytes."""
        return 1 + -(-self.algorithm.width // 4)

    def write(self, content: bytes) -> bytes:
        """Return the mark, and the checksum of `content` in hexadecimal digits."""
        return self.mark + b"%0*X" % (self.size - 1, self.algorithm(content))


@dataclass(frozen=True)
class Tokens:
    """Text in tokens, each followed by a separator or the end.

    An integer is a token of digits in the given base, which may have leading zeros and lower-case
    digits. An integer with a sign is always decimal. A negative integer may also be sent without a
    sign, as the digits of its two's complement. In base 16, a float is sent as the digits of its
    bits. In base 10, a float is sent as a decimal fraction; an empty token means nan. A field of n
    bytes is a token of exactly n characters, which may include the separator.

    Args:
        start: the first byte of a frame.
        sep: the byte between tokens.
        end: the last bytes of a frame.
        base: the base of the digits, 10 or 16.
        width: the minimum number of digits of an encoded integer. Decoding accepts any number of
            digits.
        check: the checksum before the end; None without a checksum.
        formats: the format of each float, by path, as manuals write it: "hhmmss.ss" means at least
            six digits before the point and two digits after it. Every character except the point
            stands for a digit, so "dddddd.dd" means the same.
        joined: the number of fields of bytes that together form the first token.
        padded: whether a token may be shorter than its field of bytes, which is then padded with
            zero bytes.
        optional: how many fields of bytes at the end of the frame may be missing; requires
            `padded`.
        rest: whether the field of bytes after the first token contains all other characters of the
            frame, including separators; requires `padded`.

    Raises:
        SpecError: if the base is not 10 or 16, if start or separator are not one byte, or if the
            end begins with one of them.
    """

    is_text: ClassVar[bool] = True
    start: bytes
    sep: bytes = b" "
    end: bytes = b"\x03"
    base: int = 16
    width: int = 0
    check: HexCheck | None = None
    formats: Mapping[str, str] = field(default_factory=dict, hash=False)
    joined: int = 1
    padded: bool = False
    optional: int = 0
    rest: bool = False

    def __post_init__(self) -> None:
        if len(self.start) != 1 or len(self.sep) != 1 or not self.end:
            raise SpecError(
                "Tokens: `start` and `sep` must be one byte each, and `end` at least one byte",
                path="wire",
            )
        if len({self.start, self.sep, self.end[:1]}) < 3:
            raise SpecError(
                "Tokens: `start`, `sep` and `end` must begin with different bytes", path="wire"
            )
        if self.base not in (10, 16):
            raise SpecError(f"base must be 10 or 16, not {self.base}", path="wire")

    def begins(self, texts: Sequence[Characters]) -> Characters:
        first = list(itertools.chain(*texts[: self.joined]))
        characters = [*self.start]
        if len(texts) < self.joined:
            return [*characters, *first]
        tokens = [token for token in (first, *texts[self.joined :]) if len(token)]
        for number, token in enumerate(tokens):
            if self.padded and number > 0 and None in token:
                return characters  # the token may be shorter, so later offsets are not fixed
            characters += [*token, self.sep[0]]
        return characters[: -1 if tokens else None]

    def find_end(self, data: bytes) -> int:
        end = data.find(self.end, 1)
        if data.find(self.start, 1, end if end > 0 else len(data)) > 0:
            return NO_FRAME
        if end > 0:
            return end + len(self.end)
        return NO_END

    def find_ends(self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets) -> Offsets:
        none = len(buffer)
        is_end = buffer == self.end[0]
        for distance, byte in enumerate(self.end[1:], 1):
            is_end[:-distance] &= buffer[distance:] == byte
            is_end[-distance:] = False
        ends = find_next_offsets(np.flatnonzero(is_end), offsets + 1, none)
        starts = find_next_offsets(np.flatnonzero(buffer == self.start[0]), offsets + 1, none)
        sizes = np.where(ends + len(self.end) <= stops, ends + len(self.end) - offsets, NO_END)
        sizes[starts < np.minimum(ends, stops)] = NO_FRAME
        return sizes

    def decode(self, data: bytes, next_runs: NextRuns) -> Decoded:
        stop, problem = self._find_stop(data)
        if stop is None:
            return decode_runs(_TokenReader(self, data, None), next_runs, None)
        decoded = decode_runs(_TokenReader(self, data[:stop], stop), next_runs, stop + 1)
        if problem is None:
            return decoded
        return replace(decoded, problem=problem)

    def _find_stop(self, data: bytes) -> tuple[int | None, Problem | None]:
        """Return the offset after the last token, and an error in the checksum.

        The offset is None if the end of the frame is missing.
        """
        if not data.endswith(self.end):
            return None, None
        stop = len(data) - len(self.end)
        if self.check is None:
            return stop, None
        begin = stop - self.check.size
        if data[begin : begin + 1] != self.check.mark or begin < 1:
            reason = f"the frame does not end with {self.check.mark.decode()} and a checksum"
            return stop, Problem(stop, reason, is_checksum=True)
        got = data[begin:stop]
        expected = self.check.write(data[1:begin])
        if got.upper() == expected:
            return begin, None
        reason = f"the checksum is {got!r}, expected {expected!r}"
        return begin, Problem(begin, reason, is_checksum=True, expected=expected, got=got)

    def encode(self, struct: bytes, runs: Sequence[Run]) -> bytes:
        tokens = list[bytes]()
        offset = 0
        text_count = 0
        for run in runs:
            part = struct[offset : offset + int(run.sizes.sum())]
            offset += len(part)
            if isinstance(run, NumberRun):
                tokens += self._number_tokens(run, part)
                continue
            text = part.rstrip(b"\x00") if self.padded else part
            text_count += 1
            if 1 < text_count <= self.joined:
                tokens[-1] += text
            else:
                tokens.append(text)
        content = self.sep.join(tokens)
        check = b"" if self.check is None else self.check.write(content)
        return self.start + content + check + self.end

    def _number_tokens(self, run: NumberRun, data: bytes) -> list[bytes]:
        values = run.from_bytes(data)
        if self.base == 16:
            return [b"%0*X" % (self.width, value) for value in values.tolist()]
        is_negative = (run.kinds == "i") & (values > run.highest)
        magnitudes = np.where(is_negative, run.largest - values + np.uint64(1), values)
        signs = np.where(is_negative, "-", "")
        widths = [len(self.formats.get(path, "")) or self.width for path in run.paths]
        triples = zip(signs.tolist(), magnitudes.tolist(), widths, strict=True)
        tokens = [f"{sign}{value:0{width}d}".encode() for sign, value, width in triples]
        for index in run.float_indices:
            value = _float_of_bits(values[index], run.sizes.item(index))
            tokens[index] = _write_decimal(value, self.formats.get(run.paths[index], ""))
        return tokens

    def largest(self, size: int) -> int:
        return int(256**size - 1)

    def to_encodable(self, run: NumberRun, values: Values) -> Values:
        """Return values that can be encoded; floats become fractions with few digits."""
        if self.base == 16:
            return values
        drawn = values.copy()
        for index in run.float_indices:
            whole, _, fraction = self.formats.get(run.paths[index], "000.000").partition(".")
            size = run.sizes.item(index)
            digits = min(len(whole) + len(fraction), EXACT_DIGITS[size])
            number = int(values[index]) % 10**digits / 10 ** len(fraction)
            drawn[index] = _bits_of_float(number, size)
        return drawn


def _float_of_bits(bits: np.uint64, size: int) -> np.floating[Any]:
    """Return the float of `size` bytes that has these bits."""
    return np.array([bits]).astype(f"u{size}").view(f"f{size}")[0]  # type: ignore[no-any-return]


def _bits_of_float(value: float, size: int) -> int:
    """Return the bits of a number as a float of `size` bytes."""
    with np.errstate(over="ignore"):
        return int(np.array(value).astype(f"f{size}").view(f"u{size}"))


def _write_decimal(value: np.floating[Any], form: str) -> bytes:
    """Return a float as a decimal fraction with at least the digits of `form`.

    The text is empty for nan.
    """
    if not np.isfinite(value):
        return b""
    whole, _, fraction = form.partition(".")
    text = np.format_float_positional(abs(value), trim="-")
    before, _, after = text.partition(".")
    after = after.ljust(len(fraction), "0")
    sign = "-" if np.signbit(value) else ""
    point = "." if after else ""
    return f"{sign}{before.rjust(len(whole), '0')}{point}{after}".encode()


class _TokenReader:
    """Reads the tokens of one frame.

    Args:
        stop: the offset of the end of the last token; None if it is missing.
    """

    def __init__(self, form: Tokens, data: bytes, stop: int | None) -> None:
        self._form = form
        self._data = data
        self._stop = stop
        self._text_count = 0
        self._optional_left = form.optional
        self.position = 1
        # Add a separator for the end after the last token.
        characters = np.frombuffer(data + form.sep, np.uint8)
        is_mark = characters == form.sep[0]
        is_mark[:1] = False
        is_mark[-1] = stop is not None
        #: The offset of the separator or the end after each token.
        self._marks = is_mark.nonzero()[0]
        self._begins = np.append(1, self._marks + 1)[: len(self._marks)]
        self._magnitudes = np.zeros(len(self._marks), np.uint64)
        self._is_number = np.zeros(len(self._marks), np.bool_)
        self._signs: NDArray[np.uint8] | None = None
        if len(self._marks):
            self._convert_numbers(characters)
            if b"+" in data or b"-" in data:
                self._convert_signed(characters[self._begins])

    def _convert_numbers(self, characters: NDArray[np.uint8]) -> None:
        """Store in `_magnitudes` the number of each token that consists of digits only.

        For all other tokens, `_is_number` is set to False.
        """
        values, is_digit = _make_digit_values(self._form.base)
        lengths = self._marks - self._begins
        body = characters[1 : self._marks[-1] + 1]
        distances = self._marks.repeat(lengths + 1) - np.arange(1, len(body) + 1)
        weights = _make_digit_weights(self._form.base).take(distances, mode="clip")
        self._magnitudes = np.add.reduceat(values[body] * weights, self._begins - 1)
        is_wrong = ~(is_digit[body] | (distances == 0))
        has_wrong = np.logical_or.reduceat(is_wrong, self._begins - 1)
        self._is_number = ~has_wrong & (lengths > 0) & (lengths <= MAX_DIGITS)

    def _convert_signed(self, first_characters: NDArray[np.uint8]) -> None:
        """Store the number of each token that is a sign and decimal digits."""
        self._signs = first_characters
        has_sign = (first_characters == PLUS) | (first_characters == MINUS)
        for index in np.flatnonzero(has_sign).tolist():
            digits = self._data[self._begins[index] + 1 : self._marks[index]]
            if digits.isdigit() and len(digits) <= MAX_DIGITS:
                self._magnitudes[index] = int(digits)
                self._is_number[index] = True

    def read(self, run: Run) -> tuple[bytes, Offsets]:
        if isinstance(run, NumberRun):
            return self._read_numbers(run)
        self._text_count += 1
        if self._text_count < self._form.joined:
            return self._read_joined(run)
        if self._form.padded:
            return self._read_padded(run)
        return self._read_text(run)

    def _read_text(self, run: TextRun) -> tuple[bytes, Offsets]:
        begin = self.position
        end = begin + run.size
        if end != self._stop and self._data[end : end + 1] != self._form.sep:
            return b"", np.zeros(0, np.intp)
        self.position = end + 1
        return self._data[begin:end], np.array([begin])

    def _read_joined(self, run: TextRun) -> tuple[bytes, Offsets]:
        """Read a field that has no separator after it."""
        begin = self.position
        text = self._data[begin : begin + run.size]
        if len(text) < run.size or self._form.sep in text:
            return b"", np.zeros(0, np.intp)
        self.position += run.size
        return text, np.array([begin])

    def _read_padded(self, run: TextRun) -> tuple[bytes, Offsets]:
        """Read a token that may be shorter than its field, or may be missing."""
        begin = self.position
        token = int(self._marks.searchsorted(begin))
        if token == len(self._marks):
            if self._stop is None or not self._optional_left:
                return b"", np.zeros(0, np.intp)
            self._optional_left -= 1
            return bytes(run.size), np.array([self._stop])
        is_rest = self._form.rest and self._text_count > self._form.joined
        end = self._marks.item(-1 if is_rest else token)
        if end - begin > run.size:
            return b"", np.zeros(0, np.intp)
        self.position = end + 1
        return self._data[begin:end].ljust(run.size, b"\x00"), np.array([begin])

    def _read_numbers(self, run: NumberRun) -> tuple[bytes, Offsets]:
        first = int(self._marks.searchsorted(self.position))
        tokens = slice(first, first + len(run))
        values = self._magnitudes[tokens]
        count = len(values)
        fits = values <= run.largest[:count]
        if self._signs is not None:
            is_negative = self._signs[tokens] == MINUS
            fits = np.where(self._signs[tokens] == PLUS, values <= run.highest[:count], fits)
            fits = np.where(is_negative, values <= run.lowest[:count], fits)
            values = np.where(is_negative, ~values + np.uint64(1), values)
        fits &= self._is_number[tokens]
        if self._form.base == 10:
            values = values.copy()
            for index in run.float_indices:
                if index < count:
                    bits = self._read_decimal(first + index, run.sizes.item(index))
                    fits[index] = bits is not None
                    values[index] = bits or 0
        if not fits.all():
            count = int(fits.argmin())
        if count:
            self.position = self._marks.item(first + count - 1) + 1
        return run.to_bytes(values[:count]), self._begins[first : first + count]

    def _read_decimal(self, token: int, size: int) -> int | None:
        """Return a decimal fraction as the bits of a float; None for an invalid token."""
        text = self._data[self._begins[token] : self._marks[token]]
        if not text:
            return _bits_of_float(np.nan, size)
        if len(text) > MAX_DECIMAL_CHARACTERS or not _DECIMAL.fullmatch(text):
            return None
        bits = _bits_of_float(float(text), size)
        if np.isinf(_float_of_bits(np.uint64(bits), size)):
            return None
        return bits


@dataclass(frozen=True)
class Echoes:
    """How the echoes of each step are sent: up to `most` echoes with a mark between them.

    A step is one direction of a scan. In the struct, each step has `most` echoes, and a missing
    echo is 0. When a step is encoded, echoes of 0 at its end are left out, except for the first
    echo.

    Args:
        size: the number of characters of an echo.
        most: the maximum number of echoes of a step.
        mark: the character between the echoes of a step; it must not be a digit.
    """

    size: int
    most: int
    mark: bytes = b"&"

    @cached_property
    def _step(self) -> re.Pattern[bytes]:
        """The pattern of one step, which is a sequence of echoes."""
        mark = re.escape(self.mark)
        echo = b"[^%b].{%d}" % (mark, self.size - 1)
        return re.compile(b"%b(?:%b%b){0,%d}" % (echo, mark, echo, self.most - 1), re.DOTALL)

    def expand(
        self, characters: bytes, offsets: Offsets, end: int, zero: bytes, *, is_whole: bool
    ) -> tuple[bytes, Offsets]:
        """Insert the echoes that were not sent.

        Args:
            offsets: the offsets of the characters in the frame, (n,).
            end: the offset after the last character.
            zero: the character that is repeated for a missing echo.
            is_whole: whether `characters` has all characters of the frame.

        Returns:
            The characters with all echoes, and the offset of each character.
        """
        stride = self.size + len(self.mark)
        step_sizes = np.array([len(step) for step in self._find_steps(characters)], np.intp)
        ends = np.cumsum(step_sizes)
        begin = int(step_sizes.sum())
        counts = -(-step_sizes // stride)
        numbers = np.arange(self.most)
        is_sent = np.repeat(numbers < counts[:, None], self.size, axis=1)
        within_step = stride * numbers[:, None] + np.arange(self.size)
        indices = (ends - step_sizes)[:, None] + within_step.reshape(-1)
        digits = np.frombuffer(characters + zero, np.uint8)
        steps: bytes = digits[np.where(is_sent, indices, -1)].tobytes()
        places = np.append(offsets, end)[np.where(is_sent, indices, ends[:, None])].reshape(-1)
        rest = characters[begin:]
        last_count = counts.item(-1) if len(counts) else self.most
        if last_count < self.most and self._begins_echo(rest, is_whole=is_whole):
            # The last step continues with a truncated echo, so none of its echoes is missing.
            size = len(steps) - (self.most - last_count) * self.size
            steps = steps[:size]
            places = places[:size]
            begin += len(self.mark)
        return steps + characters[begin:], np.append(places, offsets[begin:])

    def _find_steps(self, characters: bytes) -> list[bytes]:
        """Return the complete steps at the start of the characters."""
        steps = re.match(b"(?:%b)*" % self._step.pattern, characters, re.DOTALL)
        return [step[0] for step in self._step.finditer(steps[0])] if steps else []

    def _begins_echo(self, characters: bytes, *, is_whole: bool) -> bool:
        """Return whether characters begin with a mark and an echo."""
        if not characters.startswith(self.mark):
            return False
        following = characters[len(self.mark) : len(self.mark) + 1]
        if following:
            return following != self.mark
        return not is_whole

    def join(self, characters: bytes, zero: bytes) -> bytes:
        """Return the characters of steps as they are sent, with marks between echoes.

        Raises:
            SpecError: if the length of `characters` is not a multiple of a step.
        """
        room = self.most * self.size
        if len(characters) % room:
            raise SpecError(
                f"expected a multiple of {room} characters after the head ({self.most} echoes of"
                f" {self.size} characters), got {len(characters)}",
                path="wire",
            )
        echoes = np.frombuffer(characters, np.uint8).reshape(-1, self.most, self.size)
        has_value = (echoes != zero[0]).any(axis=2)
        # An echo is sent if it or a later echo of its step is not 0. The first is always sent.
        is_sent = np.logical_or.accumulate(has_value[:, ::-1], axis=1)[:, ::-1]
        is_sent[:, 0] = True
        marks = np.full((*is_sent.shape, 1), self.mark[0], np.uint8)
        sent = np.concatenate([marks, echoes], axis=2)
        is_kept = np.repeat(is_sent[:, :, None], 1 + self.size, axis=2)
        is_kept[:, 0, 0] = False
        joined: bytes = sent[is_kept].tobytes()
        return joined


@dataclass(frozen=True)
class SixBits:
    """Numbers in characters of six bits each, the highest bits first.

    It is used as ``Lines(...) | SixBits()``. A number of n bytes is sent as n characters: an
    `Int16ub` as two, an `Int24ub` as three, and an `Int32ub` as four characters. Only the lowest
    6 * n bits of the number are sent. The value of a character is its code minus the code of
    `first`. With the default, the characters "0" to "9" therefore have the values 0 to 9.

    Args:
        first: the character for 0.
        echoes: the encoding of steps with a variable number of echoes; None if the frame has no
            such steps.

    Raises:
        SpecError: for invalid `echoes`: the mark is not a single character, the mark is a digit, or
            `size` or `most` is below 1.
    """

    first: bytes = b"0"
    echoes: Echoes | None = None

    def __post_init__(self) -> None:
        each = self.echoes
        if each is not None and (
            len(each.mark) != 1
            or each.mark[0] - self.first[0] in range(1 << CHARACTER_BITS)
            or min(each.size, each.most) < 1
        ):
            raise SpecError(
                "the mark between echoes must be one character that is not a digit, and `size` and"
                " `most` must be at least 1",
                path="wire",
            )

    def encode(self, struct: bytes, runs: Sequence[Run]) -> bytes:
        """Return the characters of a struct; the highest bits of large numbers are lost."""
        parts = list[bytes]()
        offset = 0
        for run in runs:
            part = struct[offset : offset + int(run.sizes.sum())]
            offset += len(part)
            if isinstance(run, NumberRun):
                shifts = (CHARACTER_BITS * run.remaining).astype(np.uint64)
                digits = run.from_bytes(part)[run.owners] >> shifts
                digits &= np.uint64((1 << CHARACTER_BITS) - 1)
                part = (digits.astype(np.uint8) + self.first[0]).tobytes()
            parts.append(part)
        return b"".join(parts)


class _SixBitReader:
    """Reads numbers of `SixBits` from characters.

    Args:
        offsets: the offsets of the characters in the frame, (n,).
    """

    def __init__(self, form: SixBits, characters: bytes, offsets: Offsets, end: int) -> None:
        self._characters = characters
        self._digits = np.frombuffer(characters, np.uint8) - np.uint8(form.first[0])
        self._offsets = offsets
        self._end = end
        self._index = 0

    @property
    def position(self) -> int:
        if self._index < len(self._offsets):
            return self._offsets.item(self._index)
        return self._end

    def read(self, run: Run) -> tuple[bytes, Offsets]:
        if isinstance(run, TextRun):
            return self._read_text(run)
        return self._read_numbers(run)

    def _read_text(self, run: TextRun) -> tuple[bytes, Offsets]:
        text = self._characters[self._index : self._index + run.size]
        if len(text) < run.size:
            return b"", np.zeros(0, np.intp)
        begins = self._offsets[self._index : self._index + 1]
        self._index += run.size
        return text, begins

    def _read_numbers(self, run: NumberRun) -> tuple[bytes, Offsets]:
        digits = self._digits[self._index : self._index + run.ends.item(-1)]
        is_wrong = digits >= 1 << CHARACTER_BITS
        if is_wrong.any():
            size = int(is_wrong.argmax())
        else:
            size = len(digits)
        count = int(run.ends.searchsorted(size, "right"))
        size = run.ends.item(count - 1) if count else 0
        begins = run.ends[:count] - run.sizes[:count]
        shifts = (CHARACTER_BITS * run.remaining[:size]).astype(np.uint64)
        values = np.zeros(0, np.uint64)
        if count:
            values = np.add.reduceat(digits[:size].astype(np.uint64) << shifts, begins)
        offsets = self._offsets[self._index + begins]
        self._index += size
        return run.to_bytes(values), offsets


@dataclass(frozen=True)
class Scip:
    """The check character of SCIP: the lowest six bits of the sum of a line's characters.

    The bits are sent as one character: "0" for 0, and the following characters of ASCII for larger
    numbers.

    Source: SCIP 2.0, C-42-03320B, 5.
    """

    def __call__(self, line: bytes) -> int:
        """Return the check character of a line."""
        return (sum(line) & 0x3F) + 0x30


@dataclass(frozen=True)
class Lines:
    """A head and further lines of one length, followed by an empty line.

    ``Lines(...) | SixBits()`` declares how numbers are encoded.

    Args:
        width: the number of characters of each line after the head, without its check character.
            The last line may be shorter.
        head: the number of characters of each line of the head.
        bare: the number of lines at the start of the frame that have no check character.
        check: a function from a line to its check character, for example `Scip`; None if lines have
            no check characters.
        numbers: how numbers are encoded; None for unchanged bytes.

    Raises:
        SpecError: if a line has no characters, or if `numbers` has echoes but there is no head.
    """

    is_text: ClassVar[bool] = True
    width: int
    head: tuple[int, ...] = ()
    bare: int = 0
    check: Scip | None = None
    numbers: SixBits | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "head", tuple(self.head))
        if self.width < 1 or min(self.head, default=1) < 1 or not 0 <= self.bare <= len(self.head):
            raise SpecError(
                "`width` and the numbers in `head` must be at least 1, and `bare` must be from 0 to"
                " the length of `head`",
                path="wire",
            )
        if self.numbers is not None and self.numbers.echoes is not None and not self.head:
            raise SpecError(
                "the numbers have echoes, which requires a head: pass head= to Lines",
                path="wire",
            )

    def __or__(self, numbers: SixBits) -> Lines:
        return replace(self, numbers=numbers)

    def begins(self, texts: Sequence[Characters]) -> Characters:
        characters = list(itertools.chain(*texts))
        if not self.head:
            return characters[: self.width]
        size = self.head[0]
        known = characters[:size]
        unknown = [None] * (size - len(known) + self._has_check(0))
        return [*known, *unknown, NEWLINE]

    def find_end(self, data: bytes) -> int:
        end = data.find(b"\n\n")
        if end >= 0:
            return end + 2
        return NO_END

    def find_ends(self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets) -> Offsets:
        """Return the size of each frame; `NO_FRAME` if a line of it has a wrong length."""
        newlines = np.flatnonzero(buffer == NEWLINE)
        steps = np.diff(newlines, prepend=0)
        ends = find_next_offsets(newlines[:-1][steps[1:] == 1], offsets, len(buffer))
        has_end = ends + 2 <= stops
        # The newlines at the ends of the first and the last complete line.
        first = newlines.searchsorted(offsets)
        last = newlines.searchsorted(np.where(has_end, ends + 1, stops)) - 1
        is_frame = np.ones(len(offsets), np.bool_)
        places = np.append(newlines, [len(buffer)] * (len(self.head) + 1))
        for number, place in enumerate(self._head_ends):
            is_missing = first + number > last
            is_frame &= np.where(
                is_missing,
                has_end | (offsets + place >= stops),
                places[first + number] == offsets + place,
            )
        # All lines after the head have one length, except the last line, which may be shorter.
        length = self.width + (self.check is not None) + 1
        right_before = np.append(0, np.cumsum(steps == length))
        begin = first + max(len(self.head), 1)
        body = np.flatnonzero(last >= begin)
        begin = begin[body]
        last = last[body]
        number_right = right_before[last] - right_before[begin]
        is_frame[body] &= (number_right == last - begin) & (steps[last] <= length)
        sizes = np.where(has_end, ends + 2 - offsets, NO_END)
        sizes[~is_frame] = NO_FRAME
        return sizes

    @cached_property
    def _head_ends(self) -> Sequence[int]:
        """The offset in a frame at which each line of the head ends."""
        lengths = [size + self._has_check(number) + 1 for number, size in enumerate(self.head)]
        return [end - 1 for end in itertools.accumulate(lengths)]

    def _has_check(self, number: int) -> bool:
        return self.check is not None and number >= self.bare

    def decode(self, data: bytes, next_runs: NextRuns) -> Decoded:
        characters, offsets, problem = self._strip(data)
        is_whole = data.endswith(b"\n\n")
        if is_whole:
            end = len(data)
        else:
            end = int(offsets[-1:].sum()) + 1
        end_mark = end - 1 if is_whole else end
        if self.numbers is None:
            spans = [(offsets, np.ones(len(offsets), np.intp))]
            return Decoded(characters, spans, end_mark, problem)
        if self.numbers.echoes is not None:
            size = sum(self.head)
            steps, places = self.numbers.echoes.expand(
                characters[size:], offsets[size:], end_mark, self.numbers.first, is_whole=is_whole
            )
            characters = characters[:size] + steps
            offsets = np.append(offsets[:size], places)
        reader = _SixBitReader(self.numbers, characters, offsets, end)
        decoded = decode_runs(reader, next_runs, len(data) if is_whole else None)
        if problem is None:
            return decoded
        return replace(decoded, problem=problem)

    def _strip(self, data: bytes) -> tuple[bytes, Offsets, Problem | None]:
        """Remove newlines and check characters.

        Returns:
            The characters up to the first line with a wrong length, the offset of each character,
            and the first error or None.
        """
        *lines, _ = data.split(b"\n")
        if lines and not lines[-1]:
            lines.pop()  # the empty line at the end
        texts = list[bytes]()
        problem = None
        begin = 0
        for number, line in enumerate(lines):
            has_check = self._has_check(number)
            text = line[:-1] if has_check else line
            if number < len(self.head):
                length = self.head[number]
            else:
                length = self.width
            is_shorter_last = number == len(lines) - 1 >= len(self.head) and 0 < len(text) < length
            if len(text) != length and not is_shorter_last:
                reason = f"line {number + 1} has {len(text)} characters, expected {length}"
                problem = Problem(begin, reason)
                break
            if self.check is not None and has_check and self.check(text) != line[-1]:
                reason = f"the check character of line {number + 1} is wrong"
                problem = problem or Problem(begin + len(text), reason, is_checksum=True)
            texts.append(text)
            begin += len(line) + 1
        characters = np.frombuffer(data, np.uint8)[:begin]
        is_kept = characters != NEWLINE
        if self.check is not None:
            is_kept[np.flatnonzero(~is_kept)[self.bare :] - 1] = False
        return b"".join(texts), np.flatnonzero(is_kept), problem

    def encode(self, struct: bytes, runs: Sequence[Run]) -> bytes:
        characters = struct
        if self.numbers is not None:
            characters = self.numbers.encode(struct, runs)
            if self.numbers.echoes is not None:
                size = sum(self.head)
                steps = self.numbers.echoes.join(characters[size:], self.numbers.first)
                characters = characters[:size] + steps
        lines = list[bytes]()
        begin = 0
        while begin < len(characters):
            number = len(lines)
            if number < len(self.head):
                length = self.head[number]
            else:
                length = self.width
            line = characters[begin : begin + length]
            begin += length
            if self.check is not None and self._has_check(number):
                line += bytes([self.check(line)])
            lines.append(line)
        return b"\n".join([*lines, b"", b""])

    def largest(self, size: int) -> int:
        return int((256 if self.numbers is None else 1 << CHARACTER_BITS) ** size - 1)


@dataclass(frozen=True)
class Escaped:
    """Frames between two flags, with escaped bytes (as in HDLC).

    A flag or an escape byte in the content is sent as an escape byte, followed by the byte with
    some bits inverted. Two consecutive frames do not share a flag.

    Args:
        flag: the byte before and after a frame.
        escape: the escape byte.
        xor: the bits that are inverted in an escaped byte.

    Raises:
        SpecError: if flag and escape byte are equal, or if an escaped byte can be one of them.
    """

    is_text: ClassVar[bool] = False
    flag: int = 0x7E
    escape: int = 0x7D
    xor: int = 0x20

    def __post_init__(self) -> None:
        special = {self.flag, self.escape}
        if (
            len(special) < 2
            or not all(0 <= byte <= 0xFF for byte in (*special, self.xor))
            or special & {b ^ self.xor for b in special}
        ):
            raise SpecError(
                "flag and escape must be two different bytes, and after XOR with `xor`"
                " neither of them may be equal to the flag or the escape",
                path="wire",
            )

    def begins(self, texts: Sequence[Characters]) -> Characters:
        return [self.flag]  # any byte after it may be escaped

    def find_end(self, data: bytes) -> int:
        end = data.find(self.flag, 1)
        if end == 1:
            return NO_FRAME
        if end > 0:
            return end + 1
        return NO_END

    def find_ends(self, buffer: NDArray[np.uint8], offsets: Offsets, stops: Offsets) -> Offsets:
        ends = find_next_offsets(np.flatnonzero(buffer == self.flag), offsets + 1, len(buffer))
        sizes = np.where(ends < stops, ends + 1 - offsets, NO_END)
        sizes[(ends == offsets + 1) & (ends < stops)] = NO_FRAME
        return sizes

    def decode(self, data: bytes, next_runs: NextRuns) -> Decoded:
        end = data.find(self.flag, 1)
        body = np.frombuffer(data[1:end] if end > 0 else data[1:], np.uint8)
        is_escape = body == self.escape
        is_escaped = np.append(False, is_escape)[: len(body)]
        is_wrong = is_escape & np.append(is_escaped[1:] & is_escape[1:], True)[: len(body)]
        problem = None
        if is_wrong.any():
            problem = Problem(
                1 + int(is_wrong.argmax()), "an escape is not followed by a valid byte"
            )
        places = np.flatnonzero(~is_escape)
        struct = body[places] ^ (is_escaped[places] * np.uint8(self.xor))
        spans = [(1 + places - is_escaped[places], np.ones(len(places), np.intp))]
        return Decoded(struct.tobytes(), spans, 1 + len(body), problem)

    def encode(self, struct: bytes, runs: Sequence[Run]) -> bytes:
        frame = bytearray([self.flag])
        for byte in struct:
            if byte in (self.flag, self.escape):
                frame += bytes([self.escape, byte ^ self.xor])
            else:
                frame.append(byte)
        frame.append(self.flag)
        return bytes(frame)

    def largest(self, size: int) -> int:
        return int(256**size - 1)
