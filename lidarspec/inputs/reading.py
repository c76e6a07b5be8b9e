"""Packets and scans out of what arrives, with what one batch has to know of the one before."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping

from lidarspec.decoder import Decoder, Spans
from lidarspec.inputs.arrivals import Arrival
from lidarspec.packets import Packets
from lidarspec.scans import Scan, ScanStream, handed_out
from lidarspec.spec import Sensor
from lidarspec.streams import PacketStream, data_frame

#: batches kept while nobody knows yet which data frame the sensor answers in.
UNDECIDED = 256


class PacketReader:
    """The packets of one type out of what arrives.

    Args:
        frame: the type; where the sensor has several data frames and none is named, the first that arrives decides.
        decoder: where the frames come from.
        state: frames of other types, by name, that count as seen before the first packet.

    Attributes:
        last: the packets of the last arrival.
    """

    def __init__(self, sensor: Sensor, frame: str | None, decoder: Decoder, state: Mapping[str, bytes]) -> None:
        self._sensor, self._decoder, self._state = sensor, decoder, state
        self._waiting: deque[Spans] = deque(maxlen=UNDECIDED)
        self._stream = self._made(frame) if frame is not None else None
        self.last: Packets | None = None

    def add(self, arrival: Arrival) -> Packets | None:
        """The packets among these frames; None while nobody knows of which type."""
        self._waiting += arrival.found
        found = list(self._waiting)
        if self._stream is None:
            name = data_frame(self._sensor, found)
            self._stream = self._made(name) if name is not None else None
        if self._stream is None:
            return None
        self._waiting.clear()
        self.last = self._stream.add(found)
        if arrival.interrupted:
            self._stream.interrupt()
        return self.last

    def none(self) -> Packets:
        """A batch of no packets."""
        return (self._stream or self._made(self._sensor.data_frame)).add([])

    def scans(self, stream: ScanStream, arrival: Arrival, *, read: bool = False) -> Iterator[Scan]:
        """The scans that an arrival completes; an interruption ends the one under way, and the stream with it.

        Args:
            read: it is the last one, of which packets were made before.
        """
        packets = self.last if read else self.add(arrival)
        if packets is not None and len(packets):
            yield from handed_out(stream.add(packets))
        if arrival.interrupted:
            yield from stream.finish()

    def _made(self, name: str) -> PacketStream:
        decoder = self._decoder
        return PacketStream(self._sensor, name, decoder.stats, interpreted=decoder.interpreted, backend=decoder.backend, state=self._state)
