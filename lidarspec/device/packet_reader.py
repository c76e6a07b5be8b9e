"""Make packets of one type, and scans, from batches of frames.

One `PacketReader` receives all batches of a source in order, because decoding a packet may require
state from earlier packets.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

from lidarspec.device.device_input import FrameBatch
from lidarspec.device.first_frames import FirstFrames
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Frames
from lidarspec.packets.imu import WaitingSamples, join_samples
from lidarspec.packets.packets import Packets
from lidarspec.packets.stream import ImuStream, PacketStream, choose_data_frame
from lidarspec.scans.scan import Scan
from lidarspec.scans.stream import ScanStream, pop_scans
from lidarspec.sensor_operations import Sensor

#: Maximum number of `Frames`, each from a piece of input, that are kept until the type of the data
#: frames is known.
_MAX_UNDECIDED_PIECES = 256
#: Maximum number of IMU samples that are kept until a scan ends.
_MAX_WAITING_IMU_SAMPLES = 1 << 16


class PacketReader:
    """Makes packets of one frame type, and IMU samples, from batches of frames.

    Args:
        frame: the frame type; None for the data frame type that arrives first.

    Attributes:
        last_packets: the packets that `read_packets` returned last; None before
            the first packets.
        imu_samples: the IMU samples of the last batch.
    """

    def __init__(
        self, sensor: Sensor, frame: str | None, decoder: Decoder, first: FirstFrames
    ) -> None:
        self._sensor = sensor
        self._decoder = decoder
        self._first = first
        self._frame = frame
        self._undecided: deque[Frames] = deque(maxlen=_MAX_UNDECIDED_PIECES)
        self._stream = self._make_first_stream()
        self._imu = self._make_imu_stream()
        self.last_packets: Packets | None = None
        self.imu_samples = join_samples([])

    @property
    def waiting_imu(self) -> WaitingSamples | None:
        """The IMU samples of scans that have not ended; None if scans have no IMU samples."""
        if self._imu is not None:
            return self._imu.waiting
        return None

    def read_packets(self, batch: FrameBatch) -> Packets | None:
        """Return the packets in the next batch; None if their type is not known yet."""
        if batch.replaced:  # another sensor is read from now on
            self._undecided.clear()
            self._stream = self._make_first_stream()
        frames = batch.frames
        if self._stream is None:
            self._undecided += batch.frames
            frames = list(self._undecided)
            name = choose_data_frame(self._sensor, frames)
            if name is None:
                if not self._sensor.has_points:
                    self._undecided.clear()  # the sensor has no data frames
                return None
            self._stream = self._make_stream(name)
            self._undecided.clear()
        self.last_packets = self._stream.add(frames)
        if batch.interrupted:
            self._stream.interrupt()
        return self.last_packets

    def read_imu(self, batch: FrameBatch, packets: Packets | None) -> None:
        """Read the IMU samples of a batch, and store them in `imu_samples`."""
        if self._imu is None:
            return
        if batch.replaced:
            # The `ScanStream` has this buffer. The last scan of the replaced sensor takes the
            # samples.
            waiting = self._imu.waiting
            self._imu = self._make_imu_stream()
            assert self._imu is not None
            self._imu.waiting = waiting
        self.imu_samples = self._imu.add(batch.frames, packets)
        if self._imu.waiting is not None:
            self._imu.waiting.keep_newest(_MAX_WAITING_IMU_SAMPLES)
        if batch.interrupted:
            self._imu.interrupt()

    def find_scans(
        self, stream: ScanStream, batch: FrameBatch, *, is_read: bool = False
    ) -> Iterator[Scan]:
        """Yield the scans that a batch completes; an interruption ends the last scan.

        Args:
            is_read: whether `read_packets` was already called with `batch`.
        """
        packets = self.last_packets
        if not is_read:
            packets = self.read_packets(batch)
            self.read_imu(batch, packets)
        if packets is not None and len(packets):
            yield from pop_scans(stream.add(packets))
        if batch.interrupted:
            yield from stream.finish()

    def make_empty_batch(self) -> Packets:
        """Return a batch without packets."""
        stream = self._stream or self._make_stream(self._sensor.data_frame)
        return stream.add([])

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a bookmark; see `FileScans`."""
        return {**vars(self), "last_packets": None, "imu_samples": join_samples([])}

    def _make_first_stream(self) -> PacketStream | None:
        """Return the stream of the chosen frame type; None if the type is not known yet."""
        if self._frame is None:
            return None
        return self._make_stream(self._frame)

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
