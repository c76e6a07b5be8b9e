"""Split messages into datagrams, as `lidarspec.spec.links.Assembled` declares."""

from __future__ import annotations

from typing import Any

from lidarspec.simulation.frame_maker import FrameMaker
from lidarspec.spec.description import Frame
from lidarspec.spec.links import Assembled

#: Maximum number of bytes of a message in one datagram. With its header, the datagram fits into an
#: Ethernet frame.
MAX_PART_BYTES = 1400
MAX_DATAGRAM_BYTES = 65_535


class Fragmenter:
    """Splits the messages of one link.

    Args:
        sensor: the id of the sensor, for errors.
        rule: declares the fields of a fragment.
    """

    def __init__(self, sensor: str, rule: Assembled) -> None:
        self._rule = rule
        self._maker = FrameMaker.of_struct(
            sensor, Frame(rule.struct, max_length=MAX_DATAGRAM_BYTES)
        )
        self._message_number = 0

    def split(self, message: bytes) -> list[bytes]:
        """Return the datagrams of the next message."""
        offsets = range(0, len(message), MAX_PART_BYTES)
        datagrams = []
        for number, offset in enumerate(offsets):
            part = message[offset : offset + MAX_PART_BYTES]
            if self._rule.in_bytes:
                head = self._make_head(offset, len(message))
            else:
                head = self._make_head(number, len(offsets))
            if self._rule.payload:
                datagrams.append(self._maker.frame({**head, self._rule.payload: part}))
            else:
                datagrams.append(self._maker.frame(head) + part)
        self._message_number += 1
        return datagrams

    def _make_head(self, index: int, count: int) -> dict[str, Any]:
        """Return the physical values of the fields that identify a fragment."""
        rule = self._rule
        fields = self._maker.schema.fields
        number = self._message_number % (1 << fields[rule.keys[0]].bits)
        raw = {rule.keys[0]: number, rule.index: rule.first + index, rule.count: count}
        return {path: fields[path].physical(value) for path, value in raw.items()}
