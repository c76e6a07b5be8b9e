"""What goes wrong with a simulated sensor, and between it and its reader, on request: damaged
bytes, lost and reordered packets, a pulled plug, a blocked rotor.

The same seed does the same harm to the same packets, however they are cut into batches.
"""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from lidarspec.errors import OutOfRange, UsageError
from lidarspec.spec.fields import duration, share

#: share of the datagrams that come late where any are reordered.
LATE = 0.1
#: what a rotor can be that does not turn.
BLOCKED = "blocked"


@dataclass(frozen=True)
class Faults:
    """What goes wrong.

    Args:
        errors: share of the bytes that are damaged; changed, in a byte stream also lost or
            followed by one too many.
        loss: share of the packets that are lost whole.
        reorder: how many places late a datagram may come, one in ten does.
        unplug: seconds after which the sensor is unplugged, again and again; 0: never.
        absent: seconds that it is away then.
        shake: standard deviation of the noise on what an IMU feels, m/s2 and rad/s; 0: it is at
            rest.
        rotor: "blocked": it does not turn, and the angles stay as they are; "" where it does.

    Raises:
        OutOfRange: for a share that is none, or a negative number.
        UsageError: for a rotor that is something else.
    """

    errors: float = 0.0
    loss: float = 0.0
    reorder: int = 0
    unplug: float = 0.0
    absent: float = 2.0
    rotor: str = ""
    shake: float = 0.0

    def __post_init__(self) -> None:
        for name, high in (
            ("errors", 1.0),
            ("loss", 1.0),
            ("reorder", 1000),
            ("unplug", math.inf),
            ("absent", math.inf),
            ("shake", math.inf),
        ):
            value = getattr(self, name)
            if not 0 <= value <= high:
                raise OutOfRange(name, value, 0, high, place="faults")
        if self.rotor not in ("", BLOCKED):
            raise UsageError(f"the rotor turns, or is {BLOCKED!r}, not {self.rotor!r}")


def faults_of(options: Mapping[str, str]) -> Faults:
    """The faults that options name by text: ``{"errors": "1%", "loss": "0.01", "unplug": "30s"}``.

    Raises:
        UsageError: for a value that is not of its kind.
    """
    read: dict[str, Any] = {
        "errors": share,
        "loss": share,
        "reorder": int,
        "unplug": duration,
        "absent": duration,
        "shake": float,
        "rotor": str,
    }
    values = {}
    for name, text in options.items():
        try:
            values[name] = read[name](text)
        except ValueError:
            raise UsageError(f"{name} is a number, not {text!r}") from None
    return Faults(**values)


#: the names of what can go wrong.
FAULTS = tuple(field.name for field in fields(Faults))


class Line:
    """The way from a sensor to its reader.

    Args:
        stream: a byte stream; else datagrams.

    Attributes:
        sent: number of packets given to `carry`.
        intact: packets of which every byte arrives, in order and with nothing between.
        lost: packets of which no byte arrives.

    Raises:
        UsageError: for reordering on a byte stream, which has no such fault.
    """

    def __init__(self, faults: Faults, *, seed: int = 0, stream: bool) -> None:
        if stream and faults.reorder:
            raise UsageError("reorder is for datagrams; bytes on a line keep their order")
        self._faults = faults
        self._stream = stream
        self._source = random.Random(f"line {seed}")
        self._clean = self._gap()
        self._number = 0
        self._late: list[tuple[int, int, str, bytes]] = []
        self.sent = self.intact = self.lost = 0

    def carry(self, packets: Sequence[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
        """What arrives of these packets, each a name and its bytes; those that are late come with a
        later call.
        """
        self.sent += len(packets)
        if not (self._faults.errors or self._faults.loss or self._faults.reorder):
            self.intact += len(packets)
            return list(packets)
        arrived: list[tuple[str, bytes]] = []
        for name, data in packets:
            if self._faults.loss and self._source.random() < self._faults.loss:
                self.lost += 1
            else:
                harmed = self._harmed(data)
                if data in harmed:  # a byte inserted after the frame leaves it whole
                    self.intact += 1
                depth = self._faults.reorder
                if depth and self._source.random() < LATE:
                    delay = self._source.randint(1, depth)
                else:
                    delay = 0
                heapq.heappush(self._late, (self._number + delay, self._number, name, harmed))
            while self._late and self._late[0][0] <= self._number:
                arrived.append(heapq.heappop(self._late)[2:])
            self._number += 1
        return arrived

    def _gap(self) -> int:
        """Sound bytes up to the next damaged one."""
        rate = self._faults.errors
        if rate in (0.0, 1.0):
            return 0
        return int(math.log(1 - self._source.random()) / math.log1p(-rate))

    def _harmed(self, frame: bytes) -> bytes:
        if not self._faults.errors:
            return frame
        out = bytearray()
        start = 0
        while start + self._clean < len(frame):
            spot = start + self._clean
            out += frame[start:spot] + self._byte(frame[spot])
            start = spot + 1
            self._clean = self._gap()
        self._clean -= len(frame) - start
        return bytes(out + frame[start:])

    def _byte(self, byte: int) -> bytes:
        changed = bytes([byte ^ 1 << self._source.randrange(8)])
        if self._stream:
            return self._source.choice((b"", changed, bytes([byte, self._source.randrange(256)])))
        return changed
