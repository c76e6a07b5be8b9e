"""Describe the contents of a file: its kind, senders, sensors, times and losses.

Only the beginning of a long file is read, and all counts refer to this part. The time of the last
packet is also read if the transport of the file can skip to its end.
"""

from __future__ import annotations

import contextlib
import os
import textwrap
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
from lidarspec.errors import LidarSpecError, UsageError, escape_controls, suggest
from lidarspec.explaining.clock_text import describe_clock
from lidarspec.packets.returns import describe_incomplete_groups
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
from lidarspec.transports.protocol import (
    Chunk,
    Sender,
    Transport,
    format_sender,
    no_bytes_message,
)
from lidarspec.transports.robotics_logs import BagTransport
from lidarspec.view.live_frames import open_live
from lidarspec.view.rate_meter import MeterReading

#: The maximum number of bytes to read from the beginning of a file. The next constant is the
#: maximum number of packets.
MAX_BEGINNING_BYTES = 1 << 26
MAX_BEGINNING_PACKETS = 1 << 18
#: The maximum number of bytes to decode.
MAX_DECODED_BYTES = 1 << 24
#: The maximum number of senders to list.
MAX_LISTED_FLOWS = 6
#: The maximum number of characters in a line of the description.
LINE_WIDTH = 80
#: The minimum number of characters in the column of labels, so that several files have equal
#: columns.
MIN_LABEL_WIDTH = 8
COMMAND_LABEL = "next"
#: A time after all arrivals, ns since 1970.
_END_NS = (1 << 63) - 1
#: The description of a file's kind, by the transport of the file.
KINDS: Mapping[type[Transport], str] = {
    RecordingTransport: "a recording",
    CaptureTransport: "a capture",
    StreamCaptureTransport: "a capture of a byte stream",
    HexTransport: "hexadecimal text",
    BagTransport: "a robotics log",
}


@dataclass
class PacketFlow:
    """The packets from one sender to one receiver.

    Attributes:
        sender: address and port of the sender; None if unknown.
        receiver: address and port of the receiver; None if unknown.
        packets: number of packets in the part that was read.
        bytes: number of bytes in the part that was read.
    """

    sender: Sender | None
    receiver: Sender | None
    packets: int = 0
    bytes: int = 0


@dataclass(frozen=True)
class SensorContent:
    """The data of one sensor in a file.

    Attributes:
        source: the SOURCE that selects this data.
        sensors: the ids of the sensors that match.
        share: the share of the bytes that are in valid frames, from 0 to 1; None if the file names
            the sensor.
        options: command-line options that select the sensor; "" if the file names the sensor.
        reading: statistics of the decoded part, such as scans per second; None if the data cannot
            be decoded.
        incomplete_returns: for a sensor that sends the returns of the same firings in a group of
            packets, the number of groups in the decoded part that lack a packet; otherwise 0.
        info: the facts that the sensor reports about itself in the decoded part, by name.
        clock: a description of the sensor's clock in the decoded part; "" if the sensor sends no
            time.
    """

    source: str
    sensors: tuple[str, ...] = ()
    share: float | None = None
    options: str = ""
    reading: MeterReading | None = None
    incomplete_returns: int = 0
    verb: str = "view"
    info: Mapping[str, str] = field(default_factory=dict)
    clock: str = ""

    @property
    def command(self) -> str:
        """The command that shows the data."""
        return f"lidarspec {self.verb} {quote(self.source)} {self.options}".rstrip()


@dataclass
class FileContents:
    """The contents of a file.

    Attributes:
        kind: a description of the kind of the file.
        size: the size of the file, in bytes.
        header: the header of a recording; None for other files.
        flows: the packets by sender and receiver, most bytes first; a byte stream has one flow.
        first_ns: arrival time of the first packet, ns since 1970; None if unknown.
        last_ns: arrival time of the last packet, ns since 1970; None if unknown.
        last_read_ns: arrival time of the last packet that was read; None if unknown.
        whole: whether the whole file was read; if not, all counts refer to its beginning.
        unread: number of bytes that could not be read, because the file is corrupt.
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
    unread: int = 0
    contents: list[SensorContent] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def packets(self) -> int:
        """The number of packets, or chunks of a stream, in the part that was read."""
        return sum(flow.packets for flow in self.flows)

    @property
    def bytes(self) -> int:
        """The number of bytes of all packets in the part that was read."""
        return sum(flow.bytes for flow in self.flows)

    @property
    def seconds(self) -> float | None:
        """The seconds from the first packet to the last; None if times are unknown."""
        if self.first_ns is None or self.last_ns is None:
            return None
        return (self.last_ns - self.first_ns) * 1e-9

    @property
    def seconds_read(self) -> float | None:
        """The duration of the part that was read, in seconds; None if unknown."""
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
                    "unread",
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
                        end: address and format_sender(address)
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
        contents = FileContents(str(path), kind, _measure_size(Path(file)), header)
        _count_packets(contents, opened)
        contents.warnings += opened.warnings
        contents.unread = opened.unread
    if contents.bytes:
        contents.contents += _find_sensors(contents)
    elif not contents.warnings:
        contents.warnings.append(no_bytes_message(path, ()))
    return contents


def measure_duration(path: str | Path) -> float | None:
    """Return the time from the first to the last packet of a file, in seconds.

    Returns None if times are unknown, or if a long file would have to be read to its end.

    Raises:
        SourceError: if the file cannot be opened.
    """
    with contextlib.closing(open_transport(path)) as opened:
        contents = FileContents(str(path), "", 0)
        _count_packets(contents, opened)
    return contents.seconds


def _measure_size(path: Path) -> int:
    if path.is_dir():
        return sum(part.stat().st_size for part in path.rglob("*"))
    return path.stat().st_size


def _count_packets(contents: FileContents, opened: Transport) -> None:
    """Count packets at the beginning of a file; find the first and last arrival time."""
    flows = dict[tuple[Sender | None, Sender | None], PacketFlow]()
    bytes_left = MAX_BEGINNING_BYTES
    chunks = opened.chunks()
    for index, chunk in enumerate(chunks):
        flow = flows.setdefault(
            (chunk.sender, chunk.receiver), PacketFlow(chunk.sender, chunk.receiver)
        )
        flow.packets += 1
        flow.bytes += len(chunk.data)
        bytes_left -= len(chunk.data)
        if contents.first_ns is None:
            contents.first_ns = chunk.at or None
        contents.last_read_ns = contents.last_ns = chunk.at or contents.last_ns
        if bytes_left <= 0 or index >= MAX_BEGINNING_PACKETS:
            contents.last_ns = _find_last_time(opened, chunks)
            contents.whole = False
            break
    contents.flows = sorted(flows.values(), key=lambda flow: -flow.bytes)


def _find_last_time(opened: Transport, chunks: Iterator[Chunk]) -> int | None:
    """Return the time of the last packet; None if the transport cannot skip to it."""
    last = None
    for chunk in chunks if opened.skip_until(_END_NS) else ():
        last = chunk.at or last
    return last


def _find_sensors(contents: FileContents) -> list[SensorContent]:
    """Find the sensors that sent the packets of a file."""
    try:
        if (declared := find_declared_sensor(contents.path)) is not None:
            measured = _measure(contents.path, declared)
            verb = verb_to_show(declared)
            return [SensorContent(contents.path, (declared.id,), verb=verb, **measured)]
    except LidarSpecError as error:
        contents.warnings.append(str(error))
    verdicts = identify_senders(contents.path)
    has_text = any(verdict.sample.is_text for verdict in verdicts)
    if has_text and not any(verdict.candidates for verdict in verdicts):
        contents.kind = "text"
    return [_make_content(contents.path, verdict) for verdict in verdicts]


def _make_content(path: str, verdict: Verdict) -> SensorContent:
    if verdict.sample.sender and "?" not in path:
        source = f"{path}?src={verdict.sample.sender}"
    else:
        source = path
    if not verdict.candidates:
        return SensorContent(source, tuple(list_candidates(verdict)))
    best = verdict.candidates[0]
    return SensorContent(
        source,
        tuple(list_candidates(verdict)),
        best.share,
        format_sensor_options(best.sensor),
        verb=verb_to_show(best.sensor),
        **_measure(source, best.sensor),
    )


def _measure(source: str, sensor: Sensor) -> dict[str, Any]:
    """Decode the beginning of a file, and return statistics of its data.

    Returns:
        Attributes of `SensorContent`: name -> value; an empty dict if the frames cannot be decoded.
    """
    try:
        with Device(source, sensor) as device:
            live = open_live(device)
            while not live.ended and device.stats.bytes_in < MAX_DECODED_BYTES:
                live.read(0.0)
            clock = ""
            if sensor.clock is not None:
                clock = describe_clock(live.clock.report())
            return {
                "reading": live.meter.summary(device.stats),
                "incomplete_returns": device.stats.incomplete_returns,
                "info": device.info,
                "clock": clock,
            }
    except LidarSpecError:
        return {}


def format_contents(contents: FileContents) -> Iterator[str]:
    """Yield the lines of the description of a file, with a column of labels."""
    rows = _make_rows(contents)
    label_width = max(MIN_LABEL_WIDTH, *(len(label) for label, _ in rows))
    text_width = LINE_WIDTH - len(_format_row("", "", label_width))
    for label, text in rows:
        if label == COMMAND_LABEL:
            folded = [text]
        else:
            folded = textwrap.wrap(text, text_width, break_long_words=False, break_on_hyphens=False)
        for number, line in enumerate(folded or [""]):
            yield _format_row("" if number else label, line, label_width)


def _format_row(label: str, text: str, label_width: int) -> str:
    return f"  {label:<{label_width}}  {text}"


def _make_rows(contents: FileContents) -> Sequence[tuple[str, str]]:
    """Return the description of a file as labels and texts."""
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
    seconds = contents.seconds_read or 0.0
    if seconds:
        rate = f", {contents.packets / seconds:.1f}/s, {contents.bytes / seconds / 1e3:.1f} kB/s"
    else:
        rate = ""
    if any(flow.sender for flow in contents.flows):
        unit = "packets"
    else:
        unit = "chunks"
    lines.append(("holds", f"{contents.packets} {unit}, {contents.bytes} bytes{rate}"))
    for flow in contents.flows[:MAX_LISTED_FLOWS]:
        if flow.sender is not None:
            if flow.receiver is not None:
                to = f" to {format_sender(flow.receiver)}"
            else:
                to = ""
            lines.append(
                (
                    "from",
                    f"{format_sender(flow.sender)}{to}: {flow.packets} packets, {flow.bytes} bytes",
                )
            )
    if further := contents.flows[MAX_LISTED_FLOWS:]:
        lines.append(
            (
                "from",
                f"{len(further)} other senders: {sum(flow.packets for flow in further)} packets",
            )
        )
    if not contents.whole:
        lines.append(
            (
                "part",
                "only the beginning of this long file was counted"
                + "; the time of its end is unknown" * (contents.last_ns is None),
            )
        )
    for content in contents.contents:
        lines.extend(_describe_content(content))
    return lines


def _describe_content(content: SensorContent) -> Iterator[tuple[str, str]]:
    if not content.sensors:
        yield "sensor", f"no installed sensor matches the data of {content.source}"
        return
    if content.share is None:
        sure = "named in the file"
    else:
        sure = f"{content.share:.1%} of the bytes are in valid frames"
    yield "sensor", f"{' or '.join(content.sensors)}: {sure}"
    if (reading := content.reading) is not None:
        if reading.speed_hz is not None:
            yield (
                "scans",
                (
                    f"{reading.speed_hz:.2f} Hz, {reading.points or 0:.0f} points each,"
                    f" of which {reading.valid or 0:.0f} are valid"
                ),
            )
        if reading.loss_rate is None:
            lost = ""
        else:
            lost = f", lost {reading.loss_rate:.3%}"
        rest = f", bytes outside frames {reading.skipped_rate:.3%}" * (content.share is None)
        yield "frames", f"invalid {reading.error_rate:.3%}{lost}{rest}"
    if content.incomplete_returns:
        yield "returns", describe_incomplete_groups(content.incomplete_returns)
    if content.clock:
        yield "clock", escape_controls(content.clock)
    for name, text in content.info.items():
        yield name.replace("_", " "), escape_controls(text)
    yield COMMAND_LABEL, content.command
