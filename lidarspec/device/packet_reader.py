"""Make packets of one type, and scans, from arriving frames.

A `PacketReader` keeps the state that a batch of packets needs from the batches before it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

from lidarspec.device.device_input import Arrival
from lidarspec.device.first_frames import FirstFrames
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Frames
from lidarspec.packets.imu import WaitingSamples, join_samples
from lidarspec.packets.packets import Packets
from lidarspec.packets.stream import ImuStream, PacketStream, data_frame
from lidarspec.scans.scan import Scan
from lidarspec.scans.stream import ScanStream, release_yielded
from lidarspec.sensor_operations import Sensor

#: Batches that are kept until the type of the data frames is known.
_MAX_UNDECIDED_BATCHES = 256
#: IMU samples that are kept for a scan that does not end.
_MAX_WAITING_IMU_SAMPLES = 1 << 16


class PacketReader:
    """Packets of one frame type, and the samples of the IMU.

    Args:
        frame: the frame type; by default the data frame, and for a sensor with several of them the
            one that arrives first.
        decoder: the decoder that finds the frames.
        first: the frames that count as seen before the first packet.

    Attributes:
        last: the packets of the last arrival.
        imu_samples: the IMU samples of the last arrival.
    """

    def __init__(
        self, sensor: Sensor, frame: str | None, decoder: Decoder, first: FirstFrames
    ) -> None:
        self._sensor = sensor
        self._decoder = decoder
        self._first = first
        self._frame = frame
        self._undecided: deque[Frames] = deque(maxlen=_MAX_UNDECIDED_BATCHES)
        if frame is None:
            self._stream = None
        else:
            self._stream = self._make_stream(frame)
        self._imu = self._make_imu_stream()
        self.last: Packets | None = None
        self.imu_samples = join_samples([])

    @property
    def waiting_imu(self) -> WaitingSamples | None:
        """The IMU samples that wait for the end of their scan, if scans have any."""
        if self._imu is not None:
            return self._imu.waiting
        return None

    def add(self, arrival: Arrival) -> Packets | None:
        """Return the packets among the frames of an arrival; None while their type is unknown."""
        if arrival.replaced:
            self._undecided.clear()
            if self._frame is None:
                self._stream = None
            else:
                self._stream = self._make_stream(self._frame)
        self._undecided += arrival.found
        frames = list(self._undecided)
        if self._stream is None:
            name = data_frame(self._sensor, frames)
            if name is None:
                return None
            self._stream = self._make_stream(name)
        self._undecided.clear()
        self.last = self._stream.add(frames)
        if arrival.interrupted:
            self._stream.interrupt()
        return self.last

    def add_imu(self, arrival: Arrival, packets: Packets | None) -> None:
        """Read the IMU samples of an arrival and of its packets, which may have samples too."""
        if self._imu is None:
            return
        if arrival.replaced:
            waiting = self._imu.waiting
            self._imu = self._make_imu_stream()
            assert self._imu is not None
            self._imu.waiting = waiting
        self.imu_samples = self._imu.add(arrival.found, packets)
        if self._imu.waiting is not None:
            self._imu.waiting.keep_newest(_MAX_WAITING_IMU_SAMPLES)
        if arrival.interrupted:
            self._imu.interrupt()

    def find_scans(
        self, stream: ScanStream, arrival: Arrival, *, is_added: bool = False
    ) -> Iterator[Scan]:
        """Yield the scans that an arrival completes; an interruption ends the last one.

        Args:
            is_added: the arrival is the one that was added last.
        """
        packets = self.last
        if not is_added:
            packets = self.add(arrival)
            self.add_imu(arrival, packets)
        if packets is not None and len(packets):
            yield from release_yielded(stream.add(packets))
        if arrival.interrupted:
            yield from stream.finish()

    def make_empty_batch(self) -> Packets:
        """Return a batch without packets."""
        stream = self._stream or self._make_stream(self._sensor.data_frame)
        return stream.add([])

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the last packets: an unpickled reader continues with the next ones."""
        return {**vars(self), "last": None, "imu_samples": join_samples([])}

    def _make_stream(self, frame: str) -> PacketStream:
        return PacketStream(
            self._sensor,
            frame,
            self._decoder.stats,
            backend=self._decoder.backend,
            state=self._first.state,
            reference=self._first.reference,
        )

    def _make_imu_stream(self) -> ImuStream | None:
        if not self._sensor.imu_frames:
            return None
        return ImuStream(
            self._sensor,
            self._decoder.stats,
            backend=self._decoder.backend,
            state=self._first.state,
        )
