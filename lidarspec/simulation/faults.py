"""Inject faults into the data of a simulated sensor.

The faults are corrupt bytes, lost and reordered packets, disconnections, a blocked rotor, IMU noise
and faults of the clock. The same seed and the same packets give the same faults.
"""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from lidarspec.errors import OutOfRange, UsageError
from lidarspec.simulation.clock_faults import ClockFaults, parse_clock_faults
from lidarspec.spec.fields import parse_duration, parse_share

#: Fraction of datagrams that are delayed if `reorder` is set.
DELAYED_SHARE = 0.1
#: Value of `Faults.rotor` for a rotor that does not turn.
BLOCKED = "blocked"


@dataclass(frozen=True)
class Faults:
    """The faults of a simulated sensor.

    Args:
        errors: fraction of bytes to corrupt, 0 to 1. In a byte stream, bytes may also be dropped or
            inserted.
        loss: fraction of packets to drop, 0 to 1.
        reorder: maximum delay of a datagram, in packets; 0 for no delay.
        unplug: how long the device stays connected before each disconnection, in seconds; 0 for no
            disconnection.
        absent: duration of each disconnection, in seconds.
        shake: standard deviation of the noise on IMU measurements, in m/s2 for accelerations and in
            rad/s for angular rates; 0 for no noise.
        clock: the faults of the sensor's clock.
        rotor: "blocked" if the rotor does not turn and the angles are constant; "" if it turns.

    Raises:
        OutOfRange: if a fraction is not between 0 and 1, or a number is negative.
        UsageError: for another value of `rotor`.
    """

    errors: float = 0.0
    loss: float = 0.0
    reorder: int = 0
    unplug: float = 0.0
    absent: float = 2.0
    rotor: str = ""
    shake: float = 0.0
    clock: ClockFaults = field(default_factory=ClockFaults)

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
            raise UsageError(f"invalid rotor {self.rotor!r}: expected {BLOCKED!r}")


def parse_faults(options: Mapping[str, str]) -> Faults:
    """Parse options, for example ``{"errors": "1%", "unplug": "30s"}``.

    Raises:
        UsageError: if a value cannot be parsed.
    """
    read: dict[str, Any] = {
        "errors": parse_share,
        "loss": parse_share,
        "reorder": int,
        "unplug": parse_duration,
        "absent": parse_duration,
        "shake": float,
        "rotor": str,
        "clock": parse_clock_faults,
    }
    values = {}
    for name, text in options.items():
        try:
            values[name] = read[name](text)
        except ValueError:
            raise UsageError(f"invalid {name}: expected a number, got {text!r}") from None
    return Faults(**values)


#: The names of the faults, which are options of ``sim:`` sources.
FAULTS = tuple(one.name for one in fields(Faults))


class FaultyLink:
    """A link that corrupts, drops and reorders packets.

    Args:
        stream: whether the link is a byte stream, instead of datagrams.

    Attributes:
        sent: number of packets that were passed to `transmit`.
        intact: number of packets that arrived without a corrupt byte.
        lost: number of packets that were dropped.

    Raises:
        UsageError: if a byte stream is to be reordered.
    """

    def __init__(self, faults: Faults, *, seed: int = 0, stream: bool) -> None:
        if stream and faults.reorder:
            raise UsageError("reorder requires datagrams; a byte stream keeps its order")
        self._faults = faults
        self._stream = stream
        self._source = random.Random(f"line {seed}")
        self._valid_bytes_left = self._draw_gap()
        self._number = 0
        self._late: list[tuple[int, int, str, bytes]] = []
        self.sent = self.intact = self.lost = 0

    def transmit(self, packets: Sequence[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
        """Return the packets that arrive, as (frame type, bytes).

        Delayed packets are returned by later calls.
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
                corrupted = self._corrupt(data)
                if data in corrupted:  # a byte inserted after the frame does not corrupt it
                    self.intact += 1
                depth = self._faults.reorder
                if depth and self._source.random() < DELAYED_SHARE:
                    delay = self._source.randint(1, depth)
                else:
                    delay = 0
                heapq.heappush(self._late, (self._number + delay, self._number, name, corrupted))
            while self._late and self._late[0][0] <= self._number:
                arrived.append(heapq.heappop(self._late)[2:])
            self._number += 1
        return arrived

    def _draw_gap(self) -> int:
        """Draw the number of valid bytes before the next corrupt byte."""
        rate = self._faults.errors
        if rate in (0.0, 1.0):
            return 0
        return int(math.log(1 - self._source.random()) / math.log1p(-rate))

    def _corrupt(self, frame: bytes) -> bytes:
        if not self._faults.errors:
            return frame
        out = bytearray()
        start = 0
        while start + self._valid_bytes_left < len(frame):
            offset = start + self._valid_bytes_left
            out += frame[start:offset] + self._corrupt_byte(frame[offset])
            start = offset + 1
            self._valid_bytes_left = self._draw_gap()
        self._valid_bytes_left -= len(frame) - start
        return bytes(out + frame[start:])

    def _corrupt_byte(self, byte: int) -> bytes:
        changed = bytes([byte ^ 1 << self._source.randrange(8)])
        if self._stream:
            return self._source.choice((b"", changed, bytes([byte, self._source.randrange(256)])))
        return changed
