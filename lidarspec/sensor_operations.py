"""The class `Sensor`: a sensor's description, and a method for each main function.

The functions are in the packages `frames`, `framing`, `packets` and `scans`. A method imports its
package on the first call, so that no package is imported to list or configure sensors.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lidarspec.notebook_display import make_display_method
from lidarspec.spec.sensor import SensorDescription

if TYPE_CHECKING:
    from lidarspec.framing.decoder import Decoder
    from lidarspec.framing.results import Found
    from lidarspec.packets.imu import WaitingSamples
    from lidarspec.packets.packets import Packets
    from lidarspec.scans.scan import Scan
    from lidarspec.scans.selection import Selection


@dataclass(frozen=True, eq=False, repr=False, init=False)
class Sensor(SensorDescription):
    """A sensor: a description of its protocol, and methods to parse, build and decode.

    Args:
        id: vendor-model in lower case with hyphens; it never changes.
        vendor, model: names as the vendor writes them.
        frames: all frame types by name, in both directions. If bytes match several types, the first
            in this order is chosen.
        points: a function that takes `Fields` and returns `Polar` or `Cartesian`. None if each data
            frame has its own function (`Frame.points`), or if the sensor has no points. A sensor
            without points has no frame with ``data=True``.
        scan: the rule by which a scan ends and the next one begins; None without points.
        links: the links by name. Data is received on the link "data". Each command names the link
            on which it is sent.
        commands: the commands by name.
        clock: the sensor's clock, if it has one.
        sequence: the packet counter, if it has one.
        fillers: bytes that the sensor sends between frames. They do not count as invalid bytes.
        state: default values of fields of other frames, by frame and field path, in the unit of the
            field. `points` reads these values with ``f.state`` until such a frame arrives.
        simulation: additional facts for a simulated sensor.
        configure: a function of the sensor and its options (keyword arguments) that returns another
            sensor. The annotations of its parameters are the possible values of the options.
        recognise: a function that is needed if the layout of data frames depends on options of
            `configure`. It takes a list of datagrams, and returns the options with which they can
            be decoded, or {} if the datagrams are not from this sensor.
        on_open, on_close: names of the commands that are sent when a device is opened or closed.
        range_limits: the shortest and the longest range in metres that the sensor can measure; None
            without points.
        vendor_axes: the directions of the vendor's x, y and z axes, for ``frame="vendor"``: three
            of forward, back, left, right, up and down.
        beams: number of points of a scan, if it is constant.
        returns: the names of the returns of a firing, by return index, if they are not in the order
            of their distance. A name is "first", "last", "strongest", "second strongest", or
            "varying" if it depends on a setting of the sensor. `Selection` uses these names.
        turn: (lowest, highest) number of scans per second.
        relatives: ids of related models, installed or not, and how each differs from this sensor.
            If single packets show the difference, it is a `Relative`. Otherwise it is a text, and
            the model is recognised by the speed of its clock, or by the name of the model in
            `info`.
        info: fields with information about the device: name -> "frame.path", or a `Reported`. The
            names "serial", "firmware", "model" and "temperature" have a meaning for all sensors.
        status: how the description was verified: "manual", "vectors", "capture" or "hardware".
        source: the manual with its revision and sections, and the captures, from which it was
            written.
        aliases: other ids of the sensor. The aliases that an installed plugin declares as entry
            points are added. Pass aliases only if there are no entry points, such as in a script.
        api: the version of this interface that the description was written for.
        acknowledged: findings of `lidarspec check` about the sensor as a whole that are accepted:
            "LS401" -> the reason.
        options: the options that the sensor was configured with; plugins do not set it.
        hooked: a function that applies the hooks of installed plugins; plugins do not set it.

    Raises:
        SpecError: for an invalid id or status, or if a part refers to another part that does not
            exist.
    """

    _repr_html_ = make_display_method("sensor")

    def parse(
        self, data: bytes, frame: str | None = None, *, verify: bool = True, units: bool = False
    ) -> Any:
        """Parse exactly one frame; return a construct Container of raw integers.

        Args:
            frame: the name of the frame type; by default, the type is identified.
            verify: if False, wrong constants, a wrong checksum and trailing bytes are accepted.
            units: whether to return scaled fields in their units; ``build(units=True)`` accepts the
                result.

        Raises:
            WireError: if the bytes are not a valid frame of the type. The error has the sensor, the
                offset, the field path, and the expected and actual value.
        """
        from lidarspec.frames.parse import parse

        return parse(self, data, frame=frame, verify=verify, units=units)

    def build(
        self, frame: str, value: Any = None, /, *, units: bool = False, **values: Any
    ) -> bytes:
        """Return the bytes of one frame; constants, counts and checksum are filled in.

        Args:
            value: a mapping of fields, such as the result of `parse`.
            values: fields as keyword arguments, which override those in `value`. The name of a
                field in a nested struct is its path: ``**{"flags.valid": 1}``.
            units: whether values are physical; they are rounded to the nearest raw value.

        Raises:
            UsageError: for a missing or unknown field, or a value that a field cannot represent.
        """
        from lidarspec.frames.build import build

        return build(self, frame, value, values, units=units)

    def example(self, frame: str, *, seed: int = 0) -> bytes:
        """Return the bytes of a valid frame with seeded random content.

        Raises:
            UnknownFrame: for a frame type that the sensor does not have.
        """
        from lidarspec.framing.example_frames import example

        return example(self, frame, seed=seed)

    def command(self, name: str, /, **arguments: Any) -> bytes:
        """Return the bytes of a command.

        Args:
            arguments: name -> value, in the unit of its field.

        Raises:
            UnknownCommand: for a command that the sensor does not have.
            OutOfRange: for an argument outside its range.
        """
        from lidarspec.frames.commands import build_command

        return build_command(self, name, arguments)

    def decoder(self, *, stream: bool | None = None, backend: str = "auto") -> Decoder:
        """Return a new decoder for bytes that are received one after another.

        Args:
            stream: True if the bytes are a stream, False if each call of `feed` gets one datagram.
                The default depends on the data link.
            backend: "auto", "numpy" or "jit"; the results are the same.

        Raises:
            UsageError: for an unknown back end, or a sensor that has no frames before it is
                configured.
        """
        from lidarspec.framing.decoder import Decoder, select_backend as checked_backend

        chosen = checked_backend(backend)
        sums = None
        if chosen == "jit":
            from lidarspec.points.numba_kernels import compile_sums

            sums = compile_sums()
        if stream is None:
            stream = not self.datagrams
        return Decoder(self, stream=stream, backend=chosen, sums=sums)

    def split(self, data: Any, *, backend: str = "auto") -> list[Found]:
        """Return every incoming frame of all types, in stream order.

        Invalid bytes do not raise.

        Args:
            data: bytes (a stream), an iterable of datagrams, or an (n, size) uint8 array of
                datagrams.
            backend: "auto", "numpy" or "jit"; the results are the same.

        Raises:
            UsageError: for a text or a path, an unknown back end, or a sensor that has no frames
                before it is configured.
        """
        from lidarspec.framing.decoder import decode_all, is_stream

        decoder = self.decoder(stream=is_stream(data), backend=backend)
        return [found for frames in decode_all(decoder, data) for found in frames.to_found()]

    def decode(self, data: Any, frame: str | None = None, *, backend: str = "auto") -> Packets:
        """Return the data frames, or the frames of another type, as columns.

        Invalid bytes do not raise.

        Args:
            data: bytes (a stream), an iterable of datagrams, or an (n, size) uint8 array of
                datagrams.
            frame: the name of a frame type; by default the data frame. If the sensor has several
                types of data frames, the default is the type that arrives first.
            backend: "auto", "numpy" or "jit"; the results are the same.

        Raises:
            UnknownFrame: for a frame type that the sensor does not have.
            UsageError: for a text or a path, an unknown back end, a sensor that has no frames
                before it is configured, or no `frame` for a sensor without points.
        """
        packets, _ = self._decode(data, frame, backend)
        return packets

    def _decode(
        self, data: Any, frame: str | None, backend: str
    ) -> tuple[Packets, WaitingSamples | None]:
        """Return the packets of a frame type, and the IMU samples or None."""
        from lidarspec.framing.decoder import decode_all, is_stream
        from lidarspec.packets.stream import ImuStream, PacketStream, choose_data_frame

        decoder = self.decoder(stream=is_stream(data), backend=backend)
        frames = decode_all(decoder, data)
        name = frame or choose_data_frame(self, frames) or self.data_frame
        stream = PacketStream(self, name, decoder.stats, backend=decoder.backend)
        packets = stream.add(frames, whole=True)
        if frame is not None or not self.imu_frames:
            return packets, None
        imu = ImuStream(self, decoder.stats, backend=decoder.backend)
        imu.add(frames, packets, whole=True)
        return packets, imu.waiting

    def scans(
        self, data: Any, *, backend: str = "auto", select: Selection | None = None
    ) -> Iterator[Scan]:
        """Return an iterator over the scans; the first and last have ``complete=False``.

        A Python warning is issued if the data has no data frame, or if `points` raises an exception
        for some packets.

        Args:
            data: bytes (a stream), an iterable of datagrams, or an (n, size) uint8 array of
                datagrams.
            backend: "auto", "numpy" or "jit"; the results are the same.
            select: the scans to return, and the part of each scan.

        Raises:
            UsageError: for a text or a path, an unknown back end, a sensor that has no frames
                before it is configured or has no points, or if no scan is selected.
        """
        from lidarspec.scans.selection import ScanSelector
        from lidarspec.scans.stream import iter_scans

        packets, imu = self._decode(data, None, backend)
        if packets.stats.bytes_in and not len(packets):
            warnings.warn(
                f"{self.id}: no {packets.frame} frame in the data ({packets.stats}): does the"
                " data come from another sensor?",
                stacklevel=2,
            )
        scans = iter_scans(self, [packets], imu)
        if select is None:
            return self._iter_and_warn(scans, packets)
        return self._iter_and_warn(ScanSelector(select, "the data").iter_selected(scans), packets)

    def _iter_and_warn(self, scans: Iterator[Any], packets: Packets) -> Iterator[Scan]:
        """Yield the scans. Then warn if the plugin raised errors, or if no scan ended."""
        yield from scans
        if packets.stats.unended:
            warnings.warn(f"{self.id}: {packets.stats.unended}", stacklevel=2)
        failure = packets.stats.failure(self.id)
        if failure is not None:
            warnings.warn(str(failure), stacklevel=2)
