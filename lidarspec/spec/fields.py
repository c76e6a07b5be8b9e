"""What a struct needs beyond construct: a unit on a field, a checksum that seals a struct, and
parts that each have a size of their own.

All are ordinary parts of a struct, so that they nest in anything; none changes the raw integers of
the wire. Units go by name, and those few that someone may type are converted exactly.
"""

from __future__ import annotations

import io
import math
import numbers
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

from construct import (
    Bytes,
    Const,
    ConstError,
    Construct,
    ConstructError,
    Container,
    Enum,
    Int8ub,
    Int16ub,
    Int32ub,
    RangeError,
    SizeofError,
    Struct,
    evaluate,
    this,
)

from lidarspec.errors import SpecError, UsageError
from lidarspec.spec import syntax as layer
from lidarspec.spec.checksums import Checksum
from lidarspec.spec.tree import FieldInfo

#: A request over a link `Http`, and the reply to it, as messages: what HTTP says besides is the
#: link's business.
HttpRequest = Struct(
    "mark" / Const(b"HTTP"),
    "method" / Enum(Int8ub, GET=1, PUT=2, POST=3, DELETE=4),
    "path_size" / Int16ub,
    "path" / Bytes(this.path_size),
    "size" / Int32ub,
    "body" / Bytes(this.size),
)
HttpReply = Struct(
    "mark" / Const(b"HTTP"), "status" / Int16ub, "size" / Int32ub, "body" / Bytes(this.size)
)
#: unit -> how many of the SI unit it is; only units that someone may type on the command line.
_FACTORS: dict[str, dict[str, Fraction]] = {
    "m": {"m": Fraction(1), "cm": Fraction(1, 100), "mm": Fraction(1, 1000)},
    "s": {
        "s": Fraction(1),
        "ms": Fraction(1, 1000),
        "us": Fraction(1, 10**6),
        "ns": Fraction(1, 10**9),
    },
    "deg": {"deg": Fraction(1)},
    "rad": {"rad": Fraction(1)},
    "deg/s": {"deg/s": Fraction(1), "Hz": Fraction(360), "rpm": Fraction(6)},
    "Hz": {"Hz": Fraction(1), "rpm": Fraction(1, 60)},
    "rpm": {"rpm": Fraction(1), "Hz": Fraction(60)},
}


def factor(unit: str, target: str) -> Fraction | None:
    """How many `target` one `unit` is, or None where the two measure different things."""
    if unit == target:
        return Fraction(1)
    return _FACTORS.get(target, {}).get(unit)


def is_unit(unit: str) -> bool:
    """Whether a unit is one that can be turned into others."""
    return any(unit in table for table in _FACTORS.values())


def split_unit(text: str) -> tuple[str, str]:
    """A number and its unit out of "324.27deg"; the unit is empty where there is none."""
    known = sorted({unit for table in _FACTORS.values() for unit in table}, key=len, reverse=True)
    for unit in known:
        if text.endswith(unit) and _is_number(text[: -len(unit)]):
            return text[: -len(unit)].strip(), unit
    return text, ""


def slug(unit: str) -> str:
    """A unit as part of a name: "deg/s" is "deg_s"."""
    return re.sub(r"\W+", "_", unit).strip("_").lower()


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def duration(text: str) -> float:
    """Seconds out of "10s", "500ms", "2min" or "2m", "1h", or a bare number of seconds.

    Raises:
        UsageError: where it is no duration, or a negative one.
    """
    for unit, seconds in (
        ("min", 60.0),
        ("m", 60.0),
        ("ms", 1e-3),
        ("us", 1e-6),
        ("h", 3600.0),
        ("s", 1.0),
        ("", 1.0),
    ):
        number = text.strip().removesuffix(unit)
        if text.strip().endswith(unit) and _is_number(number) and 0 <= float(number) < float("inf"):
            return float(number) * seconds
    raise UsageError(f"{text!r} is no duration: a number with ms, s, min or h, such as 10s")


def share(text: str) -> float:
    """The number that "1%" or "0.01" says.

    Raises:
        ValueError: where it is none.
    """
    return float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)


class Scaled(layer.Describing):
    """A number on the wire with what it measures: ``physical = raw * scale + offset`` in `unit`.

    Parses and builds the raw number; the unit is used where physical values are asked for, and
    never twice.

    Args:
        subcon: a construct field that parses to a number.
        scale: the size of one raw step, in `unit`.
        unit: "m", "s", "deg", "deg/s", "Hz", ... ("" for a pure number).
        offset: physical value of raw 0, in `unit`.

    Raises:
        SpecError: for a step that is 0 or no number, and for arguments in another order.
    """

    def __init__(self, subcon: Construct, scale: float, unit: str, offset: float = 0) -> None:
        given = [
            "a field" if hasattr(value, "parse") else repr(value)
            for value in (subcon, scale, unit, offset)
        ]
        steps = [
            value
            for value in (scale, offset)
            if isinstance(value, numbers.Real) and math.isfinite(value)
        ]
        if given[0] != "a field" or len(steps) < 2 or not scale or not isinstance(unit, str):
            wanted = (
                'a field, the size of a step, its unit and an offset, Scaled(Int16ul, 0.001, "m")'
            )
            raise SpecError(f"Scaled takes {wanted}, not {', '.join(given)}")
        super().__init__(subcon)
        self.scale = scale
        self.unit = unit
        self.offset = offset

    def describe(self, info: FieldInfo) -> FieldInfo:
        return replace(info, scale=self.scale, offset=self.offset, unit=self.unit, measured=True)


class SizeOf(layer.Sizing):
    """A number that says how many bytes a part of the frame has: filled in by `build`, whatever
    value is given, and wrong on a frame that comes where the part is longer or shorter.

    Args:
        subcon: a field that parses to an integer, Int16ub.
        part: the part, a member of the struct that the field stands in, or in one of it, "body",
            "body.tags"; "" for that struct itself; of the struct around it with "_.", "_.body", and
            "_" for that itself.
        plus: what the number has beyond these bytes; less than 0 where it does not count them all.

    Raises:
        SpecError: for arguments in another order.
    """

    def __init__(self, subcon: Construct, part: str = "", plus: int = 0) -> None:
        if not hasattr(subcon, "parse") or not isinstance(part, str) or not isinstance(plus, int):
            raise SpecError(
                'SizeOf takes a field, the name of a part and a number, SizeOf(Int16ub, "body",'
                f" 2), not {part!r} and {plus!r}"
            )
        super().__init__(subcon, tuple(filter(None, part.split("."))), plus)


class Checksummed(layer.Sealing):
    """A struct sealed by one of its own fields, wherever in it that field stands. May nest, around
    one struct too, each with its own field.

    Args:
        struct: a construct Struct.
        field: dotted name of the field (or fields, low bits first) that holds the checksum.
        algorithm: a `Checksum`; where left out, a ``lidarspec_checksum`` hook has to supply it.
        over: names of consecutive fields that the checksum covers; by default every byte of the
            struct except those that hold a bit of `field`.
        absent: values of the field that mean "not filled": they pass, and stay as they are when
            built.
    """

    def __init__(
        self,
        struct: Construct,
        field: str | Sequence[str],
        algorithm: Checksum | None = None,
        over: str | Iterable[str] | None = None,
        absent: Iterable[int] = (),
    ) -> None:
        super().__init__(struct)
        if isinstance(field, str):
            self.fields = (field,)
        else:
            self.fields = tuple(field)
        self.algorithm = algorithm
        if isinstance(over, str):
            self.over = (over,)
        elif over is not None:
            self.over = tuple(over)
        else:
            self.over = None
        self.absent = frozenset(absent)
        inner = struct
        while isinstance(inner, Checksummed):
            if self.over is None and inner.over is None:
                both = f"the checksums {inner.fields[0]!r} and {self.fields[0]!r} cover each other"
                raise SpecError(f"{both}: say over= of the one that is made first")
            inner = inner.subcon

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        obj = self._marked._parsereport(stream, context, path)
        end = stream.tell()
        if not layer.verifying(context):
            return obj
        stream.seek(start)
        data = stream.read(end - start)
        stored, computed = self.verdict(data, obj, start)
        if stored != computed and stored not in self.absent:
            name = self.fields[0]
            width = (sum(layer.bit_width(self._field(name)) for name in self.fields) + 3) // 4
            expected, got = (f"0x{value:0{width}x}" for value in (computed, stored))
            reason = "checksum"
            raise layer.Mismatch(
                f"{path} -> {name.replace('.', ' -> ')}",
                self._span(obj, name)[0],
                expected,
                got,
                reason,
            )
        return obj

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        given = [layer.member(obj, name, None) for name in self.fields]
        blank = obj
        for name, value in zip(self.fields, given, strict=True):
            blank = _replace(blank, name, self._zero(name) if value is None else value)
        con = self._marked
        trial = io.BytesIO()
        con._build(blank, trial, context, path)
        data = trial.getvalue()
        unverified = Container(
            {**context, "_params": Container(_verify=False)}
        )  # what was just built is parsed back
        parsed = con._parsereport(io.BytesIO(data), unverified, path)
        if None not in given and self._load_stored(parsed) in self.absent:
            return con._build(blank, stream, context, path)
        return con._build(self._fill(blank, self._compute(data, parsed, 0)), stream, context, path)

    @property
    def _marked(self) -> Construct:
        """The struct as a frame has it, which notes where its members stand; an author may also
        parse with it alone.
        """
        if isinstance(layer.unwrap(self.subcon), layer.MarkedStruct):
            return self.subcon
        return layer.prepare(self.subcon)

    def verdict(self, data: bytes, obj: Any, base: int = 0) -> tuple[int, int]:
        """The checksum that stands in one parsed struct and the one that should, for its bytes,
        which began at `base`.
        """
        return self._load_stored(obj), self._compute(data, obj, base)

    def find_covered(self, obj: Any, size: int, base: int = 0) -> list[tuple[int, int]]:
        """The byte ranges (start, end) within the struct that the checksum covers, for one parsed
        frame.
        """
        if self.over is not None:
            spans = [self._span(obj, name) for name in self.over]
            return [(spans[0][0] - base, spans[-1][1] - base)]
        held = sorted(self._span(obj, name) for name in self.fields)
        edges = [0, *(edge - base for span in held for edge in span), size]
        return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]

    def _compute(self, data: bytes, obj: Any, base: int) -> int:
        if self.algorithm is None:
            raise layer.Mismatch(
                "",
                0,
                "a checksum algorithm",
                "none; a lidarspec_checksum hook has to supply it",
                "checksum",
            )
        return self.algorithm(
            b"".join(data[a:b] for a, b in self.find_covered(obj, len(data), base))
        )

    def _load_stored(self, obj: Any) -> int:
        value = shift = 0
        for name in self.fields:
            part = layer.member(obj, name)
            if isinstance(part, bytes):
                part = int.from_bytes(part, self.algorithm.order if self.algorithm else "little")
            value |= int(part) << shift
            shift += layer.bit_width(self._field(name))
        return value

    def _fill(self, obj: Any, value: int) -> Any:
        for name in self.fields:
            con = self._field(name)
            width = layer.bit_width(con)
            part: int | bytes = value & ((1 << width) - 1)
            if isinstance(self._zero(name), bytes):
                assert self.algorithm is not None
                part = int(part).to_bytes(width // 8, self.algorithm.order)
            obj = _replace(obj, name, part)
            value >>= width
        return obj

    def _field(self, name: str) -> Construct:
        con = self.subcon
        for part in name.split("."):
            con = layer.unwrap(layer.unwrap(con)._subcons[part])
        return con

    def _zero(self, name: str) -> int | bytes:
        return self._field(name).parse(bytes(8 * layer.bit_width(self._field(name))))  # type: ignore[no-any-return]

    def _span(self, obj: Any, name: str) -> tuple[int, int]:
        """Where a dotted field stands, in bytes of the stream that was parsed; a bit field by the
        bytes that hold it.
        """
        con = self._marked
        parts = name.split(".")
        for depth, part in enumerate(parts):
            start, end = obj["_marks"][part]
            con = layer.unwrap(con, bits=False)._subcons[part]
            obj = obj[part]
            if parts[depth + 1 :] and layer.unwrap(con, bits=False) is not layer.unwrap(con):
                inside = layer.bytes_of(con, parts[depth + 1 :])
                return start + min(inside), start + max(inside) + 1
        return start, end


class Parts(layer.Partition):
    """Structs one after another, each of a size of its own: the modules of a telegram, or its tags
    with a type and a length.

    In the struct they are a list. In `points` each is a packet of its own
    (``Frame(points={"modules": points})``), whose fields are ``f.distance``, and those of the frame
    around it ``f.frame.counter``; expressions of a part see these as ``this._.counter``. Behind
    them, ``this.modules.size`` is how many bytes all of them take.

    Args:
        kinds: a Struct; or several by name, for parts that are told apart by their constants: the
            first one is taken whose constants are right, so that a struct without any, as the last,
            takes what nobody knows.
        count: how many there are.
        size: the bytes of the first part of a chain, 0 for none; with `following`.
        following: an expression of a part's own fields, the bytes of the next part, 0 behind the
            last.
        within: the bytes of all parts, which fill them.

    Raises:
        SpecError: where what is said is not just one of `count`, `size` with `following`, and
            `within`, or a part is no struct.
    """

    def __init__(
        self,
        kinds: Construct | Mapping[str, Construct],
        count: Any = None,
        *,
        size: Any = None,
        following: Any = None,
        within: Any = None,
    ) -> None:
        super().__init__()
        if sum(rule is not None for rule in (count, size, within)) != 1 or (size is None) != (
            following is None
        ):
            raise SpecError(
                "Parts takes one of count=, within=, and size= with following=: what says where the"
                " last part is"
            )
        if isinstance(kinds, Mapping):
            self.cases = dict(kinds)
        else:
            self.cases = {"": kinds}
        if not self.cases or not all(map(layer.is_struct, self.cases.values())):
            raise SpecError("a part is a Struct, or one of several Structs by name")
        self.count = count
        self.size = size
        self.following = following
        self.within = within

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        found = layer.Pieces()
        goes_on = self._rule(context, path)
        while (announced := goes_on(found)) != 0:
            place = f"{path}[{len(found)}]"
            spot = stream.tell()
            kind = self._kind(stream, context, place)
            part = self.cases[kind]._parsereport(stream, context, place)
            self._take(found, kind, part, (spot, stream.tell()), announced, place)
            if stream.tell() - start > self.limit:
                raise RangeError("parts longer than the frame can be", path=place)
        return found

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        if not isinstance(obj, list | tuple):
            raise layer.Mismatch(path, 0, "a list of its parts", repr(obj), "value")
        built = layer.Pieces()
        goes_on = self._rule(context, path)
        for index, part in enumerate(obj):
            announced = goes_on(built)
            place = f"{path}[{index}]"
            kind, value, data = self._built(part, context, place)
            self._take(
                built, kind, value, (stream.tell(), stream.tell() + len(data)), announced, place
            )
            stream.write(data)
        if goes_on(built) != 0:
            raise RangeError(
                f"more parts are announced than the {len(built)} that are given", path=path
            )
        return built

    def _sizeof(self, context: Any, path: str) -> int:
        raise SizeofError("the size of parts is theirs", path=path)

    def _rule(self, context: Any, path: str) -> Callable[[layer.Pieces], int]:
        """From the parts so far to the bytes of the next one, 0 where there is none, -1 where its
        own struct says it.
        """
        rules = ((self.count, "count"), (self.size, "length"), (self.within, "length"))
        known = (
            None
            if rule is None
            else layer.check_bound(evaluate(rule, context), self.limit, what, path)
            for rule, what in rules
        )
        count, size, within = known

        def goes_on(found: layer.Pieces) -> int:
            if count is not None:
                if len(found) < count:
                    return -1
                return 0
            if within is not None:
                if found.size < within:
                    return -1
                return layer.check_bound(found.size, within, "length of parts", path) - within
            assert size is not None
            if not found:
                return size
            return layer.check_bound(
                evaluate(self.following, Container({**found[-1], "_": context})),
                self.limit,
                "length",
                path,
            )

        return goes_on

    @staticmethod
    def _take(
        found: layer.Pieces, kind: str, part: Any, span: tuple[int, int], announced: int, place: str
    ) -> None:
        size = span[1] - span[0]
        if announced == 0 or size == 0 or announced not in (-1, size):
            wanted = {0: "no further part", -1: "a part of at least one byte"}.get(
                announced, f"{announced} bytes"
            )
            raise RangeError(f"expected {wanted}, found {size} bytes", path=place)
        found.append(part)
        found.spans.append((kind, *span))

    def _kind(self, stream: Any, context: Any, path: str) -> str:
        """The first kind whose constants are right, as far as the bytes go.

        Raises:
            Mismatch: where those of no kind are.
        """
        spot = stream.tell()
        names = list(self.cases)
        trial = Container(
            {
                **context,
                "_params": Container({**context._params, "_verify": True}),
            }
        )
        for name in names if len(names) > 1 else ():
            try:
                self.cases[name]._parsereport(stream, trial, path)
            except (layer.Mismatch, ConstError) as fault:
                if getattr(fault, "reason", "constant") == "constant":
                    continue
            # an expression may raise anything: the part is of this kind, and fails again when it is
            # parsed
            except Exception:
                pass
            finally:
                stream.seek(spot)
            return name
        if len(names) > 1 and layer.verifying(context):
            raise layer.Mismatch(
                path, spot, f"one of {', '.join(names)}", "none of these", "constant"
            )
        return names[-1]

    def _built(self, part: Any, context: Any, path: str) -> tuple[str, Any, bytes]:
        """A part as the first kind that takes its values: its kind, value and bytes."""
        faults = list[ConstructError]()
        for name, case in self.cases.items():
            stream = io.BytesIO()
            try:
                value = case._build(part, stream, context, path)
            except ConstructError as fault:
                faults.append(fault)
            else:
                return name, value, stream.getvalue()
        raise faults[0]


def _replace(obj: Any, name: str, value: object) -> Any:
    head, _, rest = name.partition(".")
    copy = Container(obj)
    copy[head] = _replace(copy.get(head, {}), rest, value) if rest else value
    return copy
