"""Additions to construct for units, checksums, sizes and parts of variable size.

The additions are members of a struct, and can be nested in any construct.
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

#: An HTTP request and its reply as structs. The link `Http` handles the rest of the protocol.
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
#: target unit -> unit -> size of the unit in target units. Only units that a user may type on the
#: command line instead of the unit of a field are included.
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
    """Return the factor from `unit` to `target`; None for different quantities."""
    if unit == target:
        return Fraction(1)
    return _FACTORS.get(target, {}).get(unit)


def is_unit(unit: str) -> bool:
    """Return whether a unit can be converted to other units."""
    return any(unit in table for table in _FACTORS.values())


def split_unit(text: str, own_unit: str = "") -> tuple[str, str]:
    """Split a text such as "324.27deg" into number and unit.

    The unit is "" for a bare number.

    Args:
        own_unit: a unit to accept in addition to the units that can be converted.
    """
    units = {own_unit, *(unit for table in _FACTORS.values() for unit in table)} - {""}
    for unit in sorted(units, key=len, reverse=True):
        if text.endswith(unit) and _is_number(text[: -len(unit)]):
            return text[: -len(unit)].strip(), unit
    return text, ""


def slug(unit: str) -> str:
    """Return a unit in a form that can be part of a name: "deg/s" becomes "deg_s"."""
    return re.sub(r"\W+", "_", unit).strip("_").lower()


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def parse_duration(text: str) -> float:
    """Return the seconds in a text such as "10s", "500ms", "2min", "2m", "1h" or "10".

    Raises:
        UsageError: if the text is not a duration, or the duration is negative.
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
    raise UsageError(
        f"invalid duration {text!r}: expected a number with ms, s, min or h, such as 10s"
    )


def parse_share(text: str) -> float:
    """Return the value of "1%" or "0.01" as a number.

    Raises:
        ValueError: if it is not a number.
    """
    return float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)


class Scaled(layer.DescribedField):
    """A number with a unit: ``physical = raw * scale + offset``.

    The field parses and builds the raw number.

    Args:
        subcon: a construct field that parses to a number.
        scale: the physical size of a raw step of 1, in `unit`.
        unit: the unit, such as "m", "s", "deg", "deg/s" or "Hz"; "" for a plain number.
        offset: the physical value of the raw value 0, in `unit`.

    Raises:
        SpecError: if the scale is 0 or not a number, or if the arguments are in the wrong order.
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
                "a field, the size of a step, its unit and an offset, as in Scaled(Int16ul,"
                ' 0.001, "m")'
            )
            raise SpecError(f"Scaled requires {wanted}, got {', '.join(given)}")
        super().__init__(subcon)
        self.scale = scale
        self.unit = unit
        self.offset = offset

    def describe(self, info: FieldInfo) -> FieldInfo:
        return replace(
            info, scale=self.scale, offset=self.offset, unit=self.unit, has_declared_unit=True
        )


class SizeOf(layer.SizeField):
    """The size of another part of the frame, in bytes.

    `build` computes the size and ignores a given value. A parsed frame is invalid if the field
    differs from the size of the part.

    Args:
        subcon: a field that parses to an integer, such as Int16ub.
        part: the path of the part, relative to the struct that contains this field, such as "body"
            or "body.tags". A path that begins with "_." is relative to the outer struct. "" is the
            struct itself, and "_" is the outer struct itself.
        plus: a number that is added to the number of bytes; negative if some bytes are not counted.

    Raises:
        SpecError: if the arguments are in the wrong order.
    """

    def __init__(self, subcon: Construct, part: str = "", plus: int = 0) -> None:
        if not hasattr(subcon, "parse") or not isinstance(part, str) or not isinstance(plus, int):
            raise SpecError(
                "SizeOf requires a field, the name of a part, and the number of bytes to add, as"
                f' in SizeOf(Int16ub, "body", 2), got {part!r} and {plus!r}'
            )
        super().__init__(subcon, tuple(filter(None, part.split("."))), plus)


class Checksummed(layer.ChecksummedBase):
    """A struct that contains its checksum, in any of its fields.

    It can be nested. A `Checksummed` around another `Checksummed` is a struct with two checksums.

    Args:
        struct: a construct Struct.
        field: the path of the field that stores the checksum, or the paths of several fields that
            store it together, low bits first.
        algorithm: the `Checksum`; if None, a ``lidarspec_checksum`` hook has to return it.
        over: the names of consecutive fields that the checksum covers. By default, it covers all
            bytes of the struct, except bytes that contain a bit of `field`.
        absent: the values of the field that mean that the sensor has computed no checksum. A frame
            with such a value is valid. `build` does not replace such a value by a checksum.
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
                raise SpecError(
                    f"{both}: name the fields that {inner.fields[0]!r} covers, with over= of the"
                    " inner Checksummed"
                )
            inner = inner.subcon

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        obj = self._measured_struct._parsereport(stream, context, path)
        end = stream.tell()
        if not layer.is_verifying(context):
            return obj
        stream.seek(start)
        data = stream.read(end - start)
        stored, computed = self.find_checksums(data, obj, start)
        if stored != computed and stored not in self.absent:
            name = self.fields[0]
            width = (sum(layer.bit_width(self._find_field(name)) for name in self.fields) + 3) // 4
            expected, got = (f"0x{value:0{width}x}" for value in (computed, stored))
            reason = "checksum"
            raise layer.MismatchError(
                f"{path} -> {name.replace('.', ' -> ')}",
                self._find_span(obj, name)[0],
                expected,
                got,
                reason,
            )
        return obj

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        given = [layer.get_member(obj, name, None) for name in self.fields]
        blank = obj
        for name, value in zip(self.fields, given, strict=True):
            blank = _replace(blank, name, self._make_zero(name) if value is None else value)
        con = self._measured_struct
        trial = io.BytesIO()
        con._build(blank, trial, context, path)
        data = trial.getvalue()
        # The built bytes have no valid checksum yet.
        unverified = Container({**context, "_params": Container(_verify=False)})
        parsed = con._parsereport(io.BytesIO(data), unverified, path)
        if None not in given and self._load_stored(parsed) in self.absent:
            return con._build(blank, stream, context, path)
        return con._build(
            self._fill_in_checksum(blank, self._compute(data, parsed, 0)), stream, context, path
        )

    @property
    def _measured_struct(self) -> Construct:
        """The struct, prepared to add the offsets of its members to parsed values."""
        if isinstance(layer.unwrap(self.subcon), layer.MeasuredStruct):
            return self.subcon
        return layer.prepare(self.subcon)

    def find_checksums(self, data: bytes, obj: Any, base: int = 0) -> tuple[int, int]:
        """Return the stored and the computed checksum of one parsed struct.

        Args:
            base: the offset of the struct in the parsed stream.
        """
        return self._load_stored(obj), self._compute(data, obj, base)

    def find_covered(self, obj: Any, size: int, base: int = 0) -> list[tuple[int, int]]:
        """Return the byte ranges (start, end) in the struct that the checksum covers.

        Args:
            base: the offset of the struct in the parsed stream.
        """
        if self.over is not None:
            spans = [self._find_span(obj, name) for name in self.over]
            return [(spans[0][0] - base, spans[-1][1] - base)]
        held = sorted(self._find_span(obj, name) for name in self.fields)
        edges = [0, *(edge - base for span in held for edge in span), size]
        return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]

    def _compute(self, data: bytes, obj: Any, base: int) -> int:
        if self.algorithm is None:
            raise layer.MismatchError(
                "",
                0,
                "a checksum algorithm",
                "none: implement the hook lidarspec_checksum, or pass algorithm= to Checksummed",
                "checksum",
            )
        return self.algorithm(
            b"".join(data[a:b] for a, b in self.find_covered(obj, len(data), base))
        )

    def _load_stored(self, obj: Any) -> int:
        value = shift = 0
        for name in self.fields:
            part = layer.get_member(obj, name)
            if isinstance(part, bytes):
                part = int.from_bytes(part, self.algorithm.order if self.algorithm else "little")
            value |= int(part) << shift
            shift += layer.bit_width(self._find_field(name))
        return value

    def _fill_in_checksum(self, obj: Any, value: int) -> Any:
        for name in self.fields:
            con = self._find_field(name)
            width = layer.bit_width(con)
            part: int | bytes = value & ((1 << width) - 1)
            if isinstance(self._make_zero(name), bytes):
                assert self.algorithm is not None
                part = int(part).to_bytes(width // 8, self.algorithm.order)
            obj = _replace(obj, name, part)
            value >>= width
        return obj

    def _find_field(self, name: str) -> Construct:
        con = self.subcon
        for part in name.split("."):
            con = layer.unwrap(layer.unwrap(con)._subcons[part])
        return con

    def _make_zero(self, name: str) -> int | bytes:
        return self._find_field(name).parse(bytes(8 * layer.bit_width(self._find_field(name))))  # type: ignore[no-any-return]

    def _find_span(self, obj: Any, name: str) -> tuple[int, int]:
        """Return the byte range of a field in the parsed stream, given its dotted name."""
        con = self._measured_struct
        parts = name.split(".")
        for depth, part in enumerate(parts):
            start, end = obj["_spans"][part]
            con = layer.unwrap(con, bits=False)._subcons[part]
            obj = obj[part]
            if parts[depth + 1 :] and layer.unwrap(con, bits=False) is not layer.unwrap(con):
                inside = layer.bytes_of(con, parts[depth + 1 :])
                return start + min(inside), start + max(inside) + 1
        return start, end


layer.ChecksummedBase.plugin_class = Checksummed


class Parts(layer.Partition):
    """Consecutive structs of different sizes, such as the modules of a telegram.

    In a parsed frame the parts are a list. In the function `points` of ``Frame(points={"modules":
    points})``, each part is a packet of its own: ``f.distance`` is a field of the part, and
    ``f.frame.counter`` is a field of the outer frame. In expressions in a part, the same field of
    the outer frame is ``this._.counter``. In expressions after the parts, ``this.modules.size`` is
    the total size of the parts in bytes.

    Args:
        kinds: the Struct of a part, or a dict of several Structs by name. The first Struct with
            matching constants is used. A last Struct without constants matches all other parts.
        count: the number of parts.
        size: the size of the first part in bytes; 0 if there are no parts. Requires `following`.
        following: an expression of the fields of a part that gives the size of the next part in
            bytes; 0 in the last part.
        within: the total size of all parts in bytes.

    Raises:
        SpecError: if a part is not a struct, or if the arguments do not determine the last part in
            exactly one way: by `count`, by `within`, or by `size` and `following`.
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
                "Parts requires exactly one way to find the last part: count=, or within=, or"
                " size= together with following="
            )
        if isinstance(kinds, Mapping):
            self.cases = dict(kinds)
        else:
            self.cases = {"": kinds}
        if not self.cases or not all(map(layer.is_struct, self.cases.values())):
            raise SpecError("expected a Struct, or several Structs by name")
        self.count = count
        self.size = size
        self.following = following
        self.within = within

    def _parse(self, stream: Any, context: Any, path: str) -> Any:
        start = stream.tell()
        parsed = layer.ParsedParts()
        next_size = self._make_size_rule(context, path)
        while (announced := next_size(parsed)) != 0:
            place = f"{path}[{len(parsed)}]"
            offset = stream.tell()
            kind = self._choose_kind(stream, context, place)
            part = self.cases[kind]._parsereport(stream, context, place)
            self._append(parsed, kind, part, (offset, stream.tell()), announced, place)
            if stream.tell() - start > self.limit:
                raise RangeError("the parts exceed the maximum length of the frame", path=place)
        return parsed

    def _build(self, obj: Any, stream: Any, context: Any, path: str) -> Any:
        if not isinstance(obj, list | tuple):
            raise layer.MismatchError(path, 0, "a list of parts", repr(obj), "value")
        built = layer.ParsedParts()
        next_size = self._make_size_rule(context, path)
        for index, part in enumerate(obj):
            announced = next_size(built)
            place = f"{path}[{index}]"
            kind, value, data = self._build_part(part, context, place)
            self._append(
                built, kind, value, (stream.tell(), stream.tell() + len(data)), announced, place
            )
            stream.write(data)
        if next_size(built) != 0:
            raise RangeError(
                f"the value has {len(built)} parts, but the frame announces more parts", path=path
            )
        return built

    def _sizeof(self, context: Any, path: str) -> int:
        raise SizeofError("the size of the parts depends on their content", path=path)

    def _make_size_rule(self, context: Any, path: str) -> Callable[[layer.ParsedParts], int]:
        """Return a function that calculates the size of the next part.

        The function takes the list of the parsed parts. It returns a size in bytes, 0 if no part
        follows, or -1 if the struct of the next part determines the size.
        """
        rules = ((self.count, "count"), (self.size, "length"), (self.within, "length"))
        bounds = (
            None
            if rule is None
            else layer.check_bound(evaluate(rule, context), self.limit, what, path)
            for rule, what in rules
        )
        count, size, within = bounds

        def next_size(parsed: layer.ParsedParts) -> int:
            if count is not None:
                if len(parsed) < count:
                    return -1
                return 0
            if within is not None:
                if parsed.size < within:
                    return -1
                return layer.check_bound(parsed.size, within, "length of parts", path) - within
            assert size is not None
            if not parsed:
                return size
            return layer.check_bound(
                evaluate(self.following, Container({**parsed[-1], "_": context})),
                self.limit,
                "length",
                path,
            )

        return next_size

    @staticmethod
    def _append(
        parsed: layer.ParsedParts,
        kind: str,
        part: Any,
        span: tuple[int, int],
        announced: int,
        place: str,
    ) -> None:
        size = span[1] - span[0]
        if announced == 0 or size == 0 or announced not in (-1, size):
            wanted = {0: "no further part", -1: "a part of at least one byte"}.get(
                announced, f"{announced} bytes"
            )
            raise RangeError(f"expected {wanted}, found {size} bytes", path=place)
        parsed.append(part)
        parsed.spans.append((kind, *span))

    def _choose_kind(self, stream: Any, context: Any, path: str) -> str:
        """Return the first kind with constants that match the next bytes.

        Raises:
            MismatchError: if no kind matches.
        """
        start = stream.tell()
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
            except (layer.MismatchError, ConstError) as fault:
                if getattr(fault, "reason", "constant") == "constant":
                    continue
            # an expression may raise any exception: the part is of this kind, and fails again when
            # it is parsed
            except Exception:
                pass
            finally:
                stream.seek(start)
            return name
        if len(names) > 1 and layer.is_verifying(context):
            raise layer.MismatchError(
                path, start, f"one of {', '.join(names)}", "none of them", "constant"
            )
        return names[-1]

    def _build_part(self, part: Any, context: Any, path: str) -> tuple[str, Any, bytes]:
        """Build a part as the first kind that accepts its values.

        Returns:
            The kind, the value and the bytes.
        """
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
