"""From a sensor's construct trees to the neutral trees that exports walk."""

from __future__ import annotations

from dataclasses import dataclass, replace

import construct
from construct import Array, Bytes, BytesInteger, Construct, FormatField

from lidarspec.exports import Refused
from lidarspec.exports.formulas import Ref, Scope, formula, labelled
from lidarspec.exports.tree import Blob, Block, Empty, Node, Number, Part, Repeat, Sealed, Select, Struct, When
from lidarspec.spec.bits import probe
from lidarspec.spec.description import Frame
from lidarspec.spec.fields import Checksummed
from lidarspec.spec.sensor import Sensor
from lidarspec.wire.schema import FieldInfo, axis_path, fields_below, peeled


@dataclass(frozen=True, eq=False)
class Message:
    """One frame type: its name, what the sensor says of it, and its tree."""

    name: str
    frame: Frame
    root: Struct | Sealed


def messages(sensor: Sensor) -> tuple[Message, ...]:
    """All frame types of a sensor, in their order.

    Raises:
        Refused: if it has none yet, or one holds a part that only Python code can decide.
    """
    if not sensor.frames:
        raise Refused(f"{sensor.id}: has no frames yet: configure it first")
    return tuple(message(sensor, name) for name in sensor.frames)


def message(sensor: Sensor, name: str) -> Message:
    """One frame type of a sensor; raises as `messages`."""
    frame = sensor.frames[name]
    try:
        root = _node(frame.prepared, _Place(FieldInfo(""), Scope(None, "")))
    except Refused as refused:
        raise Refused(f"{sensor.id} {name}: {refused}") from None
    if not isinstance(root, Struct | Sealed):
        raise Refused(f"{sensor.id} {name}: the frame is no struct")
    return Message(name, frame, root)


@dataclass(frozen=True)
class _Place:
    """Where in the tree a construct stands: what is said of it, and what its expressions see."""

    info: FieldInfo
    scope: Scope
    name: str = ""


def _node(con: Construct, place: _Place) -> Node:
    inner, info = peeled(con, place.info)
    place = replace(place, info=info)
    name, path = place.name, info.path
    if isinstance(inner, construct.Transformed | construct.Restreamed) or (isinstance(inner, BytesInteger) and _is_odd(inner)):
        return _block(inner, place)
    if isinstance(inner, Checksummed):
        return _sealed(inner, place)
    if isinstance(inner, construct.Struct):
        return _struct(inner, place)
    if isinstance(inner, Array):
        axis = axis_path(info)
        element = _node(inner.subcon, replace(place, info=replace(info, axes=(*info.axes, axis))))
        return Repeat(name, axis, formula(inner.count, place.scope, path), element)
    if isinstance(inner, construct.IfThenElse):
        condition = formula(inner.condfunc, place.scope, path)
        return When(name, condition, _branch(inner.thensubcon, place), _branch(inner.elsesubcon, place))
    if isinstance(inner, construct.Switch):
        return _select(inner, place)
    return Empty(name) if inner is construct.Pass else _leaf(inner, place)


def _branch(con: Construct, place: _Place) -> Node:
    return _node(con, replace(place, info=replace(place.info, optional=True)))


def _select(con: construct.Switch, place: _Place) -> Select:
    key = formula(con.keyfunc, place.scope, place.info.path)
    cases = []
    for value, case in con.cases.items():
        number = labelled(key, value) if isinstance(value, str) and isinstance(key, Ref) else value
        if number is value and isinstance(key, Ref) and value in key.info.labels:
            continue  # construct looks a value that has a name up by that name alone
        if not isinstance(number, int):
            raise Refused(f"{place.info.path}: a case for {value!r}, which is no integer")
        cases.append((int(number), _branch(case, place)))
    return Select(place.name, key, tuple(cases), _branch(con.default, place))


def _struct(con: construct.Struct, place: _Place) -> Struct:
    scope = Scope(place.scope if place.info.path or place.info.axes else None, place.info.path)
    if place.name:
        place.scope.add(place.name, scope)
    members = []
    for child in con.subcons:
        path = ".".join(part for part in (place.info.path, child.name) if part)
        members.append(_node(child, _Place(FieldInfo(path, place.info.axes, optional=place.info.optional), scope, child.name or "")))
    return Struct(place.name, place.info.path, tuple(members))


def _sealed(con: Checksummed, place: _Place) -> Sealed:
    body = _node(con.subcon, place)
    if not isinstance(body, Struct):
        raise Refused(f"{place.info.path}: a checksum around something that is no struct")
    if con.algorithm is None:
        raise Refused(f"{con.fields[0]}: a checksum without algorithm, and no lidarspec_checksum hook supplies one")
    prefix = f"{place.info.path}." if place.info.path else ""
    over = (prefix + con.over[0], prefix + con.over[-1]) if con.over is not None else None
    return Sealed(body, tuple(prefix + name for name in con.fields), over, con.algorithm, tuple(sorted(con.absent)))


def _leaf(con: Construct, place: _Place) -> Node:
    info = fields_below(con, place.info)[place.info.path] if place.info.path and place.name else place.info
    if isinstance(con, FormatField) and con.fmtstr[-1] != "?":
        code, order = con.fmtstr[-1], "big" if con.fmtstr[0] in ">!" else "little"
        kind = "float" if code in "efd" else "uint" if code.isupper() else "int"
        node: Node = Number(info, con.length, kind, order)  # type: ignore[arg-type]
    elif isinstance(con, BytesInteger):
        node = Number(info, con.length, "int" if con.signed else "uint", "little" if con.swapped else "big")
    elif isinstance(con, Bytes):
        return Blob(place.name, info, formula(con.length, place.scope, place.info.path), info.const)
    else:
        raise Refused(f"{place.info.path}: {type(con).__name__} is Python code, which no other language runs")
    if not place.name and info.const is not None:
        return Blob("", info, con.length, con.build(info.const))
    if place.name:
        place.scope.add(place.name, info)
    return node


def _is_odd(con: BytesInteger) -> bool:
    """Whether its length or byte order is not plain."""
    return not isinstance(con.length, int) or con.length > 8 or not isinstance(con.swapped, bool)


def _block(con: Construct, place: _Place) -> Block:
    """A bit block: the bits of each field come from probing construct itself."""
    try:
        size = int(con.sizeof())
        found = probe(con, size)
    except construct.SizeofError:
        found = None
    if found is None:
        raise Refused(f"{place.info.path}: a bit block whose values are not plain bits of it")
    infos, scope = fields_below(con, place.info), Scope(place.scope, place.info.path)
    parts = []
    for bits in found:
        names = tuple(key for key in bits.keys if isinstance(key, str))
        info = infos[".".join(part for part in (place.info.path, *names) if part)]
        parts.append(Part(info, bits, names, tuple(key for key in bits.keys if isinstance(key, int))))
        _known(scope, names, info)
    if place.name:
        place.scope.add(place.name, parts[0].info if not parts[0].names else scope)
    return Block(place.name, place.info, size, tuple(parts))


def _known(scope: Scope, names: tuple[str, ...], info: FieldInfo) -> None:
    """Add a field of a block to what expressions see, in the structs that it is in."""
    for name in names[:-1]:
        below = scope._names.get(name)
        if not isinstance(below, Scope):
            below = Scope(scope, f"{info.path}")
            scope.add(name, below)
        scope = below
    if names:
        scope.add(names[-1], info)
