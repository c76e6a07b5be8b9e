"""Check which structs can be compiled to layouts (`lidarspec.frames.layout`).

A struct can be compiled only if the offsets of all fields depend on nothing but header fields and
measured sizes (`lidarspec.frames.measured_size`). construct parses the frames of all other structs.
"""

from __future__ import annotations

from lidarspec.frames.schema import make_schema
from lidarspec.spec import tree


class NotCompilableError(Exception):
    """The reason why a struct cannot be compiled to layouts.

    Attributes:
        path: the path of the field or array that causes the error.
    """

    def __init__(self, path: str, reason: str) -> None:
        self.path = path
        self.reason = reason
        super().__init__(f"{path}: {reason}" if path else reason)


def check_compilable(root: tree.Node) -> None:
    """Raise `NotCompilableError` if the frames of a tree cannot have layouts."""
    _check(root, "", is_in_array=False)
    _check_columns(root)


def _check(node: tree.Node, path: str, *, is_in_array: bool) -> None:
    match node:
        case tree.Opaque():
            raise NotCompilableError(node.info.path, node.reason)
        case tree.ChecksummedStruct():
            if is_in_array:
                raise NotCompilableError(path, "the checksum is inside an array")
            _ = node.algorithm
        case tree.Blob() if is_in_array and node.ending is not None:
            raise NotCompilableError(
                node.info.path,
                "the size of each element depends on its content: use an array of structs",
            )
        case tree.PartSequence() if is_in_array:
            raise NotCompilableError(path, "the sequence of parts is inside an array")
        case tree.Block():
            for part in node.parts:
                if len(part.indices) > 1:
                    raise NotCompilableError(
                        part.info.path, "the bit field is inside an array of arrays"
                    )
        case tree.When() | tree.Select():
            _check_alternatives(node)
    for formula in tree.formulas(node):
        _check_traced(formula)
        for ref in tree.refs(formula):
            check_selector(ref.info)
    for info in tree.infos(node):
        _check_traced(info.rebuilt)
        _check_traced(info.default)
    if isinstance(node, tree.PartSequence):
        for kind in node.kinds:
            _check_part(kind, path)
        return
    for child in tree.children(node):
        if isinstance(node, tree.Struct):
            below = f"{path}.{child.name}".strip(".")
        else:
            below = path
        _check(child, below, is_in_array=is_in_array or isinstance(node, tree.Repeat))


def _check_alternatives(node: tree.When | tree.Select) -> None:
    """Check that the cases of an If or Switch have no conflicting names."""
    # `build` finds the value of such a field by its name, before it selects an alternative.
    alternatives = tree.children(node)
    for alternative in alternatives:
        others = [other for other in alternatives if other is not alternative]
        is_only_one = all(isinstance(other, tree.Empty) for other in others)
        names = {path for other in others for path in _list_names(other)}
        for part in tree.nodes(alternative):
            path = _get_measured_path(part)
            if path and (path in names or (part is alternative and not is_only_one)):
                raise NotCompilableError(
                    path,
                    "several cases of an If or Switch have a field with this name, and the size of"
                    " one of these fields depends on its content: use different names",
                )


def _get_measured_path(node: tree.Node) -> str:
    """Return the path of `node` if its size is found by reading its content, else ""."""
    if isinstance(node, tree.PartSequence) and node.is_array:
        return node.axis
    if isinstance(node, tree.Blob) and node.ending is not None:
        return node.info.path
    return ""


def _list_names(node: tree.Node) -> set[str]:
    """Return the paths of all fields and arrays of a node, and the paths that contain them."""
    paths = {info.path for part in tree.nodes(node) for info in tree.infos(part)}
    paths |= {
        part.axis for part in tree.nodes(node) if isinstance(part, tree.Repeat | tree.PartSequence)
    }
    names = set[str]()
    for path in paths:
        steps = path.split(".")
        names |= {".".join(steps[:count]) for count in range(1, len(steps) + 1)}
    return names


def _check_traced(formula: object) -> None:
    if isinstance(formula, tree.Untraced):
        path, _, reason = formula.reason.partition(": ")
        raise NotCompilableError(path, reason)


def _check_part(kind: tree.Kind, path: str) -> None:
    """Raise `NotCompilableError` if a kind of parts cannot be compiled."""
    try:
        for formula in (kind.following, kind.until):
            for ref in () if formula is None else tree.refs(formula):
                check_selector(ref.info)
        check_compilable(kind.root)
    except NotCompilableError as reason:
        raise NotCompilableError(f"{path}.{reason.path}".rstrip("."), reason.reason) from None


def _check_columns(root: tree.Node) -> None:
    """Raise `NotCompilableError` if no column can represent the values of a field."""
    for info in make_schema(root).fields.values():
        if info.dtype is None:
            wide = f"the field has {info.bits} bits, and a column has at most 64"
            raise NotCompilableError(
                info.path,
                wide if info.bits > 64 else "the values of the field are not numbers of one type",
            )


def check_selector(info: tree.FieldInfo) -> None:
    """Raise `NotCompilableError` if layouts cannot depend on the value of a field."""
    if info.kind == "int" and info.axes and info.axes[-1].strip("[]") != info.path:
        raise NotCompilableError(
            info.path,
            "elements of one array have different layouts: declare the array as"
            " Parts(struct, count)",
        )
    if info.axes or info.kind != "int":
        raise NotCompilableError(
            info.path, "the layout depends on this field, which is not a single integer"
        )
