"""Which generated code parses a frame: found by the bytes of the header fields that its layout depends on."""

from __future__ import annotations

from typing import Any

from construct import Construct

from lidarspec.frames.headers import HeaderTree
from lidarspec.frames.layout import Layout, Leaf
from lidarspec.frames.unpacking import Unpack, unpacker

#: headers whose functions are remembered; frames that are all different must not fill the memory.
_REMEMBERED = 4096


def frame_parser(con: Construct, tree: HeaderTree) -> Unpack:
    """A function from the bytes of a whole, sound frame to its Container; it gives None where construct has to look at them."""
    root: Unpack | _Branch | None = None
    known = 0
    start = b""
    while tree.prefix.get(len(start), (0, 0))[0] == 0xFF:
        start += bytes([tree.prefix[len(start)][1]])

    def learned(frame: bytes) -> Unpack:
        nonlocal root, known
        if not frame.startswith(start):
            return _nothing
        layout = tree.layout(frame)
        if not isinstance(layout, Layout):
            return _nothing
        found: Unpack = layout.notes.get(unpacker) or layout.notes.setdefault(unpacker, unpacker(con, layout) or _nothing)
        if known >= _REMEMBERED:
            root, known = None, 0
        known += 1
        leaves = tree.asked(frame)
        if not leaves:
            root = found
            return found
        root = node = root if isinstance(root, _Branch) else _Branch(leaves[0])
        for leaf in leaves[1:]:
            node = node.setdefault(frame[node.start : node.end], _Branch(leaf))
        node[frame[node.start : node.end]] = found
        return found

    def parse(frame: bytes) -> Any:
        node = root
        while isinstance(node, _Branch):
            node = node.get(frame[node.start : node.end])
        return (node or learned(frame))(frame)

    return parse


class _Branch(dict[bytes, Any]):
    """What follows, by the bytes of a header field: another field, or the function for the frame."""

    def __init__(self, leaf: Leaf) -> None:
        super().__init__()
        self.start, self.end = leaf.offset, leaf.offset + leaf.size


def _nothing(frame: bytes) -> None:
    """Leaves the frame to construct."""
