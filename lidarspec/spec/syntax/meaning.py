"""Translate a construct struct to the nodes of `lidarspec.spec.tree`.

* Expressions (counts, conditions, keys) are called with symbols in place of fields, and the
  operations on the symbols are recorded as a formula.
* The bit positions of a bit block are found by parsing test patterns with construct.
* A construct that no node can represent becomes `tree.Opaque`, with the reason. Only construct can
  parse it, one frame at a time.
"""

from __future__ import annotations

import functools
import operator
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import construct
import numpy as np
from construct import (
    Array,
    BitsInteger,
    Bytes,
    BytesInteger,
    Const,
    Construct,
    FormatField,
    Struct,
    Subconstruct,
)
from construct.expr import BinExpr, ExprMixin, UniExpr

from lidarspec.errors import SpecError
from lidarspec.spec import tree
from lidarspec.spec.bits import BitField, probe
from lidarspec.spec.syntax.adapters import (
    make_int_adapter,
    make_number_adapter,
    make_part_adapter,
    make_text_adapter,
    without_int_adapters,
)
from lidarspec.spec.syntax.replacements import (
    BoundedPart,
    ChecksummedBase,
    CountField,
    DescribedField,
    LimitedNumber,
    PaddingField,
    Partition,
    RawPart,
    Reserved,
    SizeField,
)
from lidarspec.spec.syntax.structs import (
    declared_class_name,
    fixed_size,
    is_greedy,
    iter_leaves,
    unwrap,
)


def frame_tree(con: Construct) -> tree.Node:
    """Return the tree of a struct.

    Raises:
        SpecError: if the constant of an Enum field is a name that the Enum does not have.
    """
    return _build_in_passes(lambda builder: builder.node(con, _Context(tree.FieldInfo(""), None)))[
        0
    ]


def _build_in_passes(build: Callable[[_Builder], tree.Node]) -> tuple[tree.Node, _Builder]:
    """Call `build`, again if necessary, and return the node and the builder.

    A struct with construct's Rebuild needs a second call, because the function of a Rebuild may
    refer to later fields.
    """
    builder = _Builder()
    root = build(builder)
    if builder.rebuilding:
        # The second builder knows the fields and sizes from the first call.
        builder = _Builder(builder)
        root = build(builder)
    return root, builder


def _trace(expression: Any, scope: tree.Scope) -> Any:
    """Evaluate an expression with symbols in place of the fields."""
    if isinstance(expression, BinExpr):
        return expression.op(_trace(expression.lhs, scope), _trace(expression.rhs, scope))
    if isinstance(expression, UniExpr):
        operand = _trace(expression.operand, scope)
        # construct evaluates ``~`` as ``not value``, which a symbol does not support.
        if expression.op is operator.not_ and isinstance(operand, tree.Symbol):
            return tree.Symbol(tree.Op("not", (operand.formula,)))
        return expression.op(operand)
    if callable(expression):
        return expression(scope)
    return expression


def _format_expression(expression: Any, path: str) -> str:
    """Return an expression as text with whole paths of fields; "?" for a function."""
    text = repr(expression)
    if " at 0x" in text:
        return "?"
    return re.sub(
        r"\bthis(?:\.\w+)+",
        functools.partial(_expand_path, path),
        re.sub(r"\['(\w+)'\]", r".\1", text),
    )


def _expand_path(path: str, way: re.Match[str]) -> str:
    """Return the whole path of ``this.count`` or ``this._.count`` in a part."""
    names = path.split(".")[:-1]
    for name in way[0].split(".")[1:]:
        if name == "_root":
            names = []
        elif name == "_":
            names = names[:-1]
        else:
            names = [*names, name]
    return ".".join(names)


@dataclass(frozen=True)
class _Context:
    """The context of a construct.

    Attributes:
        info: the facts about the field that its surrounding constructs declare.
        scope: the fields that expressions can refer to.
        name: the name of the construct in its struct; "" without a name.
    """

    info: tree.FieldInfo
    scope: tree.Scope | None
    name: str = ""
    in_bits: bool = False
    #: The number of bytes up to the end of the enclosing part, if another field declares its
    #: length.
    bytes_left: tree.Formula | None = None
    #: A function that returns the formula of the construct's offset in the frame, or None if there
    #: is no formula. There is never a formula in parts.
    offset: Callable[[], tree.Formula | None] | None = lambda: 0

    def with_changes(self, **changes: Any) -> _Context:
        """Return the context with some facts of the field changed."""
        return replace(self, info=replace(self.info, **changes))


class _Builder:
    """Makes the nodes of a struct.

    Args:
        before: the builder of the first pass, if this is the second pass (`_build_in_passes`).

    Attributes:
        scopes: the scope of each struct after all its members were added, by path.
        sizes: the formula of each SizeOf field, in the order of the fields; None while it is
            unknown.
        rebuilding: whether a second pass is required.
    """

    def __init__(self, before: _Builder | None = None) -> None:
        self._known: dict[str, tree.Scope] = {} if before is None else before.scopes
        self._sizes: list[tree.Formula | None] = [] if before is None else before.sizes
        self.scopes: dict[str, tree.Scope] = {}
        self.sizes: list[tree.Formula | None] = []
        self.rebuilding = False
        self._asked: list[tree.Ref] = []
        #: For each struct that is not complete yet, the SizeOf fields that measure a part of it, as
        #: (index in `sizes`, field).
        self._measured: dict[tree.Scope, list[tuple[int, SizeField]]] = {}

    def node(self, con: Construct, place: _Context) -> tree.Node:
        """Return the node of a construct of any class."""
        inner, place = self._unwrap_describing(con, place)
        name = place.name
        info = place.info
        is_block = isinstance(inner, construct.Transformed | construct.Restreamed)
        if not place.in_bits and (
            is_block or (isinstance(inner, BytesInteger) and _is_variable_integer(inner))
        ):
            return self._make_block(inner, place)
        if is_block:
            return self.node(inner.subcon, place)
        if isinstance(inner, ChecksummedBase):
            return self._make_checksummed(inner, place)
        if isinstance(inner, Struct):
            return self._make_struct(inner, place)
        if isinstance(inner, Array):
            axis = axis_path(info)
            count = self._to_formula(inner.count, place)
            inside = place.with_changes(axes=(*info.axes, axis), default=None)
            if inside.offset is not None:
                inside = replace(inside, offset=_return_no_offset)
            element = self.node(inner.subcon, inside)
            if _differ_in_layout(element, axis):
                sequence = self._make_sequence(inner.subcon, element, place, count=count)
                if sequence is not None:
                    return sequence
            return tree.Repeat(name, axis, count, element, info.default)
        if isinstance(inner, Partition):
            return self._make_parts(inner, place)
        if isinstance(inner, construct.IfThenElse):
            condition = self._to_formula(inner.condfunc, place)
            branches = (
                self.node(branch, place.with_changes(optional=True))
                for branch in (inner.thensubcon, inner.elsesubcon)
            )
            return tree.When(name, condition, *branches)
        if isinstance(inner, construct.Switch):
            return self._make_select(inner, place)
        if isinstance(inner, BoundedPart) or (
            isinstance(inner, construct.FixedSized)
            and is_greedy(inner.subcon, (type(construct.GreedyBytes),))
        ):
            bytes_left = self._to_formula(inner.length, place)
            return self.node(inner.subcon, replace(place, bytes_left=bytes_left))
        if isinstance(inner, construct.GreedyRange | construct.RepeatUntil) and not place.in_bits:
            return self._make_elements(inner, place)
        if isinstance(inner, RawPart):
            return self._make_raw_copy(inner, place)
        if isinstance(inner, construct.Check):
            return self._make_check(inner, place)
        if inner is construct.Error:
            return tree.Never(name)
        if inner is construct.Pass:
            return tree.Empty(name)
        if name and not place.in_bits:
            derived = self._make_derived(inner, place)
            if derived is not None:
                return derived
        return self._make_leaf(inner, place)

    def _make_derived(self, con: Construct, place: _Context) -> tree.Node | None:
        """Return the node of a value without bytes of its own, or None."""
        if isinstance(con, construct.Computed):
            return self._make_computed(con, place)
        if con is construct.Tell and place.offset is not None:
            info = _describe_integer(place.info)
            offset = place.offset()
            if offset is None:
                reason = (
                    f"{info.path}: Tell cannot be used in an array, or after a part of unknown size"
                )
                offset = tree.Untraced(reason, "?")
            self._add_value(place, offset)
            return tree.Derived(info, "offset")
        if isinstance(con, construct.Peek):
            node = self.node(con.subcon, place)
            if isinstance(tree.size(node), int) and all(map(_accepts_any_bytes, tree.nodes(node))):
                return tree.Derived(place.info, "peeked", node=node)
        return None

    def _make_computed(self, con: construct.Computed, place: _Context) -> tree.Node | None:
        if not callable(con.func):
            self._add_value(place, con.func)
            return tree.Derived(place.info, "computed", constant=con.func)
        formula = self._to_formula(con.func, place, may_be_fraction=True)
        asked = [] if isinstance(formula, tree.Untraced) else tree.refs(formula)
        is_fractional = tree.fraction_in(formula) is not None
        is_computable = (
            not isinstance(formula, tree.Untraced)
            and all(_is_single_value(ref, place.info) for ref in asked)
            and all(map(_is_always_defined, tree.iter_subformulas(formula)))
            and (is_fractional or tree.width(formula) <= tree.MAX_FORMULA_BITS)
        )
        if not is_computable:
            return None
        self._add_value(place, formula)
        is_float = is_fractional or any(ref.info.kind == "float" for ref in asked)
        info = replace(place.info, dtype=np.dtype(float), kind="float", bits=64)
        return tree.Derived(
            info if is_float else _describe_integer(place.info), "computed", formula
        )

    def _make_raw_copy(self, con: RawPart, place: _Context) -> tree.Struct:
        """Return a RawCopy as a struct with the value, its bytes and its offsets."""
        info = place.info
        scope = tree.RawCopyScope(place.scope, info.path, self._asked)
        if place.name and place.scope is not None:
            place.scope.add(place.name, scope)

        def field(name: str, **facts: Any) -> tree.FieldInfo:
            path = f"{info.path}.{name}".strip(".")
            return tree.FieldInfo(path, info.axes, optional=info.optional, **facts)

        default = info.default.get("value") if isinstance(info.default, dict) else None
        inside = _Context(
            field("value", default=default),
            scope,
            "value",
            bytes_left=place.bytes_left,
            offset=place.offset,
        )
        value = self.node(con.subcon, inside)
        size = tree.size(value)
        reason = "RawCopy cannot be used in an array, or if its offset or size is unknown"
        unknown = tree.Untraced(f"{info.path}: {reason}", "?")
        start = None if place.offset is None else place.offset()
        end = tree.combine("+", start, size)
        for name, content in {"offset1": start, "offset2": end, "length": size}.items():
            scope.add(name, tree.Value(unknown if content is None else content))
        data = field("data", dtype=np.dtype("u1"), kind="bytes")
        data = replace(data, axes=(*data.axes, data.path))
        part = inside.info.path
        behind = (
            tree.Derived(data, "bytes", part=part),
            tree.Derived(_describe_integer(field("length")), "size", part=part),
            tree.Derived(_describe_integer(field("offset2")), "offset"),
        )
        before = tree.Derived(_describe_integer(field("offset1")), "offset")
        return tree.Struct(place.name, info.path, (before, value, *behind), info.docs)

    def _add_value(self, place: _Context, content: Any) -> None:
        """Add a computed value to the scope, for later expressions."""
        if place.scope is not None:
            place.scope.add(place.name, tree.Value(content))

    def _unwrap_describing(self, con: Construct, place: _Context) -> tuple[Construct, _Context]:
        """Remove the wrappers that only describe a field, for example its name and unit.

        Returns:
            The wrapped construct, and the context with the facts of the wrappers.
        """
        while True:
            if isinstance(con, construct.Renamed):
                if con.docs:
                    place = place.with_changes(docs=con.docs)
            elif isinstance(con, DescribedField):
                place = replace(place, info=con.describe(place.info))
            elif (adapter := self._find_adapter(con, place.info)) is not None:
                place = place.with_changes(adapter=adapter, allowed=adapter.allowed)
            elif isinstance(con, construct.Enum):
                place = place.with_changes(
                    labels={
                        int(value): str(name)
                        for value, name in con.ksymapping.items()
                        if isinstance(value, int)
                    }
                )
            elif isinstance(con, Const):
                place = place.with_changes(const=_find_constant(con))
            elif isinstance(con, LimitedNumber):
                place = place.with_changes(allowed=con.allowed)
            elif isinstance(con, CountField):
                place = place.with_changes(is_enforced=True)
            elif isinstance(con, SizeField):
                place = place.with_changes(rebuilt=self._measure_part(con, place), is_enforced=True)
            elif isinstance(con, construct.Rebuild):
                self.rebuilding = True
                if place.scope is None:
                    known = None
                else:
                    known = self._known.get(place.scope.path)
                place = place.with_changes(rebuilt=self._to_formula(con.func, place, known))
            elif isinstance(con, construct.Default):
                place = place.with_changes(default=self._to_default(con.value, place))
            else:
                return con, place
            con = con.subcon

    def _find_adapter(self, con: Construct, info: tree.FieldInfo) -> tree.Adapter | None:
        """Return the adapter of an integer field; None with a constant, labels or a scale."""
        if info.const is not None or info.labels or info.scaled or info.rebuilt or info.adapter:
            return None
        return make_int_adapter(con)

    def _to_default(self, value: Any, place: _Context) -> Any:
        """Return the value of construct's Default, as a formula if it is a function."""
        if callable(value):
            return self._to_formula(value, place)
        return value

    def _to_formula(
        self,
        expression: Any,
        place: _Context,
        known: tree.Scope | None = None,
        *,
        is_key: bool = False,
        may_be_fraction: bool = False,
    ) -> tree.Formula:
        """Return a count, length, condition, key or computed value as a formula.

        Args:
            known: the scope of the expression; by default the scope of `place`.
            is_key: whether named values may be compared by their names.
            may_be_fraction: whether the result may be a fraction.
        """
        if isinstance(expression, int):
            return int(expression)
        scope = next(
            (scope for scope in (known, place.scope) if scope is not None),
            tree.Scope(None, "", self._asked),
        )
        scope.asked.clear()
        try:
            value = _trace(expression, scope)
            fraction = tree.fraction_in(value.formula) if isinstance(value, tree.Symbol) else None
            if not isinstance(expression, ExprMixin) and any(
                ref.info.optional for ref in scope.asked
            ):
                reason = (
                    "a Python function uses an optional field: write an expression of `this`"
                    " instead"
                )
            elif isinstance(value, bool | int):
                return int(value)
            elif not isinstance(value, tree.Symbol):
                reason = f"the value of the expression is always {value!r}, which is no integer"
            elif not is_key and isinstance(value.formula, tree.Ref) and value.formula.info.labels:
                reason = (
                    f"an expression uses the Enum field {value.formula.path} as a number, but"
                    " the value of this field is a name: declare the field without Enum"
                )
            elif fraction is not None and not may_be_fraction:
                reason = f"the result of an expression with {fraction!r} is not always an integer"
            else:
                return value.formula
        except tree.UntraceableExpressionError as untraceable:
            reason = str(untraceable)
        except Exception as error:
            reason = f"a Python function of other fields fails ({type(error).__name__}: {error})"
        path = place.info.path
        return tree.Untraced(f"{path}: {reason}", _format_expression(expression, path))

    def _make_select(self, con: construct.Switch, place: _Context) -> tree.Select:
        key = self._to_formula(con.keyfunc, place, is_key=True)
        labels = key.info.labels if isinstance(key, tree.Ref) else {}
        raw = {name: value for value, name in labels.items()}
        # construct finds the case of a named value only by its name
        values = {
            case: raw.get(str(case), case) if isinstance(case, str) else case
            for case in con.cases
            if case not in labels
        }
        named = [case for case in con.cases if case in labels and labels[case] not in con.cases]
        odd = [case for case, value in values.items() if not isinstance(value, int)]
        if (named or odd) and not isinstance(key, tree.Untraced):
            if named:
                reason = (
                    f"the case {named[0]} is never selected, because {tree.NAME_IS_COMPARED}:"
                    f" write {labels[named[0]]!r}"
                )
            elif isinstance(key, tree.Ref) and isinstance(odd[0], str):
                reason = f"{key.path} has no value named {odd[0]!r}"
            else:
                reason = f"the case {odd[0]!r} is not an integer"
            path = place.info.path
            key = tree.Untraced(f"{path}: {reason}", _format_expression(con.keyfunc, path))
        if isinstance(key, tree.Untraced):
            values = {case: case for case in con.cases}
        cases = tuple(
            (value, self._make_branch(con.cases[case], place)) for case, value in values.items()
        )
        return tree.Select(place.name, key, cases, self._make_branch(con.default, place))

    def _make_branch(self, con: Construct, place: _Context) -> tree.Node:
        return self.node(con, place.with_changes(optional=True))

    def _make_struct(self, con: Struct, place: _Context) -> tree.Struct:
        info = place.info
        scope = tree.Scope(place.scope, info.path, self._asked)
        if place.name and place.scope is not None:
            place.scope.add(place.name, scope)
        members = list[tree.Node]()
        self._measured[scope] = []
        for child in con.subcons:
            path = ".".join(part for part in (info.path, child.name) if part)
            if isinstance(info.default, dict):
                default = info.default.get(child.name)
            else:
                default = None
            described = tree.FieldInfo(
                path,
                info.axes,
                docs=info.docs if place.in_bits else "",
                optional=info.optional,
                default=default,
            )
            offset = (
                None
                if place.offset is None
                else functools.partial(_find_offset_after, place.offset, members, len(members))
            )
            inside = _Context(described, scope, child.name or "", place.in_bits, offset=offset)
            filler = unwrap(child)
            if isinstance(filler, construct.IfThenElse):
                filler = unwrap(filler.thensubcon)
            if isinstance(filler, PaddingField):
                size = _sum_member_sizes(members, filler.of[0])
                inside = replace(inside, bytes_left=self._find_padding_size(filler, inside, size))
            elif place.bytes_left is not None and child is con.subcons[-1]:
                inside = replace(
                    inside,
                    bytes_left=tree.combine(
                        "-", place.bytes_left, tree.sum_sizes(map(tree.size, members))
                    ),
                )
            members.append(self.node(child, inside))
        for index, member in enumerate(members):
            if isinstance(member, tree.Derived) and member.kind == "peeked":
                members[index] = _make_peeked(member, members[index + 1 :])
        self.scopes[info.path] = scope
        made = tree.Struct(place.name, info.path, tuple(members), info.docs)
        for index, sizing in self._measured.pop(scope):
            part = _find_below(made, sizing.of[sizing.levels_up :])
            self.sizes[index] = tree.sum_sizes(
                (
                    _sum_member_sizes(members, sizing.since, part.name)
                    if sizing.since
                    else tree.size(part),
                    sizing.plus,
                )
            )
        return made

    def _find_padding_size(
        self, con: PaddingField, place: _Context, size: tree.Formula | None
    ) -> tree.Formula | None:
        """Return the number of padding bytes after a part.

        Args:
            size: the size of the part in bytes.
        """
        number = self._to_formula(con.modulus if con.to is None else con.to, place)
        if con.to is not None:
            return tree.combine("-", number, size)
        if size is None:
            return size
        return tree.make_operation("%", tree.make_operation("-", size), number)

    def _measure_part(self, con: SizeField, place: _Context) -> tree.Formula | None:
        """Return the formula for the size of a part; None in the first pass."""
        scope = place.scope
        self.rebuilding = True
        for _ in range(con.levels_up):
            scope = None if scope is None else scope.parent
        if scope not in self._measured:
            raise SpecError(
                f"SizeOf refers to {'.'.join(con.of)!r}, which is outside its frame or part",
                path=place.info.path,
            )
        index = len(self.sizes)
        # `_make_struct` computes the size when the struct is complete.
        self._measured[scope].append((index, con))
        self.sizes.append(None)
        size = self._sizes[index] if self._sizes else None
        # This field also determines the length of the part, so its given value is kept.
        if isinstance(size, tree.Ref) and size.path == place.info.path:
            return None
        return size

    def _make_elements(
        self, con: construct.GreedyRange | construct.RepeatUntil, place: _Context
    ) -> tree.Node:
        """Return the node of construct's GreedyRange or RepeatUntil."""
        axis = axis_path(place.info)
        element = self.node(
            con.subcon,
            replace(
                place.with_changes(axes=(*place.info.axes, axis)),
                bytes_left=None,
                offset=None if place.offset is None else _return_no_offset,
            ),
        )
        size = tree.size(element)
        kind = declared_class_name(con)
        if isinstance(con, construct.RepeatUntil) or not isinstance(size, int):
            until = getattr(con, "predicate", None)
            within = place.bytes_left if until is None else None
            sequence = self._make_sequence(con.subcon, element, place, within=within, until=until)
            if sequence is not None:
                return sequence
        if isinstance(con, construct.RepeatUntil) or place.bytes_left is None:
            return tree.Opaque(place.name, place.info, kind, _OPAQUE_REASONS[kind], (element,))
        if not isinstance(size, int) or not size:
            reason = (
                "the number of elements is unknown, because the elements differ in size:"
                " use Parts(element, within=...)"
            )
            return tree.Opaque(place.name, place.info, kind, reason, (element,))
        return tree.Repeat(
            place.name, axis, tree.make_operation("//", place.bytes_left, size), element
        )

    def _make_parts(self, con: Partition, place: _Context) -> tree.PartSequence:
        info = place.info
        scope = place.scope
        axis = axis_path(place.info)
        assert scope is not None  # because parts are a member of a struct
        elements = [
            self.node(case, replace(place.with_changes(axes=(*info.axes, axis)), offset=None))
            for case in con.cases.values()
        ]
        kinds = list[tree.Kind]()
        outer = dict[tree.Ref, None]()
        for (name, case), element in zip(con.cases.items(), elements, strict=True):
            root, following = self._make_part_frame(case, con.following, place)
            kinds.append(tree.Kind(name, element, root, following))
            asked = [
                ref
                for node in tree.nodes(root)
                for formula in tree.formulas(node)
                for ref in tree.refs(formula)
            ]
            asked += [] if following is None else tree.refs(following)
            outer |= dict.fromkeys(
                tree.Ref(ref.path[2:], ref.info) for ref in asked if ref.path.startswith("_.")
            )
        count, size, within = (
            None if rule is None else self._to_formula(rule, place)
            for rule in (con.count, con.size, con.within)
        )
        total = tree.FieldInfo(
            f"{info.path}.size",
            info.axes,
            np.dtype(np.int64),
            "int",
            bits=64,
            docs="bytes of all parts",
        )
        known = scope.names[place.name] = tree.Scope(scope, info.path, self._asked)
        known.add("size", tree.Ref(total.path, total))
        return tree.PartSequence(
            place.name, axis, tuple(kinds), count, size, within, tuple(outer), total
        )

    def _make_sequence(
        self,
        con: Construct,
        element: tree.Node,
        place: _Context,
        *,
        count: tree.Formula | None = None,
        within: tree.Formula | None = None,
        until: Any = None,
    ) -> tree.PartSequence | None:
        """Return the elements of an array as a sequence of parts; None if unsupported.

        Args:
            con: the construct of an element.
            element: the node of the element.
            until: the predicate of construct's RepeatUntil, or None.
        """
        info = place.info
        is_struct = isinstance(element, tree.Struct | tree.ChecksummedStruct)
        if until is not None and not callable(until):
            return None  # construct reads one element, or elements without an end
        rules = [rule for rule in (count, within, until) if rule is not None]
        if not is_struct or not place.name or info.axes or place.scope is None or len(rules) != 1:
            return None
        try:
            root, rule = self._make_part_frame(
                con, None if until is None else functools.partial(_trace_predicate, until), place
            )
        except SpecError:  # a length of a part outside of the element
            return None
        ends = None if rule is None else tree.Op("!=", (rule, 0))
        asked = [ref for formula in _iter_formulas(root, ends) for ref in tree.refs(formula)]
        outer = [tree.Ref(ref.path[2:], ref.info) for ref in asked if ref.path.startswith("_.")]
        is_traced = not any(
            isinstance(part, tree.Untraced)
            for formula in _iter_formulas(root, ends)
            for part in tree.iter_subformulas(formula)
        )
        is_plain = any(isinstance(node, tree.Opaque) for node in tree.nodes(root))
        is_known = all(ref.info.kind == "int" and not ref.info.axes for ref in outer)
        if is_plain or not is_traced or not is_known:
            return None
        axis = axis_path(info)
        total = _describe_integer(
            tree.FieldInfo(f"{info.path}.size", info.axes, docs="bytes of all elements")
        )
        return tree.PartSequence(
            place.name,
            axis,
            (tree.Kind("", element, root, None, ends),),
            count,
            None,
            within,
            tuple(dict.fromkeys(outer)),
            total,
            is_array=True,
        )

    def _make_part_frame(
        self, case: Construct, following: Any, place: _Context
    ) -> tuple[tree.Node, tree.Formula | None]:
        """Return the node of a part as a frame of its own, and the formula of `following`.

        Args:
            following: an expression of fields of the part; None for no formula.
        """

        def around(builder: _Builder) -> _Context:
            assert place.scope is not None
            outside = tree.OuterScope(place.scope, builder._asked)
            return _Context(tree.FieldInfo(""), outside, offset=None)

        root, builder = _build_in_passes(lambda builder: builder.node(case, around(builder)))
        if following is None:
            rule = None
        else:
            rule = builder._to_formula(
                following, replace(around(builder), scope=builder.scopes[""])
            )
        return root, rule

    def _make_check(self, con: construct.Check, place: _Context) -> tree.Node:
        """Return the node of a condition."""
        condition = self._to_formula(con.func, place)
        info = place.info
        if isinstance(condition, int):
            if condition:
                return tree.Empty(place.name)
            return tree.Never(place.name)
        try:
            asked = [
                ref
                for ref in tree.refs(condition)
                if ref.path.startswith("_.") or ref.info.axes != info.axes[: len(ref.info.axes)]
            ]
            if (
                not asked
                and tree.width(condition) <= tree.MAX_FORMULA_BITS
                and all(map(_is_always_defined, tree.iter_subformulas(condition)))
            ):
                return tree.Check(place.name, info.path, info.axes, condition)
            if asked:
                reason = (
                    f"{info.path}: the condition uses {asked[0].path}, which is in another array or"
                    " frame"
                )
            else:
                reason = f"{info.path}: the value of the condition may exceed 64 bits"
        except ValueError as code:
            reason = str(code)
        return tree.Opaque(
            place.name,
            info,
            "Check",
            f"{reason.partition(': ')[2]}: use plausible=lambda f: ..., which is vectorized",
        )

    def _make_checksummed(self, con: ChecksummedBase, place: _Context) -> tree.Node:
        body = self.node(con.subcon, place)
        if not isinstance(body, tree.Struct | tree.ChecksummedStruct):
            return tree.Opaque(
                place.name,
                place.info,
                type(con).__name__,
                "Checksummed must contain a Struct",
                (body,),
            )
        prefix = f"{place.info.path}." if place.info.path else ""
        if con.over is not None:
            over = (prefix + con.over[0], prefix + con.over[-1])
        else:
            over = None
        return tree.ChecksummedStruct(
            body,
            tuple(prefix + name for name in con.fields),
            over,
            con.algorithm,
            tuple(sorted(con.absent)),
        )

    def _make_leaf(self, con: Construct, place: _Context) -> tree.Node:
        name = place.name
        info = _add_type(con, place.info)
        if name and place.scope is not None:
            place.scope.add(name, _to_scope_value(info))
        if isinstance(con, FormatField) and con.fmtstr[-1] != "?":
            big = con.fmtstr[0] in ">!" or (con.fmtstr[0] == "=" and sys.byteorder == "big")
            node: tree.Node = _make_number(info, con.length, is_big=big)
        elif isinstance(con, BytesInteger) and not _is_variable_integer(con) and con.length <= 8:
            node = _make_number(info, con.length, is_big=not con.swapped)
        elif place.bytes_left is not None and (
            isinstance(con, PaddingField) or con is construct.GreedyBytes
        ):
            if isinstance(con, PaddingField):
                info = replace(info, default=con.pattern)
            node = tree.Blob(name, info, place.bytes_left, info.const)
        elif isinstance(con, Bytes) and not isinstance(con, PaddingField):
            if isinstance(con, Reserved):
                info = replace(info, default=con.pattern)
            node = tree.Blob(name, info, self._to_formula(con.length, place), info.const)
        elif not place.in_bits and (blob := self._make_encoded_blob(con, place)) is not None:
            node = blob
            if name and place.scope is not None:
                place.scope.names[name] = _to_scope_value(blob.info)
        else:
            kind = declared_class_name(con)
            if isinstance(con, construct.FixedSized):
                size = self._to_formula(con.length, place)
            else:
                size = None
            node = tree.Opaque(
                name,
                info,
                kind,
                _find_opaque_reason(con),
                size=size,
                form=_describe_form(con),
            )
        if not name and info.const is not None and not isinstance(node, tree.Opaque):
            return tree.Blob("", info, con.length, con.build(info.const))
        return node

    def _make_encoded_blob(self, con: Construct, place: _Context) -> tree.Blob | None:
        """Return a node of bytes with functions that decode them, or None."""
        info = place.info
        if not place.name or info.const is not None or info.labels or info.rebuilt:
            return None
        ending = _find_ending(con, info, is_bounded=place.bytes_left is not None)
        adapter: tree.Adapter | None
        if ending is not None:
            size: tree.Formula | None = tree.Ref(ending.size.path, ending.size)
            adapter = _make_ended_adapter(con)
        elif isinstance(con, construct.StringEncoded):
            size = self._find_text_size(con, place)
            adapter = make_text_adapter(con)
        else:
            size = fixed_size(con) or place.bytes_left
            adapter = None if size is None else make_part_adapter(con)
        if size is None or (adapter is None and ending is None):
            return None
        axes = (*info.axes, axis_path(info))
        bits = 8 * size if isinstance(size, int) else 0
        known = replace(info, dtype=np.dtype("u1"), kind="bytes", bits=bits, axes=axes)
        return tree.Blob(place.name, replace(known, adapter=adapter), size, ending=ending)

    def _find_text_size(self, con: construct.StringEncoded, place: _Context) -> tree.Formula | None:
        """Return the size of a text in bytes.

        Returns None if the text extends to a terminator or to the end of the datagram.
        """
        inner = con.subcon
        if inner is construct.GreedyBytes:
            return place.bytes_left
        if isinstance(inner, BoundedPart | construct.FixedSized):
            content = inner.subcon
            if isinstance(content, construct.NullStripped):
                content = content.subcon
            is_whole = content is construct.GreedyBytes
            return self._to_formula(inner.length, place) if is_whole else None
        if isinstance(inner, Bytes):
            return self._to_formula(inner.length, place)
        return None

    def _make_block(self, con: Construct, place: _Context) -> tree.Node:
        """Return the node of a bit block; the bits of each field are found by probing."""
        inside = self.node(con, replace(place, in_bits=True))
        try:
            size = int(con.sizeof())
            fields = _probe_block(without_int_adapters(con), size)
        except (construct.ConstructError, LookupError):
            fields = None
        if fields is None:
            reason = (
                "each frame must have the same bit fields, which must be integers: declare the"
                " bits, and convert them in `points`"
            )
            return tree.Opaque(
                place.name, place.info, type(con).__name__, reason, (inside,), in_bits=True
            )
        infos = {
            node.info.path: node.info
            for node in tree.nodes(inside)
            if isinstance(node, tree.Number | tree.Blob | tree.Opaque)
        }
        parts = []
        for bits in fields:
            names = tuple(key for key in bits.keys if isinstance(key, str))
            info = infos[".".join(part for part in (place.info.path, *names) if part)]
            parts.append(
                tree.BlockInteger(
                    info, bits, names, tuple(key for key in bits.keys if isinstance(key, int))
                )
            )
        return tree.Block(place.name, place.info, size, tuple(parts))


def _to_scope_value(info: tree.FieldInfo) -> tree.Ref | tree.Value:
    """Return a field as a reference or a computed value for later expressions."""
    ref = tree.Ref(info.path, info)
    if info.adapter is None:
        return ref
    if info.kind == "bytes":
        reason = f"the expression uses {info.path}, which is not a number of fixed size"
    else:
        reason = f"the expression uses {info.path}, which a Python function computes"
    unknown = tree.Untraced(f"{info.path}: {reason}", "?")
    try:
        value = info.adapter.decode(tree.Symbol(ref))
    except Exception:  # a function of a plugin may raise anything for a symbol
        return tree.Value(unknown)
    return tree.Value(value.formula if isinstance(value, tree.Symbol) else unknown)


def _is_always_defined(formula: tree.Formula) -> bool:
    """Return whether an operation is defined for all values of its fields."""
    if not isinstance(formula, tree.Op) or formula.symbol not in ("/", "//", "%", "<<", ">>"):
        return True
    divisor = formula.args[1]
    return isinstance(divisor, int | float) and divisor > 0


def _differ_in_layout(element: tree.Node, axis: str) -> bool:
    """Return whether the elements of an array have checksums, or different layouts."""
    return any(
        isinstance(node, tree.ChecksummedStruct)
        or (isinstance(node, tree.Blob) and node.ending is not None)
        or any(
            axis in ref.info.axes for formula in tree.formulas(node) for ref in tree.refs(formula)
        )
        for node in tree.nodes(element)
    )


def _iter_formulas(root: tree.Node, *others: tree.Formula | None) -> Iterator[tree.Formula]:
    """Yield the formulas of all nodes and fields of a frame, and then `others`."""
    for node in tree.nodes(root):
        yield from tree.formulas(node)
        for info in tree.infos(node):
            for formula in (info.rebuilt, info.default):
                if isinstance(formula, tree.Ref | tree.Op | tree.Untraced):
                    yield formula
    yield from (formula for formula in others if formula is not None)


def _trace_predicate(predicate: Any, scope: tree.Scope) -> Any:
    """Trace the predicate of a RepeatUntil for one element."""
    if isinstance(predicate, ExprMixin):
        return _trace(predicate, scope)
    # None stands for the list of elements.
    return predicate(scope, None, scope.parent)


def _return_no_offset() -> None:
    """Return None, because each element of an array has a different offset."""
    return


def _find_offset_after(
    start: Callable[[], tree.Formula | None], members: Sequence[tree.Node], count: int
) -> tree.Formula | None:
    """Return the offset after the first `count` members of a struct."""
    return tree.combine("+", start(), tree.sum_sizes(map(tree.size, members[:count])))


def _is_single_value(ref: tree.Ref, info: tree.FieldInfo) -> bool:
    """Return whether a field has one number for each element of a computed value.

    Several elements may have the same number, for example that of a field of the whole frame.

    Args:
        ref: a reference to the field.
        info: the description of the computed value.
    """
    return (
        not ref.path.startswith("_.")
        and ref.info.kind in ("int", "float")
        and ref.info.axes == info.axes[: len(ref.info.axes)]
        and (info.optional or not ref.info.optional)
    )


def _describe_integer(info: tree.FieldInfo) -> tree.FieldInfo:
    """Return the description of a field, with the type int64 of computed integers."""
    return replace(info, dtype=np.dtype(np.int64), kind="int", bits=64)


def _make_peeked(derived: tree.Derived, behind: Sequence[tree.Node]) -> tree.Node:
    """Return the node of a field that construct's Peek reads.

    Args:
        behind: the nodes after the field.
    """
    assert derived.node is not None
    needed = tree.size(derived.node)
    if isinstance(needed, int) and sum(map(_find_min_size, behind)) >= needed:
        return derived
    reason = "Peek may read beyond the frame: declare the following bytes in the same Struct"
    return tree.Opaque(derived.name, derived.info, "Peek", reason)


def _accepts_any_bytes(node: tree.Node) -> bool:
    """Return whether a node accepts any bytes."""
    is_plain = isinstance(node, tree.Number | tree.Blob | tree.Block | tree.Struct | tree.Repeat)
    infos = tree.infos(node)
    return is_plain and all(info.const is None and info.allowed is None for info in infos)


def _find_min_size(node: tree.Node) -> int:
    """Return the minimum size of a node in bytes; 0 if it is not known."""
    match node:
        case tree.When():
            return min(_find_min_size(node.then), _find_min_size(node.otherwise))
        case tree.Select():
            options = [*(case for _, case in node.cases), node.default]
            sizes = [_find_min_size(case) for case in options if not isinstance(case, tree.Never)]
            return min(sizes, default=0)
        case tree.Struct() | tree.ChecksummedStruct():
            return sum(map(_find_min_size, tree.children(node)))
        case tree.Repeat():
            return node.count * _find_min_size(node.element) if isinstance(node.count, int) else 0
    size = tree.size(node)
    return size if isinstance(size, int) else 0


def _sum_member_sizes(
    members: Sequence[tree.Node], first: str, last: str = ""
) -> tree.Formula | None:
    """Return the size of consecutive members of a struct.

    Args:
        last: the name of the last member; "" for `first` alone.
    """
    names = [member.name for member in members]
    return tree.sum_sizes(
        map(tree.size, members[names.index(first) : names.index(last) + 1 if last else None])
    )


def _find_below(node: tree.Node, names: Iterable[str]) -> tree.Node:
    """Return the node at a path in a struct.

    Raises:
        SpecError: if the path does not exist.
    """
    for name in names:
        body = node.struct if isinstance(node, tree.ChecksummedStruct) else node
        if isinstance(body, tree.Struct):
            found = [member for member in body.members if member.name == name]
        else:
            found = []
        if not found:
            raise SpecError(
                f"SizeOf refers to {'.'.join(names)!r}, but {name!r} does not exist",
                path=getattr(body, "path", ""),
            )
        node = found[0]
    return node


_VARIABLE_REASON = (
    "a {} cannot be a length, a count, a constant or an Enum: use an integer of fixed size"
)
_TRANSFORMED_REASON = (
    "{} transforms bytes: declare the bytes on the wire and transform them in `points` (f.x ^"
    " 0x55), or use a WireForm"
)

#: The classes that only construct can read, and a message for each that suggests a replacement.
_OPAQUE_REASONS = {
    "ProcessXor": _TRANSFORMED_REASON.format("ProcessXor"),
    "ProcessRotateLeft": _TRANSFORMED_REASON.format("ProcessRotateLeft"),
    "Compressed": _TRANSFORMED_REASON.format("Compressed"),
    "NamedTuple": "a NamedTuple is not a number: use the Array or Struct inside it",
    "StringEncoded": (
        "a text is not a number, and the fields after it have no fixed offset: use Bytes(n), and"
        " decode the bytes for display"
    ),
    "Mapping": (
        "a Mapping has values that are not names: use Enum for names, or Scaled(field, step,"
        " unit) for numbers"
    ),
    "ExprAdapter": (
        "an ExprAdapter is Python code: use Scaled(field, step, unit, offset), or calculate the"
        " value in `points`"
    ),
    "ExprValidator": (
        "the valid values of an ExprValidator cannot be listed: use OneOf with the valid values,"
        " or plausible=lambda f: ..."
    ),
    "Computed": (
        "a Python function calculates the value from other fields: use an expression such as"
        " this.a * 2 + 1"
    ),
    "Peek": "Peek reads a part without a fixed size: declare the bytes of the part as a field",
    "Tell": "Tell is used in Parts: use SizeOf for the length of a part",
    "Index": "Index is not on the wire: in `points` the index of an element is f.x.index",
    "LazyBound": "a part that contains itself has no fixed offset: use Parts for a sequence",
    "VarInt": _VARIABLE_REASON.format("VarInt"),
    "ZigZag": _VARIABLE_REASON.format("ZigZag"),
    "FocusedSeq": (
        "PrefixedArray and FocusedSeq must be named members of a Struct, as in"
        " Struct('points' / PrefixedArray(...)). Parts other than the value and its"
        " count must have a fixed size, and must not depend on other parts"
    ),
    "Prefixed": "Prefixed must be a named member of a Struct: Struct('part' / Prefixed(...))",
    "Sequence": "the parts of a Sequence have no names: use Struct('a' / ..., 'b' / ...)",
    "GreedyRange": (
        "GreedyRange reads the rest of a datagram: use PrefixedArray, or Prefixed with GreedyRange"
    ),
    "NullTerminated": (
        "the fields after a text with a terminator have no fixed offset: use Bytes(n) for the text"
    ),
    "Terminated": "Terminated expects the end of the datagram: remove Terminated",
    "RepeatUntil": (
        "the fields after RepeatUntil have no fixed offset: use Array with a count, or Parts"
    ),
}

#: The kinds of numbers, by the kind of their dtype.
_NUMBER_KINDS: dict[str, Literal["uint", "int", "float"]] = {"u": "uint", "i": "int", "f": "float"}


def _make_number(info: tree.FieldInfo, size: int, *, is_big: bool) -> tree.Number:
    """Return the node of a number of whole bytes."""
    assert info.dtype is not None
    return tree.Number(info, size, _NUMBER_KINDS[info.dtype.kind], "big" if is_big else "little")


def axis_path(info: tree.FieldInfo) -> str:
    """Return the name of an array's axis: the path of the array field.

    For an array in an array of the same field, "[]" is appended.
    """
    path = info.path
    while path in info.axes:
        path += "[]"
    return path


def integer_type(bits: int, *, signed: bool = False) -> np.dtype[Any]:
    """Return the smallest integer type of at least this number of bits."""
    size = next(size for size in (1, 2, 4, 8) if bits <= 8 * size)
    return np.dtype(f"{'i' if signed else 'u'}{size}")


def _add_type(con: Construct, info: tree.FieldInfo) -> tree.FieldInfo:
    """Return the description of a field, with the type of its values."""
    if isinstance(con, FormatField):
        code = con.fmtstr[-1]
        if code in "efd":
            kind = "float"
            letter = "f"
        else:
            kind = "int"
            letter = "u" if code.isupper() or code == "?" else "i"
        return replace(
            info, dtype=np.dtype(f"{letter}{con.length}"), kind=kind, bits=8 * con.length
        )
    if isinstance(con, BytesInteger | BitsInteger) and isinstance(con.length, int):
        bits = con.length * (8 if isinstance(con, BytesInteger) else 1)
        if bits <= 64:
            dtype = integer_type(bits, signed=bool(con.signed))
        else:
            dtype = None
        return replace(info, dtype=dtype, kind="int" if dtype is not None else "other", bits=bits)
    if isinstance(con, type(construct.Flag)):
        return replace(info, dtype=np.dtype("u1"), kind="int", bits=1)
    if isinstance(con, Bytes):
        bits = 8 * con.length if isinstance(con.length, int) else 0
        return replace(
            info, dtype=np.dtype("u1"), kind="bytes", bits=bits, axes=(*info.axes, axis_path(info))
        )
    if _is_text(con):
        return replace(info, dtype=np.dtype("u1"), kind="bytes", axes=(*info.axes, axis_path(info)))
    return info


def _is_text(con: Construct) -> bool:
    """Return whether a construct consists of plain bytes up to an end, like a text."""
    while isinstance(
        con,
        construct.NullTerminated
        | construct.NullStripped
        | construct.FixedSized
        | construct.Prefixed,
    ):
        con = con.subcon
    return con is construct.GreedyBytes


def _find_opaque_reason(con: Construct) -> str:
    """Return the reason why only construct can read a part."""
    below = con
    while declared_class_name(below) not in _OPAQUE_REASONS and isinstance(below, Subconstruct):
        below = below.subcon
    kind = declared_class_name(below)
    return _OPAQUE_REASONS.get(kind, f"{declared_class_name(con)} has no fixed offset")


def _describe_form(con: Construct) -> str:
    """Return how a field of variable size is stored, as text to display."""
    below = con
    while isinstance(below, Subconstruct):
        if isinstance(below, construct.NullTerminated):
            return f"text up to {str(below.term)[1:]}"
        below = below.subcon
    return type(con).__name__


def _find_ending(con: Construct, info: tree.FieldInfo, *, is_bounded: bool) -> tree.Ending | None:
    """Return the mark that ends a field of variable size; None if no mark ends it.

    Args:
        is_bounded: whether the field is in a part of known size.
    """
    size = _describe_integer(
        tree.FieldInfo(f"{info.path}.size", info.axes, docs="bytes before the end of the content")
    )
    if con in (construct.VarInt, construct.ZigZag):
        # The high bit of a byte says that another byte follows.
        return tree.Ending(size, mark=b"\x00", mask=b"\x80", is_content=True)
    if isinstance(con, construct.StringEncoded):
        con = con.subcon
    if con is construct.GreedyBytes and not is_bounded:
        return tree.Ending(size, mark=b"", mask=b"")
    is_plain = (
        isinstance(con, construct.NullTerminated)
        and con.subcon is construct.GreedyBytes
        and con.consume
        and con.require
        and not con.include
    )
    if not is_plain:
        return None
    return tree.Ending(size, mark=con.term, mask=b"\xff" * len(con.term))


def _make_ended_adapter(con: Construct) -> tree.Adapter | None:
    """Return the functions that decode a text or number of variable size, or None."""
    if isinstance(con, construct.StringEncoded):
        return make_text_adapter(con)
    if con in (construct.VarInt, construct.ZigZag):
        return make_number_adapter(con)
    return None


def _find_constant(con: Const) -> Any:
    """Return the raw value of a constant, which may be a name of an Enum.

    Raises:
        SpecError: if the Enum does not have the name.
    """
    below = con.subcon
    while isinstance(con.value, str) and isinstance(below, Subconstruct):
        if isinstance(below, construct.Enum):
            if con.value not in below.encmapping:
                raise SpecError(
                    f"invalid constant {str(con.value)!r}: expected one of"
                    f" {', '.join(map(str, below.encmapping))}"
                )
            return int(below.encmapping[con.value])
        below = below.subcon
    return con.value


def _is_variable_integer(con: BytesInteger) -> bool:
    """Return whether the length or byte order of an integer is an expression."""
    is_wide = isinstance(con.length, int) and con.length > 8
    return not is_wide and not (isinstance(con.length, int) and isinstance(con.swapped, bool))


@functools.lru_cache(maxsize=4096)
def _probe_block(con: Construct, size: int) -> list[BitField] | None:
    """Return the bit fields of a block; None if they vary or are not plain integers."""
    # If a value determines which fields follow, probing with a few patterns can miss a variant.
    if _has_fixed_fields(con):
        return probe(lambda block: dict(iter_leaves(con.parse(block, _verify=False))), size)
    return None


def _has_fixed_fields(con: Construct) -> bool:
    """Return whether a bit block has the same fields for all bit patterns."""
    if isinstance(con, Struct):
        return all(map(_has_fixed_fields, con.subcons))
    if isinstance(con, Subconstruct):
        return (
            isinstance(con, construct.Enum) or not isinstance(con, construct.Adapter)
        ) and _has_fixed_fields(con.subcon)
    return isinstance(con, BitsInteger | Bytes | BytesInteger | FormatField | type(construct.Flag))


def bytes_of(con: Construct, names: Iterable[str]) -> list[int]:
    """Return the offsets of the bytes of a block that contain bits of a field.

    Args:
        names: the names that lead from the block to the field.

    Raises:
        KeyError: if the block does not have the field.
    """
    keys = tuple(names)
    for field in _probe_block(without_int_adapters(con), con.sizeof()) or ():
        if field.keys == keys:
            return [segment.byte for segment in field.segments]
    raise KeyError(".".join(keys))
