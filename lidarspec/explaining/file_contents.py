"""Describe the contents of a file: kind, senders, sensors, times, and losses.

Only the beginning of a long file is read; then all counts refer to that part. The last time is
determined if that is possible without reading the whole file.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import Any

from lidarspec.detect.identification import (
    Verdict,
    find_declared_sensor,
    format_sensor_options,
    identify_senders,
    list_candidates,
    verb_to_show,
)
from lidarspec.device.device import Device
from lidarspec.errors import LidarSpecError, UsageError, suggest
from lidarspec.recording.format import Header
from lidarspec.scans.selection import format_date
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.files import (
    CaptureTransport,
    HexTransport,
    RecordingTransport,
    StreamCaptureTransport,
)
from lidarspec.transports.open_url import is_live, open_transport
from lidarspec.transports.protocol import Chunk, Sender, Transport, endpoint
from lidarspec.transports.robotics_logs import BagTransport
from lidarspec.view.live_frames import open_live
from lidarspec.view.rate_meter import MeterReading

#: Maximum number of bytes and of packets to read from the beginning of a file, and of bytes of a
#: sensor to decode.
MAX_BEGINNING_BYTES = 1 << 26
PACKETS = 1 << 18
DECODED = 1 << 24
#: Maximum number of senders to list.
FLOWS = 6
#: Later than any arrival, ns since 1970.
_END = (1 << 63) - 1
KINDS: Mapping[type[Transport], str] = {
    RecordingTransport: "a recording",
    CaptureTransport: "a capture",
    StreamCaptureTransport: "a capture of a byte stream",
    HexTransport: "hexadecimal text",
    BagTransport: "a robotics log",
}


@dataclass
class PacketFlow:
    """The packets from one sender to one receiver; an unknown address is None.

    Attributes:
        packets, bytes: number of them in the part that was read.
    """

    sender: Sender | None
    receiver: Sender | None
    packets: int = 0
    bytes: int = 0


@dataclass(frozen=True)
class SensorContent:
    """The data of one sensor in a file.

    Attributes:
        source: the source that opens it.
        sensors: ids of the matching sensors.
        share: share of the bytes that are in its frames, from 0 to 1; None if the file names the
            sensor.
        options: command-line options to read it, "" if the file names the sensor.
        reading: statistics of the part that was decoded.
        verb: the verb of the command line that shows it.
    """

    source: str
    sensors: tuple[str, ...] = ()
    share: float | None = None
    options: str = ""
    reading: MeterReading | None = None
    verb: str = "view"

    @property
    def command(self) -> str:
        """The command that shows it."""
        return f"lidarspec {self.verb} {quote(self.source)} {self.options}".rstrip()


@dataclass
class FileContents:
    """The contents of a file.

    Attributes:
        path, kind, size: of the file: name, kind in words, size in bytes.
        header: the header of a recording.
        flows: senders and receivers, most bytes first; one for a byte stream.
        first_ns, last_ns: arrival of the first and the last packet, ns since 1970; None if unknown.
        last_read_ns: arrival of the last packet that was read.
        whole: whether all of the file was read; otherwise counts are of its beginning.
        contents: the data of each sensor.
        warnings: warnings about the file.
    """

    path: str
    kind: str
    size: int
    header: Header | None = None
    flows: list[PacketFlow] = field(default_factory=list)
    first_ns: int | None = None
    last_ns: int | None = None
    last_read_ns: int | None = None
    whole: bool = True
    contents: list[SensorContent] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def packets(self) -> int:
        """Number of packets, or chunks of a stream, in the part that was read."""
        return sum(flow.packets for flow in self.flows)

    @property
    def bytes(self) -> int:
        """Number of their bytes."""
        return sum(flow.bytes for flow in self.flows)

    @property
    def seconds(self) -> float | None:
        """Seconds from the first packet to the last; None if times are unknown."""
        if self.first_ns is None or self.last_ns is None:
            return None
        return (self.last_ns - self.first_ns) * 1e-9

    @property
    def read_seconds(self) -> float | None:
        """Duration in seconds of the part that was read; None if times are unknown."""
        if self.first_ns is None or self.last_read_ns is None:
            return None
        return (self.last_read_ns - self.first_ns) * 1e-9

    def to_dict(self) -> dict[str, Any]:
        """Return the contents as a dict for JSON."""
        return {
            **{
                name: getattr(self, name)
                for name in (
                    "path",
                    "kind",
                    "size",
                    "whole",
                    "packets",
                    "bytes",
                    "first_ns",
                    "last_ns",
                    "seconds",
                )
            },
            "recorded": (
                None
                if self.header is None
                else {"source": self.header.source, "at": self.header.created}
            ),
            "flows": [
                {
                    **vars(flow),
                    **{
                        end: address and endpoint(address)
                        for end in ("sender", "receiver")
                        if [address := getattr(flow, end)]
                    },
                }
                for flow in self.flows
            ],
            "contents": [
                {
                    **{name: value for name, value in vars(content).items() if name != "verb"},
                    "command": content.command,
                    "reading": content.reading and content.reading.to_dict(),
                }
                for content in self.contents
            ],
            "warnings": self.warnings,
        }


def read_contents(path: str | Path) -> FileContents:
    """Return the contents of a file.

    Raises:
        UsageError: for a live source, and for standard input, which can be read only once.
        SourceError: if the file cannot be opened.
    """
    if str(path) == "-" or is_live(path):
        raise suggest(
            UsageError(f"{path} is not a file"),
            f"lidarspec detect {quote(str(path))}" if str(path) != "-" else "lidarspec info FILE",
        )
    with contextlib.closing(open_transport(path)) as opened:
        kind = KINDS.get(type(opened), "raw bytes")
        if not os.path.exists(path):
            file = str(path).partition("?")[0]
        else:
            file = str(path)
        if isinstance(opened, RecordingTransport):
            header = opened.header
        else:
            header = None
        described = FileContents(str(path), kind, _size(Path(file)), header)
        _count(described, opened)
        described.warnings += opened.warnings
    described.contents += _find_sensors(described) if described.bytes else []
    return described


def measure_duration(path: str | Path) -> float | None:
    """Return the seconds from the first packet of a file to the last.

    Returns None if that would require reading all of a long file.

    Raises:
        SourceError: if the file cannot be opened.
    """
    with contextlib.closing(open_transport(path)) as opened:
        described = FileContents(str(path), "", 0)
        _count(described, opened)
    return described.seconds


def _size(path: Path) -> int:
    if path.is_dir():
        return sum(part.stat().st_size for part in path.rglob("*"))
    return path.stat().st_size


def _count(contents: FileContents, opened: Transport) -> None:
    """Count the beginning of the file, and find the last time."""
    flows = dict[tuple[Sender | None, Sender | None], PacketFlow]()
    left = MAX_BEGINNING_BYTES
    chunks = opened.chunks()
    for number, chunk in enumerate(chunks):
        flow = flows.setdefault(
            (chunk.sender, chunk.receiver), PacketFlow(chunk.sender, chunk.receiver)
        )
        flow.packets, flow.bytes, left = (
            flow.packets + 1,
            flow.bytes + len(chunk.data),
            left - len(chunk.data),
        )
        if contents.first_ns is None:
            contents.first_ns = chunk.at
        else:
            contents.first_ns = contents.first_ns
        contents.last_read_ns = contents.last_ns = chunk.at or contents.last_ns
        if left <= 0 or number >= PACKETS:
            contents.last_ns = _find_last_time(opened, chunks)
            contents.whole = False
            break
    contents.flows = sorted(flows.values(), key=lambda flow: -flow.bytes)


def _find_last_time(opened: Transport, chunks: Iterator[Chunk]) -> int | None:
    """Return the time of the last packet, None if that requires reading everything."""
    last = None
    for chunk in chunks if opened.skip_until(_END) else ():
        last = chunk.at or last
    return last


def _find_sensors(contents: FileContents) -> list[SensorContent]:
    """Return the data of each sensor."""
    try:
        if (declared := find_declared_sensor(contents.path)) is not None:
            reading = _reading(contents.path, declared)
            verb = verb_to_show(declared)
            return [SensorContent(contents.path, (declared.id,), None, "", reading, verb)]
    except LidarSpecError as error:
        contents.warnings.append(str(error))
    judged = identify_senders(contents.path)
    if any(one.sample.is_text for one in judged) and not any(one.candidates for one in judged):
        contents.kind = "text"
    return [_content(contents.path, one) for one in judged]


def _content(path: str, one: Verdict) -> SensorContent:
    if one.sample.sender and "?" not in path:
        source = f"{path}?src={one.sample.sender}"
    else:
        source = path
    if not one.candidates:
        return SensorContent(source, tuple(list_candidates(one)))
    best = one.candidates[0]
    return SensorContent(
        source,
        tuple(list_candidates(one)),
        best.share,
        format_sensor_options(best.sensor),
        _reading(source, best.sensor),
        verb_to_show(best.sensor),
    )


def _reading(source: str, sensor: Sensor) -> MeterReading | None:
    """Return the statistics of a sensor at the beginning of a file.

    Returns None if its frames cannot be read.
    """
    try:
        with Device(source, sensor) as device:
            feed = open_live(device)
            while not feed.ended and device.stats.bytes_in < DECODED:
                feed.read(0.0)
            return feed.meter.summary(device.stats)
    except LidarSpecError:
        return None


def format_contents(contents: FileContents) -> Sequence[tuple[str, str]]:
    """Return the description of a file as lines of (word, text)."""
    lines = list[tuple[str, str]]()
    if (header := contents.header) is not None:
        lines.append(("recorded", f"{header.created} from {header.source or 'an unknown source'}"))
    if contents.first_ns is not None:
        if contents.last_ns is not None:
            until = f" to {format_date(contents.last_ns)}, {contents.seconds:.3f} s"
        else:
            until = ""
        lines.append(("time", f"{format_date(contents.first_ns)}{until}"))
    else:
        lines.append(("time", "no arrival times"))
    seconds = contents.read_seconds or 0.0
    if seconds:
        rate = f", {contents.packets / seconds:.1f}/s, {contents.bytes / seconds / 1e3:.1f} kB/s"
    else:
        rate = ""
    if any(flow.sender for flow in contents.flows):
        unit = "packets"
    else:
        unit = "pieces"
    lines.append(("holds", f"{contents.packets} {unit}, {contents.bytes} bytes{rate}"))
    for flow in contents.flows[:FLOWS]:
        if flow.sender is not None:
            if flow.receiver is not None:
                to = f" to {endpoint(flow.receiver)}"
            else:
                to = ""
            lines.append(
                ("from", f"{endpoint(flow.sender)}{to}: {flow.packets} packets, {flow.bytes} bytes")
            )
    if further := contents.flows[FLOWS:]:
        lines.append(
            ("from", f"{len(further)} others: {sum(flow.packets for flow in further)} packets")
        )
    if not contents.whole:
        lines.append(
            (
                "part",
                "the file is long: only its beginning is counted"
                + ", and its end is unknown" * (contents.last_ns is None),
            )
        )
    for content in contents.contents:
        lines.extend(_describe_content(content))
    return lines


def _describe_content(content: SensorContent) -> Iterator[tuple[str, str]]:
    if not content.sensors:
        yield "sensor", f"not identified among the installed ones ({content.source})"
        return
    if content.share is None:
        sure = "named in the file"
    else:
        sure = f"{content.share:.1%} of the bytes are in its frames"
    yield "sensor", f"{' or '.join(content.sensors)}: {sure}"
    if (reading := content.reading) is not None:
        if reading.speed_hz is not None:
            yield (
                "scans",
                (
                    f"{reading.speed_hz:.2f} Hz, {reading.points or 0:.0f} points each,"
                    f" {reading.valid or 0:.0f} of them valid"
                ),
            )
        if reading.loss_rate is None:
            lost = ""
        else:
            lost = f", lost {reading.loss_rate:.3%}"
        rest = f", bytes outside frames {reading.skipped_rate:.3%}" * (content.share is None)
        yield "frames", f"invalid {reading.error_rate:.3%}{lost}{rest}"
    yield "next", content.command
