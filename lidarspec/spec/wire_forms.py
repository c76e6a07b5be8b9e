"""Wire forms: what stands on the wire where a number has no fixed place, as text, in lines,
escaped; both ways, in bulk.

A form frames by marks of its own and turns many candidates into rows, in which each field of the
struct has its slot, its own bytes; and rows back into what is sent. Nothing else of the engine
knows of it: layouts, checksums, plans and simulation work on the rows.

A form of a plugin (varints, packed messages) is any object with the two functions of `WireForm`;
what most of them need is in `Unescaped`, which reads frames whose bytes only have to be collected.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError

Bytes1D = NDArray[np.uint8]
Bytes2D = NDArray[np.uint8]
Numbers = NDArray[np.intp]
#: the bytes of a text, None for each that may be any.
Characters = Sequence[int | None]

#: what `Reading.sizes` says of candidates without an end so far, and of those that are no frames.
SHORT, NONE = 0, -1
#: tokens that are read at once, so that they stay in the cache; elements of an array that is read
#: by itself, as others are longer.
AT_ONCE, MANY = 1 << 14, 16
#: what stands for a character that is no digit.
NO_DIGIT = 0xFF
#: from each count of bytes the mask that leaves so many of eight.
KEPT = np.array([(1 << 8 * count) - 1 for count in range(9)], np.uint64)


@dataclass(frozen=True)
class Slot:
    """Fields of one kind, one behind the other in a row.

    Attributes:
        kind: "text" for bytes; else numbers of that kind.
        size: the bytes of each.
        count: how many.
        little: whether their bytes come lowest first.
    """

    kind: Literal["text", "uint", "int", "float"]
    size: int
    count: int = 1
    little: bool = False

    def numbers(self, part: Bytes2D) -> NDArray[np.uint64]:
        """The bits of the numbers in their part of the rows, (n, count)."""
        wide = np.zeros((len(part), self.count, 8), np.uint8)
        each = part.reshape(len(part), self.count, self.size)
        wide[:, :, 8 - self.size :] = each[:, :, ::-1] if self.little else each
        return wide.view(">u8")[:, :, 0].astype(np.uint64)


class Reading(Protocol):
    """Candidates in one buffer, as a form reads them.

    Attributes:
        sizes: their bytes, marks included, (n,); `SHORT` where the end is not there yet, `NONE`
            where they are no frames.
        intact: whether checks that are the form's own are right, (n,); None where it has none.
    """

    sizes: Numbers
    intact: NDArray[np.bool_] | None

    def rows(self, at: Numbers, stops: Numbers, slots: Sequence[Slot]) -> tuple[Bytes2D, Numbers]:
        """The slots that follow from places in the buffer on.

        Args:
            at: where in the buffer each candidate is read on, (n,): at first behind
                `WireForm.start`, then where it was left.
            stops: where each ends, marks included, (n,).

        Returns:
            Their bytes, (n, sum of size * count); and where each goes on, (n,): `stops` where
            nothing follows, `NONE` where a slot cannot be read.
        """

    def starts(self, at: int, slots: Sequence[Slot]) -> Numbers:
        """Where each of the slots begins that follow from a place in the buffer on and can be read,
        one for each of their `count`.
        """


class WireForm(Protocol):
    """How frames stand on the wire.

    Attributes:
        start: the bytes that each begins with, before its first slot.
        is_text: whether its bytes are characters, so that examples of text are letters.
    """

    is_text: ClassVar[bool]

    @property
    def start(self) -> bytes: ...

    def begins(self, texts: Sequence[Characters]) -> Characters:
        """The first bytes on the wire of frames that begin with these texts, as far as the place of
        each is always the same.
        """

    def read(self, buffer: Bytes1D, starts: Numbers, limit: int) -> Reading:
        """Rows out of bytes: the candidates that begin at `starts`, (n,) ascending, of at most
        `limit` bytes.
        """

    def write(self, rows: Bytes2D, slots: Sequence[Slot]) -> list[bytes]:
        """Bytes out of rows, (n, size): each frame as it is sent. What cannot be written is read
        back as something else.
        """

    def largest(self, slot: Slot) -> int:
        """The largest number that can be written for a slot, as bits."""


def ended(starts: Numbers, ends: Numbers, limit: int, length: int) -> Numbers:
    """The bytes from each start to the end mark behind it, that included, as `Reading.sizes` has
    them.

    Args:
        ends: the last bytes of marks, ascending.
        length: of the buffer.
    """
    if not len(ends):
        return np.where(length - starts >= limit, NONE, SHORT)
    index = ends.searchsorted(starts, "right")
    sizes = ends[np.minimum(index, len(ends) - 1)] - starts + 1
    missing = index == len(ends)
    sizes[missing] = length - starts[missing]
    return np.where(
        (sizes > limit) | (missing & (sizes >= limit)), NONE, np.where(missing, SHORT, sizes)
    )


@lru_cache(maxsize=64)
def _digits(base: int, first: int | None = None) -> NDArray[np.uint8]:
    """The value of each character as a digit: 0 to 9 and letters of both cases, or characters in a
    row from `first` on.
    """
    values = np.full(256, NO_DIGIT, np.uint8)
    if first is not None:
        values[first : first + base] = np.arange(base)
        return values
    for value, character in enumerate("0123456789ABCDEF"[:base]):
        values[ord(character)] = values[ord(character.lower())] = value
    return values


def _combined(digits: NDArray[Any], base: int) -> NDArray[Any]:
    """The numbers of four or eight digits each, one a byte, the first highest."""
    number = digits.dtype.type
    for width, mask in (
        (8, 0x00FF00FF00FF00FF),
        (16, 0x0000FFFF0000FFFF),
        (32, 0x00000000FFFFFFFF),
    )[: digits.itemsize // 4 + 1]:
        kept = number(mask & (1 << 8 * digits.itemsize) - 1)
        high = digits >> number(width)
        high &= kept
        high *= number(base)
        digits = digits & kept
        digits += high
        base *= base
    return digits


@dataclass(frozen=True)
class Tokens:
    """Text in tokens: numbers in digits, each followed by a separator or the end; bytes of a struct
    as their characters.

    A number may have zeros in front, small letters, or a sign, which makes it decimal whatever the
    base; signed and float fields without a sign are the digits of their bits. A field of bytes is a
    token of just so many characters, which may contain the separator.

    Args:
        start, sep, end: one byte each, that the frame begins with, that separates tokens, and that
            it ends with.
        base: of the digits, 10 or 16.
        width: digits that are written at least; others are read as well.

    Raises:
        SpecError: for marks that are not one byte, or alike, and other bases.
    """

    is_text: ClassVar[bool] = True
    start: bytes
    sep: bytes = b" "
    end: bytes = b"\x03"
    base: int = 16
    width: int = 0

    def __post_init__(self) -> None:
        marks = (self.start, self.sep, self.end)
        if any(len(mark) != 1 for mark in marks) or len(set(marks)) < 3:
            raise SpecError(
                "the start, the separator and the end of tokens are one byte each, and differ",
                path="wire",
            )
        if self.base not in (10, 16):
            raise SpecError(
                f"digits are decimal or hexadecimal, not of base {self.base}", path="wire"
            )

    def begins(self, texts: Sequence[Characters]) -> Characters:
        return [
            *self.start,
            *[byte for text in texts if len(text) for byte in (*text, self.sep[0])][:-1],
        ]

    def read(self, buffer: Bytes1D, starts: Numbers, limit: int) -> Reading:
        return _TokenReading(self, buffer, starts, limit)

    def write(self, rows: Bytes2D, slots: Sequence[Slot]) -> list[bytes]:
        number, first = len(rows), 0
        characters, used = [_repeated(self.start, (number, 1))], [np.ones((number, 1), np.bool_)]
        for is_text, run in itertools.groupby(
            (slot for slot in slots if slot.size), lambda slot: slot.kind == "text"
        ):
            for some in ((slot,) for slot in run) if is_text else (tuple(run),):
                part = rows[
                    :, first : (first := first + sum(slot.size * slot.count for slot in some))
                ]
                written, told = self._texts(part, some[0]) if is_text else self._numbers(part, some)
                ends = _repeated(self.sep, (*written.shape[:2], 1))
                characters += [np.concatenate([written, ends], axis=2).reshape(number, -1)]
                used += [
                    np.concatenate([told, np.ones(ends.shape, np.bool_)], axis=2).reshape(
                        number, -1
                    )
                ]
        whole, which = np.concatenate(characters, axis=1), np.concatenate(used, axis=1)
        whole[:, -1] = self.end[0]
        return _pieces(whole, which)

    def largest(self, slot: Slot) -> int:
        return int(256**slot.size - 1)

    def _texts(self, part: Bytes2D, slot: Slot) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        texts = part.reshape(len(part), slot.count, slot.size)
        return texts, np.ones(texts.shape, np.bool_)

    def _numbers(
        self, part: Bytes2D, run: tuple[Slot, ...]
    ) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """The characters of numbers, (n, count, most), and which of them are written."""
        fixed = _places(run)
        sizes = fixed.sizes
        wide = np.zeros((len(part), 8 * len(sizes)), np.uint8)
        wide[:, fixed.index] = part
        values = wide.view(">u8").astype(np.uint64)
        is_negative = np.zeros(values.shape, np.bool_)
        if self.base == 10:
            is_signed = fixed.lowest > 0
            is_negative = (values >> (8 * sizes - 1).astype(np.uint64)).astype(np.bool_) & is_signed
            values = np.where(is_negative, (~values + np.uint64(1)) & KEPT[sizes], values)
        most = max(
            len(f"{256 ** int(sizes.max()) - 1:{'X' if self.base == 16 else 'd'}}"), self.width
        )
        digits = np.empty((*values.shape, most), np.uint8)
        for place in range(most - 1, -1, -1):
            values, digits[:, :, place] = np.divmod(values, np.uint64(self.base))
        shown = np.logical_or.accumulate(digits != 0, axis=2)
        shown[:, :, most - max(self.width, 1) :] = True
        signs = np.full((*values.shape, 1), ord("-"), np.uint8)
        characters = np.concatenate(
            [signs, np.frombuffer(b"0123456789ABCDEF", np.uint8)[digits]], axis=2
        )
        return characters, np.concatenate([is_negative[:, :, None], shown], axis=2)


class _TokenReading:
    """Candidates of `Tokens` in one buffer."""

    intact: NDArray[np.bool_] | None = None

    def __init__(self, form: Tokens, buffer: Bytes1D, starts: Numbers, limit: int) -> None:
        self._form, self._buffer = form, buffer
        self._ends = np.flatnonzero(buffer == form.end[0])
        self.sizes = ended(starts, self._ends, limit, len(buffer))
        begins = np.flatnonzero(buffer == form.start[0])
        index = begins.searchsorted(starts, "right")
        again = np.append(begins, len(buffer))[
            index
        ]  # where the next frame begins, if it does before this one ends
        self.sizes[
            (again < len(buffer)) & (again - starts < np.where(self.sizes > 0, self.sizes, limit))
        ] = NONE

    @cached_property
    def _stops(self) -> Numbers:
        """Where tokens may end."""
        return np.flatnonzero(
            (self._buffer == self._form.sep[0]) | (self._buffer == self._form.end[0])
        )

    @cached_property
    def _digits(self) -> NDArray[np.uint8]:
        """The digits in the buffer, which begins 16 before it."""
        return np.concatenate([np.zeros(16, np.uint8), _digits(self._form.base)[self._buffer]])

    def _window(self, ends: Numbers, lengths: Numbers, width: int) -> NDArray[Any]:
        """The last digits, at most `width`, of tokens, one a byte."""
        windows: NDArray[Any] = np.ndarray(
            (len(self._digits) - width + 1,), f">u{width}", self._digits, 0, (1,)
        )
        found = windows[ends + (16 - width)].astype(f"u{width}")
        found &= KEPT.astype(f"u{width}")[np.minimum(lengths, width)]
        return found

    @cached_property
    def _has_signs(self) -> bool:
        return bool(
            np.count_nonzero(self._buffer == ord("+")) or np.count_nonzero(self._buffer == ord("-"))
        )

    def rows(self, at: Numbers, stops: Numbers, slots: Sequence[Slot]) -> tuple[Bytes2D, Numbers]:
        tokens = sum(slot.count for slot in slots)
        if not len(at) or not len(self._stops):
            return np.zeros(
                (len(at), sum(slot.size * slot.count for slot in slots)), np.uint8
            ), np.full(len(at), NONE)
        step = max(AT_ONCE // max(tokens, 1), 1)
        parts = [
            self._read(at[first : first + step], stops[first : first + step], slots)
            for first in range(0, len(at), step)
        ]
        if len(parts) == 1:
            return parts[0]
        rows, ends = zip(*parts, strict=True)
        return np.concatenate(rows), np.concatenate(ends)

    def starts(self, at: int, slots: Sequence[Slot]) -> Numbers:
        found = [np.zeros(0, np.intp)]
        for slot in slots:
            if slot.kind == "text":  # which may have a separator inside
                begins = at + (slot.size + 1 if slot.size else 0) * np.arange(slot.count + 1)
            else:
                first = self._stops.searchsorted(at)
                begins = np.append(at, self._stops[first : first + slot.count] + 1)
            found.append(begins[:-1])
            at = begins[-1]
        return np.concatenate(found)

    def _read(self, at: Numbers, stops: Numbers, slots: Sequence[Slot]) -> tuple[Bytes2D, Numbers]:
        parts = [np.empty((len(at), 0), np.uint8)]
        for (is_text, _), group in itertools.groupby(
            slots, lambda slot: (slot.kind == "text", slot if slot.count >= MANY else None)
        ):
            run = tuple(group)
            part, at = self._texts(at, stops, run) if is_text else self._numbers(at, stops, run)
            parts.append(part)
        return np.concatenate(parts, axis=1), at

    def _texts(self, at: Numbers, stops: Numbers, run: tuple[Slot, ...]) -> tuple[Bytes2D, Numbers]:
        parts = list[Bytes2D]()
        marks = (self._form.sep[0], self._form.end[0])
        for size in (slot.size for slot in run for _ in range(slot.count if slot.size else 0)):
            inside = (at >= 0) & (at + size < stops)
            at = np.where(inside, at, 0)
            parts.append(
                self._buffer[np.minimum(at[:, None] + np.arange(size), len(self._buffer) - 1)]
            )
            after = self._buffer[np.minimum(at + size, len(self._buffer) - 1)]
            at = np.where(inside & ((after == marks[0]) | (after == marks[1])), at + size + 1, NONE)
        return np.concatenate([np.empty((len(at), 0), np.uint8), *parts], axis=1), at

    def _numbers(
        self, at: Numbers, stops: Numbers, run: tuple[Slot, ...]
    ) -> tuple[Bytes2D, Numbers]:
        fixed = _places(run)
        number = len(fixed.sizes)
        index = self._stops.searchsorted(at)
        inside = (at >= 0) & (index + number <= len(self._stops))
        ends = self._stops[np.minimum(index[:, None] + np.arange(number), len(self._stops) - 1)]
        begins = np.empty_like(ends)
        begins[:, 0] = np.clip(at, 0, len(self._buffer) - 1)
        np.minimum(ends[:, :-1] + 1, len(self._buffer) - 1, out=begins[:, 1:])
        values, right = self._values(begins, ends, fixed)
        right = inside & (ends[:, -1] < stops) & right
        at = np.where(right, ends[:, -1] + 1, NONE)
        if len(run) == 1 and run[0].size in (1, 2, 4, 8):
            slot = run[0]
            return (
                values.astype(f"{'<' if slot.little else '>'}u{slot.size}")
                .view(np.uint8)
                .reshape(len(at), -1),
                at,
            )
        wide: NDArray[Any] = values.astype(">u8").view(np.uint8).reshape(len(at), -1)
        return wide.take(fixed.index, axis=1), at

    def _values(
        self, begins: Numbers, ends: Numbers, fixed: _Places
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """The numbers that tokens from `begins` to `ends` say, (n, k); and in which rows all are
        numbers that their slots hold, (n,).
        """
        base, lengths = self._form.base, ends - begins
        if self._has_signs and (signs := np.isin(self._buffer[begins], (ord("+"), ord("-")))).any():
            return self._signed(begins, ends, fixed, signs)
        longest, shortest = (int(lengths.max()), int(lengths.min())) if lengths.size else (1, 1)
        width = 4 if longest <= 4 else 8
        if shortest < 1 or longest > 16:
            lengths = np.clip(lengths, 0, 17)
        digits = self._window(ends, lengths, width)
        wrong = digits & digits.dtype.type(0xF0F0F0F0F0F0F0F0 & (1 << 8 * width) - 1)
        values = _combined(digits, base)
        if longest > 8:
            above = self._window(ends - 8, np.maximum(lengths - 8, 0), 8)
            wrong |= above & np.uint64(0xF0F0F0F0F0F0F0F0)
            values += _combined(above, base) * np.uint64(base**8)
        right = ~wrong.any(axis=1)
        if shortest < 1 or longest > 16:
            right &= ((lengths >= 1) & (lengths <= 16)).all(axis=1)
        if width == 8 or fixed.smallest < 2 or base != 16:
            right &= (values <= fixed.largest).all(axis=1)
        return values, right

    def _signed(
        self, begins: Numbers, ends: Numbers, fixed: _Places, signs: NDArray[np.bool_]
    ) -> tuple[NDArray[np.uint64], NDArray[np.bool_]]:
        """The same of tokens of which some have signs, and are decimal."""
        lengths = np.clip(ends - begins - signs, 0, 17)
        parts = (
            self._window(ends - 8, np.maximum(lengths - 8, 0), 8),
            self._window(ends, lengths, 8),
        )
        wrong = (parts[0] | parts[1]) & np.uint64(0xF0F0F0F0F0F0F0F0)
        letters = (
            (parts[0] + np.uint64(0x0606060606060606)) | (parts[1] + np.uint64(0x0606060606060606))
        ) & np.uint64(0x1010101010101010)
        values, tens = (
            _combined(parts[0], base) * np.uint64(base**8) + _combined(parts[1], base)
            for base in (self._form.base, 10)
        )
        minus = signs & (self._buffer[begins] == ord("-"))
        held = np.where(
            signs,
            (letters == 0) & (tens <= np.where(minus, fixed.lowest, fixed.highest)),
            values <= fixed.largest,
        )
        right = held & (wrong == 0) & (lengths >= 1) & (lengths <= 16)
        return np.where(signs, np.where(minus, ~tens + np.uint64(1), tens), values), right.all(
            axis=1
        )


@dataclass(frozen=True)
class _Places:
    """Where the bytes of numbers go: the index of each among theirs of eight bytes; the bytes of
    each; the largest number that it holds as bits, as a number above 0, and below it;
    the size of the smallest."""

    index: Numbers
    sizes: Numbers
    smallest: int
    largest: NDArray[np.uint64]
    highest: NDArray[np.uint64]
    lowest: NDArray[np.uint64]


@lru_cache(maxsize=1024)
def _places(run: tuple[Slot, ...]) -> _Places:
    each = [slot for slot in run for _ in range(slot.count)]
    spots = [
        range(8 * i + 8 - slot.size, 8 * i + 8)[:: -1 if slot.little else 1]
        for i, slot in enumerate(each)
    ]
    sizes, kinds = (
        np.array([slot.size for slot in each], np.intp),
        np.array([slot.kind for slot in each]),
    )
    largest = KEPT[sizes]
    half = largest >> np.uint64(1)
    lowest = np.where(kinds == "int", half + np.uint64(1), np.uint64(0))
    highest = np.where(
        kinds == "int", half, np.where(kinds == "uint", largest, np.uint64(0))
    )  # no float has a sign before its bits
    return _Places(
        np.array([spot for part in spots for spot in part], np.intp),
        sizes,
        int(sizes.min()),
        largest,
        highest,
        lowest,
    )


class Unescaped:
    """A `Reading` of frames whose bytes need only be collected, and their numbers perhaps be read
    from characters.

    Args:
        sizes, intact: as in `Reading`.
        places: where in the buffer the bytes stand that are collected, ascending.
        values: these bytes.
        numbers: how numbers are written; None where they are as they are.
    """

    def __init__(
        self,
        sizes: Numbers,
        places: Numbers,
        values: Bytes1D,
        intact: NDArray[np.bool_] | None = None,
        numbers: SixBits | None = None,
    ) -> None:
        self.sizes, self.intact, self.places, self.values, self.numbers = (
            sizes,
            intact,
            places,
            values,
            numbers,
        )

    def rows(self, at: Numbers, stops: Numbers, slots: Sequence[Slot]) -> tuple[Bytes2D, Numbers]:
        size, number = sum(slot.size * slot.count for slot in slots), len(self.places)
        first = self.places.searchsorted(at)
        inside = (at >= 0) & (first + size <= number)
        first = np.where(inside, first, 0)
        ends = np.append(self.places, np.iinfo(np.intp).max)  # where each byte stands, and none
        inside &= (size == 0) | (ends[np.minimum(first + max(size - 1, 0), number)] < stops)
        rows = np.zeros((len(at), size), np.uint8)
        if 0 < size <= number:
            windows: NDArray[Any] = np.ndarray(
                (number - size + 1,), f"V{size}", self.values, 0, (1,)
            )
            rows = windows[np.where(inside, first, 0)].view(np.uint8).reshape(len(at), size)
        follows = ends[np.minimum(first + size, number)]
        goes_on = np.where(inside, np.where(follows >= stops, stops, follows), NONE)
        if self.numbers is None or not rows.size:
            return rows, goes_on
        rows, right = self.numbers.read(rows, slots)
        return rows, np.where(right, goes_on, NONE)

    def starts(self, at: int, slots: Sequence[Slot]) -> Numbers:
        sizes = np.repeat([slot.size for slot in slots], [slot.count for slot in slots])
        found: Numbers = self.places[self.places.searchsorted(at) + np.cumsum(sizes) - sizes]
        return found


@dataclass(frozen=True)
class Echoes:
    """Steps of one to some echoes each, joined by a mark; in a row each step has places for all,
    and an echo that is missing is 0.

    An echo whose numbers are all 0 is not sent when none follows it in its step, but for the first.

    Args:
        size: the characters of an echo.
        most: echoes of a step.
        mark: a character that is no digit.
    """

    size: int
    most: int
    mark: bytes = b"&"

    def apart(
        self, places: Numbers, values: Bytes1D, begins: Numbers, ends: Numbers, zero: int
    ) -> tuple[Numbers, Bytes1D]:
        """Characters and where they stand, with all echoes of all steps in their places.

        Args:
            begins, ends: in the buffer, of what stands behind the head of each frame, (n,)
                ascending; of frames in one another the first counts.
            zero: what stands for a character that is missing.
        """
        pieces, done = list[tuple[Numbers, Bytes1D]](), 0
        for begin, end, stop in zip(
            places.searchsorted(begins), places.searchsorted(ends), ends - 1, strict=True
        ):
            if begin >= done:
                steps = self._steps(places[begin:end], values[begin:end], stop, zero)
                pieces += [(places[done:begin], values[done:begin]), steps]
                done = end
        at, characters = zip(*pieces, (places[done:], values[done:]), strict=True)
        return np.concatenate(at), np.concatenate(characters)

    def _steps(
        self, places: Numbers, values: Bytes1D, stop: int, zero: int
    ) -> tuple[Numbers, Bytes1D]:
        """The same of the steps of one frame; a mark that joins no echoes stays, where no number
        can be read.

        A missing echo stands where the next one does that is there, or at `stop`.
        """
        marks = np.flatnonzero(values == self.mark[0])
        number = np.arange(len(marks))
        before = marks - number  # characters, without marks
        goes_on = np.diff(before, prepend=0) == self.size
        echo = number - np.maximum.accumulate(np.where(goes_on, 0, number)) + 1
        follows = np.append(values, self.mark[0])[marks + 1]
        right = (
            (before > 0)
            & (before % self.size == 0)
            & (echo < self.most)
            & (follows != self.mark[0])
        )
        used = np.ones(len(values), np.bool_)
        used[marks[right]] = False
        places, values = places[used], values[used]
        whole = len(values) // self.size
        nth = np.zeros(whole + 1, np.intp)  # of its step is each echo
        nth[before[right] // self.size] = echo[right]
        firsts = np.flatnonzero(nth[:whole] == 0)
        slots = (np.cumsum(nth[:whole] == 0) - 1) * self.most + nth[:whole]
        characters = np.full((len(firsts) * self.most, self.size), zero, np.uint8)
        characters[slots] = values[: whole * self.size].reshape(-1, self.size)
        spots = (
            np.append(places, stop)[self.size * np.append(firsts, whole)[1:]]
            .repeat(self.most * self.size)
            .reshape(-1, self.size)
        )
        spots[slots] = places[: whole * self.size].reshape(-1, self.size)
        rest = slice(whole * self.size, None)
        return np.append(spots, places[rest]), np.append(characters, values[rest])

    def joined(self, characters: Bytes2D, zero: int) -> list[bytes]:
        """The steps of each row as they are sent."""
        number, size = characters.shape
        if size % (self.most * self.size):
            raise SpecError(
                f"{size} characters behind the head are no steps of {self.most} echoes of"
                f" {self.size}",
                path="wire",
            )
        echoes = characters.reshape(number, -1, self.most, self.size)
        used = np.logical_or.accumulate((echoes != zero).any(axis=3)[:, :, ::-1], axis=2)[
            :, :, ::-1, None
        ].repeat(self.size + 1, axis=3)
        used[:, :, 0] = True
        used[:, :, 0, 0] = False  # no mark before the first
        marked = np.concatenate([_repeated(self.mark, (*echoes.shape[:3], 1)), echoes], axis=3)
        return _pieces(marked.reshape(number, -1), used.reshape(number, -1))


@dataclass(frozen=True)
class SixBits:
    """Numbers in characters of six bits each, the highest first, as many as the field has bytes;
    behind ``Lines(...) |``.

    `Int16ub` is two characters, `Int24ub` three, `Int32ub` four, and one character an `Int8ub`, by
    which decimal digits are read, too.

    Args:
        first: the character that is 0.
        echoes: how the steps behind the head are sent that have echoes; None where all numbers are.

    Raises:
        SpecError: for a mark of echoes that is a digit or more than one character, and for echoes
            without a character.
    """

    first: bytes = b"0"
    echoes: Echoes | None = None

    def __post_init__(self) -> None:
        each = self.echoes
        if each is not None and (
            len(each.mark) != 1
            or _digits(64, self.first[0])[each.mark[0]] < 64
            or min(each.size, each.most) < 1
        ):
            raise SpecError(
                "the mark between echoes is one character that is no digit, and an echo has at"
                " least one that is",
                path="wire",
            )

    def read(self, rows: Bytes2D, slots: Sequence[Slot]) -> tuple[Bytes2D, NDArray[np.bool_]]:
        """Rows with numbers in place of their characters; and in which all are digits, (n,)."""
        values, right, start = _digits(64, self.first[0])[rows], np.ones(len(rows), np.bool_), 0
        made = rows.copy()
        for slot in slots:
            part = slice(start, start := start + slot.size * slot.count)
            if slot.kind != "text" and slot.count:
                digits = values[:, part].reshape(len(rows), slot.count, slot.size)
                right &= (digits < 64).all(axis=(1, 2))
                made[:, part] = self._bytes(digits, slot).reshape(len(rows), -1)
        return made, right

    @staticmethod
    def _bytes(digits: NDArray[np.uint8], slot: Slot) -> NDArray[np.uint8]:
        """The bytes of numbers of these digits, (n, count, size)."""
        total = np.zeros(digits.shape[:2], np.uint64 if slot.size > 4 else np.uint32)
        for place in range(slot.size):
            total = (total << total.dtype.type(6)) | digits[:, :, place]
        wide = (
            total.astype(total.dtype.newbyteorder(">"))
            .view(np.uint8)
            .reshape(*digits.shape[:2], -1)[:, :, total.itemsize - slot.size :]
        )
        return wide[:, :, ::-1] if slot.little else wide

    def write(self, rows: Bytes2D, slots: Sequence[Slot]) -> Bytes2D:
        """Rows with the characters of numbers in their place; of larger ones the low bits."""
        made, start = rows.copy(), 0
        for slot in slots:
            part = slice(start, start := start + slot.size * slot.count)
            if slot.kind != "text":
                shifts = np.arange(6 * slot.size - 6, -1, -6, dtype=np.uint64)
                digits = slot.numbers(rows[:, part])[:, :, None] >> shifts & np.uint64(63)
                made[:, part] = (digits.astype(np.uint8) + self.first[0]).reshape(len(rows), -1)
        return made


@dataclass(frozen=True)
class Scip:
    """The check character of SCIP: six bits of the sum of a line's characters, from "0" on (SCIP
    2.0, C-42-03320B, 5).
    """

    def __call__(self, sums: NDArray[np.int64]) -> NDArray[np.uint8]:
        """The characters for the sums of lines."""
        return (sums & 0x3F).astype(np.uint8) + np.uint8(0x30)


@dataclass(frozen=True)
class Lines:
    """Text in lines of one length, behind some of their own; a frame ends with an empty line. ``|
    SixBits()`` says how numbers stand in it.

    Args:
        width: the characters of each line but the last, without its check.
        head: the characters of the first lines, which have lengths of their own.
        bare: how many of the first lines have no check character.
        check: from the sums of lines to their check characters, such as `Scip`; None where there
            are none.
        numbers: how numbers are written; None for bytes as they are.

    Raises:
        SpecError: for lines without a character, and for echoes without a head before them.
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
                "lines have at least one character, and those without a check are among the first",
                path="wire",
            )
        if self.numbers is not None and self.numbers.echoes is not None and not self.head:
            raise SpecError(
                "steps with echoes stand behind the head of a frame, and these lines have none",
                path="wire",
            )

    def __or__(self, numbers: SixBits) -> Lines:
        return replace(self, numbers=numbers)

    @property
    def start(self) -> bytes:
        return b""

    def begins(self, texts: Sequence[Characters]) -> Characters:
        first = self.head[0] if self.head else self.width
        known = list(itertools.chain(*texts))[:first]
        end = first + (self.check is not None and not self.bare)
        return [*known, *[None] * (end - len(known)), 0x0A] if self.head else known

    def read(self, buffer: Bytes1D, starts: Numbers, limit: int) -> Reading:
        stops = np.flatnonzero(buffer == 0x0A)
        ends = stops[1:][np.diff(stops) == 1]
        sizes = ended(starts, ends, limit, len(buffer))
        whole = np.flatnonzero(sizes > 0)
        first, last = self._lines(starts[whole], starts[whole] + sizes[whole] - 1, stops)
        sizes[whole[first < 0]] = NONE
        whole, first, last = whole[first >= 0], first[first >= 0], last[first >= 0]
        kept, intact = buffer != 0x0A, np.ones(len(starts), np.bool_)
        kept[stops[-1] + 1 if len(stops) else 0 :] = (
            False  # a line without an end: nobody knows what is its check
        )
        cut = starts[sizes == SHORT]  # for who explains it
        heads = np.concatenate([first, stops.searchsorted(cut)])
        if self.check is not None:
            checked = np.ones(len(stops), np.bool_)
            bare = (heads[:, None] + np.arange(self.bare)).reshape(-1)
            checked[bare[bare < len(stops)]] = False
            checked &= stops > 0
            kept[stops[checked] - 1] = False
            intact[whole] = self._intact(buffer, starts[whole], stops, first, last)
        places = np.flatnonzero(kept)
        values = buffer[places]
        if self.numbers is not None and self.numbers.echoes is not None:
            ends = np.concatenate([starts[whole] + sizes[whole], np.full(len(cut), len(buffer))])
            begins = np.append(stops + 1, len(buffer))[
                np.minimum(heads + len(self.head) - 1, len(stops))
            ]
            places, values = self.numbers.echoes.apart(
                places, values, begins, ends, self.numbers.first[0]
            )
        return Unescaped(sizes, places, values, intact, self.numbers)

    def _lines(self, starts: Numbers, ends: Numbers, stops: Numbers) -> tuple[Numbers, Numbers]:
        """Among `stops`, the end of the first line of each frame and the one after its last; -1
        where lines have other lengths.
        """
        marks = np.append(stops, -1)
        first, check = stops.searchsorted(starts), int(self.check is not None)
        right, begin, index = np.ones(len(starts), np.bool_), starts, first
        for number, length in enumerate(self.head):
            begin = begin + length + check * (number >= self.bare) + 1
            right &= (marks[np.minimum(index, len(stops))] == begin - 1) & (begin <= ends)
            index = index + 1
        step = self.width + check + 1
        left = np.maximum(ends - begin, 0)
        full, rest = left // step, left % step
        uneven = (
            np.maximum.accumulate(
                np.where(np.diff(stops, prepend=-1) != step, np.arange(len(stops)), -1)
            )
            if len(stops)
            else stops
        )
        inner = np.minimum(index + full - 1, len(stops) - 1)
        right &= (full == 0) | (
            (marks[np.minimum(index, len(stops))] == begin + step - 1)
            & ((full == 1) | (uneven[inner] <= index))
        )
        right &= (rest == 0) | (
            (rest >= check + 2) & (marks[np.minimum(index + full, len(stops))] == ends - 1)
        )
        right &= marks[np.minimum(index + full + (rest > 0), len(stops))] == ends
        return np.where(right, first, -1), index + full + (rest > 0)

    def _intact(
        self, buffer: Bytes1D, starts: Numbers, stops: Numbers, first: Numbers, last: Numbers
    ) -> NDArray[np.bool_]:
        """Whether all check characters of frames are right, (n,)."""
        assert self.check is not None
        sums = np.concatenate([[0], np.cumsum(buffer, dtype=np.int64)])
        begins = np.concatenate([[0], stops[:-1] + 1])
        begins[first] = starts
        inside = stops - 1 > begins
        spots = np.maximum(stops - 1, 0)
        wrong = inside & (
            self.check(sums[spots] - sums[np.minimum(begins, spots)]) != buffer[spots]
        )
        counts = np.concatenate([[0], np.cumsum(wrong)])
        return np.asarray(counts[last] == counts[first + self.bare])

    def write(self, rows: Bytes2D, slots: Sequence[Slot]) -> list[bytes]:
        rows = rows if self.numbers is None else self.numbers.write(rows, slots)
        if self.numbers is None or self.numbers.echoes is None:
            return self._in_lines(rows)
        head = sum(self.head)
        steps = self.numbers.echoes.joined(rows[:, head:], self.numbers.first[0])
        each = (row.tobytes() + part for row, part in zip(rows[:, :head], steps, strict=True))
        return [self._in_lines(np.frombuffer(characters, np.uint8)[None])[0] for characters in each]

    def _in_lines(self, rows: Bytes2D) -> list[bytes]:
        """Rows of characters with the ends of lines, and their checks."""
        parts, start, line = list[Bytes2D](), 0, 0
        while start < rows.shape[1]:
            is_head, left = line < len(self.head), rows.shape[1] - start
            length = min(self.head[line] if is_head else self.width, left)
            count = 1 if is_head else left // length
            part = rows[:, start : (start := start + count * length)].reshape(
                len(rows), count, length
            )
            checks = (
                [self.check(part.sum(axis=2, dtype=np.int64))[:, :, None]]
                if self.check is not None and line >= self.bare
                else []
            )
            closed = np.concatenate(
                [part, *checks, _repeated(b"\n", (len(rows), count, 1))], axis=2
            )
            parts.append(closed.reshape(len(rows), -1))
            line += 1
        whole = np.concatenate([*parts, _repeated(b"\n", (len(rows), 1))], axis=1)
        return [row.tobytes() for row in whole]

    def largest(self, slot: Slot) -> int:
        return int((256 if self.numbers is None else 64) ** slot.size - 1)


@dataclass(frozen=True)
class Escaped:
    """Frames between two flags, in which a flag or an escape is sent as an escape and the byte with
    some bits turned (as in HDLC).

    Each frame has both its flags. Any byte may be escaped on arrival; those that have to be are
    when a frame is built.

    Args:
        flag, escape: bytes.
        xor: the bits that are turned in an escaped byte.

    Raises:
        SpecError: for flags and escapes that cannot be told apart.
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
                "flag and escape are two bytes that differ, and that no escaped one looks like",
                path="wire",
            )

    @property
    def start(self) -> bytes:
        return bytes([self.flag])

    def begins(self, texts: Sequence[Characters]) -> Characters:
        return self.start  # any byte behind it may be escaped

    def read(self, buffer: Bytes1D, starts: Numbers, limit: int) -> Reading:
        is_escape, is_flag = buffer == self.escape, buffer == self.flag
        sizes = ended(starts, np.flatnonzero(is_flag), limit, len(buffer))
        escaped = np.concatenate([[False], is_escape[:-1]])
        wrong = np.concatenate([[0], np.cumsum(escaped & (is_escape | is_flag))])
        sizes[
            (sizes > 0)
            & (
                (wrong[np.minimum(starts + np.maximum(sizes, 1), len(buffer))] > wrong[starts + 1])
                | (sizes == 2)
            )
        ] = NONE
        places = np.flatnonzero(~(is_escape | is_flag))
        turned = escaped[places]
        return Unescaped(
            sizes, places - turned, buffer[places] ^ np.where(turned, self.xor, 0).astype(np.uint8)
        )

    def write(self, rows: Bytes2D, slots: Sequence[Slot]) -> list[bytes]:
        special = (rows == self.flag) | (rows == self.escape)
        both = np.stack(
            [
                np.full(rows.shape, self.escape, np.uint8),
                np.where(special, rows ^ np.uint8(self.xor), rows),
            ],
            axis=2,
        )
        flags = _repeated(self.start, (len(rows), 1))
        used = np.stack([special, np.ones(rows.shape, np.bool_)], axis=2).reshape(len(rows), -1)
        edge = np.ones((len(rows), 1), np.bool_)
        whole = np.concatenate([flags, both.reshape(len(rows), -1), flags], axis=1)
        return _pieces(whole, np.concatenate([edge, used, edge], axis=1))

    def largest(self, slot: Slot) -> int:
        return int(256**slot.size - 1)


def _repeated(byte: bytes, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    return np.full(shape, byte[0], np.uint8)


def _pieces(characters: Bytes2D, used: NDArray[np.bool_]) -> list[bytes]:
    """The characters of each row that are used."""
    data, ends = characters[used].tobytes(), np.cumsum(used.sum(axis=1)).tolist()
    return [data[first:end] for first, end in zip([0, *ends], ends, strict=False)]
