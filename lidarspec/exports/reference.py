"""Export a spec as the sensor's reference page, in Markdown.

The page has commands to copy, notes, links, the sensor's commands, a table of the fields of each
frame, checksums, the clock and geometry. The notes come from the plugin; all other sections are
made from the spec.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from xml.sax.saxutils import escape

import numpy as np

from lidarspec.errors import LidarSpecError
from lidarspec.explaining.formatting import (
    describe_argument,
    describe_declared_clock,
    describe_declared_status,
    describe_losses,
)
from lidarspec.exports.quick_start import list_commands, read_notes, write_python
from lidarspec.frames.wire_table import frame_size, wire_table
from lidarspec.framing.results import Counters, Found, pack_found
from lidarspec.packets.stream import PacketStream
from lidarspec.points.cloud import PointCloud
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.spec import Command, Frame, Sensor
from lidarspec.spec.links import Http, Link, Serial, Tcp, Udp
from lidarspec.spec.timing import Every, OnFlag, Split

#: The description of each status of a sensor.
STATUSES = {
    "manual": "written from the manual",
    "vectors": "agrees with published example frames",
    "capture": "agrees with captures of the device",
    "hardware": "tested with the device",
}
#: A description of the end of a scan for each class of scan rules.
RULES = {
    "OnWrap": "where `{name}` passes {at:g}",
    "OnFlag": "before every packet in which `{name}` is set",
    "OnChange": "before every packet in which `{name}` changes",
    "OnJump": "before every packet in which `{name}` jumps by more than {by:g}",
    "OnRewind": "before every packet in which `{name}` decreases",
}
#: The maximum number of channels to list.
MAX_LISTED_CHANNELS = 128


def make_page(sensor: Sensor, pictures: Mapping[str, str] | None = None) -> str:
    """Return the reference page of a sensor as Markdown.

    Args:
        pictures: the address of the packet diagram, by frame type.
    """
    parts = [f"# {escape(f'{sensor.vendor} {sensor.model}')}", _write_quick_start(sensor)]
    for name, picture in (pictures or {}).items():
        parts.append(f"![{name}: packet diagram]({picture})")
    parts += [read_notes(sensor.id), "## Facts", "\n".join(_iter_facts(sensor))]
    if sensor.commands:
        parts += ["## Commands", "\n".join(_iter_commands(sensor))]
    for name, frame in sensor.frames.items():
        parts += [*_iter_frame_section(name, frame)]
    parts += ["## Geometry", "\n".join(_iter_geometry(sensor))]
    return "\n\n".join(part for part in parts if part) + "\n"


def _iter_facts(sensor: Sensor) -> Iterator[str]:
    rows = [("id", ", ".join(f"`{name}`" for name in (sensor.id, *sensor.aliases)))]
    rows += [(f"link `{name}`", _describe_link(link)) for name, link in sensor.links.items()]
    if sensor.range_limits is not None:
        rows.append(("range", "{:g} m to {:g} m".format(*sensor.range_limits)))
    if sensor.scan is not None:
        rows.append(("scan", f"ends {_describe_scan_rule(sensor.scan)}"))
    if sensor.clock is not None:
        rows += [("clock", describe_declared_clock(sensor.clock))]
        if sensor.clock.status is not None:
            rows.append(("clock status", describe_declared_status(sensor.clock)))
    rows += [("losses", describe_losses(sensor))]
    rows += [("fillers", f"`{sensor.fillers.hex(' ')}` between frames")] if sensor.fillers else []
    rows += [
        ("verified", f"{sensor.status}: {STATUSES[sensor.status]}"),
        ("source", escape(sensor.source)),
    ]
    return _iter_table(["", ""], rows)


def _describe_link(link: Link) -> str:
    if isinstance(link, Serial):
        bauds = " or ".join(f"{baud:,}".replace(",", " ") for baud in link.bauds)
        return ", ".join(
            [f"serial, {bauds} baud, 8N1", *_list_levels({"dtr": link.dtr, "rts": link.rts})]
        )
    if isinstance(link, Udp):
        ports = [f"port {' and '.join(str(port) for port in link.ports)}"] * bool(link.ports)
        details = [f"broadcast to port {link.broadcast}"] * bool(link.broadcast) + [
            f"from port {link.local}"
        ] * bool(link.local)
        return ", ".join(
            ["UDP", *ports, *details, *["datagrams that carry a byte stream"] * link.stream]
        )
    kind = type(link).__name__
    if isinstance(link, Tcp) and link.reported:
        return f"TCP, port {link.reported}, which the sensor reports"
    if isinstance(link, Tcp | Http):
        return f"{kind.upper()}, port {link.port}"
    return kind


def _list_levels(lines: Mapping[str, bool | None]) -> list[str]:
    """Return the names of the control lines with their levels."""
    return [
        f"{name.upper()} {'high' if level else 'low'}"
        for name, level in lines.items()
        if level is not None
    ]


def _describe_scan_rule(scan: Split) -> str:
    if isinstance(scan, Every):
        return f"every {scan.seconds:g} s"
    if isinstance(scan, OnFlag) and scan.value is not None:
        return f"before every packet in which `{scan.name}` is {scan.value:g}"
    return RULES[type(scan).__name__].format(**vars(scan))


def _iter_commands(sensor: Sensor) -> Iterator[str]:
    rows = [
        (
            f"`{name}`",
            _find_request(sensor, name),
            _describe_reply(command),
            describe_effect(sensor, name),
        )
        for name, command in sensor.commands.items()
    ]
    return _iter_table(["command", "bytes or arguments", "reply", ""], rows)


def _find_request(sensor: Sensor, name: str) -> str:
    command = sensor.commands[name]
    parts = _list_levels(command.lines)
    if command.frame and command.args:
        args = " and ".join(
            f"`{argument}` {describe_argument(sensor, name, argument, ' to ')}"
            for argument in command.arguments
        )
        parts.insert(0, f"`{command.frame}` with {args}")
    elif command.frame:
        parts.insert(0, f"`{sensor.command(name).hex(' ')}`")
    return ", ".join(parts)


def _describe_reply(command: Command) -> str:
    if command.replies:
        return " or ".join(f"`{name}`" for name in command.replies)
    return "none documented"


def describe_effect(sensor: Sensor, name: str) -> str:
    """Describe the effect of a command, and when it is sent."""
    command = sensor.commands[name]
    effects = {
        "starts the data": command.starts,
        "stops the data": command.stops,
        "accepted only while the sensor sends no data": command.only_stopped,
        f"followed by a pause of {command.settle:g} s": command.settle > 0,
        f"sent again every {command.every:g} s": command.every > 0,
        "sent when the device is opened": name in sensor.on_open,
        "sent when the device is closed": name in sensor.on_close,
        f"sent over the link `{command.link}`": command.link != "data",
    }
    return "; ".join(text for text, holds in effects.items() if holds)


def _write_quick_start(sensor: Sensor) -> str:
    """Return the section with commands to copy and a Python program."""
    commands = list_commands(sensor)
    width = max(len(command) for command, _ in commands)
    lines = [f"$ {command.ljust(width)}    # {purpose}" for command, purpose in commands]
    return "\n".join(["```console", *lines, "```", "", "```python", write_python(sensor), "```"])


def _iter_frame_section(name: str, frame: Frame) -> Iterator[str]:
    if frame.direction == "out":
        kind = "to the sensor"
    elif frame.data:
        kind = "points"
    else:
        kind = "from the sensor"
    yield f"## `{name}`: {kind}"
    size = frame_size(frame)
    remarks = [f"{size} bytes" if size.isdigit() else f"`{size}` bytes, at most {frame.max_length}"]
    remarks += [f"expected after a `{frame.after}` frame"] * (frame.after is not None)
    if frame.confirm > 1:
        remarks.append(f"accepted after {frame.confirm} consecutive valid frames of this type")
    remarks += ["checked for plausible values"] * (frame.plausible is not None)
    yield "; ".join(remarks) + "."
    rows = [
        (row.offset, row.size, row.type, f"`{row.field}`", row.unit, row.meaning)
        for row in wire_table(frame)
    ]
    # Brackets of an index must not become a link.
    escaped_rows = [
        [cell if "`" in cell else cell.replace("[", r"\[") for cell in row] for row in rows
    ]
    yield "\n".join(
        _iter_table(["offset", "size", "type", "field", "unit", "meaning"], escaped_rows)
    )


def _iter_geometry(sensor: Sensor) -> Iterator[str]:
    """Yield the section about the points of each data frame: axes and directions."""
    yield (
        "Points are in metres, x forward, y left, z up; the manual's zero direction is +x, and"
        " azimuth counts counter-clockwise."
    )
    if sensor.vendor_axes:
        x, y, z = sensor.vendor_axes
        yield f"`configure(frame='vendor')` selects the vendor's axes: x {x}, y {y}, z {z}."
    if sensor.returns:
        numbered = [f"{number}: {name}" for number, name in enumerate(sensor.returns)]
        yield f"Returns of a firing, by `return_index`: {', '.join(numbered)}."
    for name, frame in sensor.frames.items():
        cloud = _decode_example(sensor, name) if frame.data else None
        if cloud is None:
            continue
        more = [
            column
            for column in ("intensity", "ring", "return_index", "column")
            if getattr(cloud, column) is not None
        ]
        more += [
            f"`{column}` ({', '.join(filter(None, (cloud.units[column], values.dtype.name)))})"
            for column, values in cloud.extra.items()
        ]
        if len(cloud) == 1:
            many = "one point"
        elif frame_size(frame).isdigit():
            many = f"{len(cloud)} points"
        else:
            many = "as many points as its header states"
        yield ""
        yield f"A `{name}` frame has {many}" + (
            f", with {', '.join(more[:-1])}{' and ' * (len(more) > 1)}{more[-1]}." if more else "."
        )
        rows = _list_channels(cloud)
        if rows:
            yield (
                ""
                if not cloud.nominal
                else (
                    "\nThese directions are nominal. A calibration file contains the actual"
                    " directions of a device."
                )
            )
            yield from _iter_table(["channel", "elevation"], rows)


def _decode_example(sensor: Sensor, name: str) -> PointCloud | None:
    """Return the points of an example frame; None if it has no points."""
    try:
        frames = pack_found([Found(name, 0, sensor.example(name))])
        packets = PacketStream(sensor, name, Counters()).add([frames]).with_points
        return evaluate_plainly(packets).cloud
    except LidarSpecError:
        return None


def _list_channels(cloud: PointCloud) -> Sequence[tuple[str, str]]:
    """Return the number and the elevation of each channel as texts."""
    if cloud.ring is None:
        return []
    rows = []
    for ring in np.unique(cloud.ring).tolist():
        angles = np.rad2deg(cloud.elevation[cloud.ring == ring])
        if not len(angles) or not np.isfinite(angles).all() or np.ptp(angles) > 1e-3:
            return []
        rows.append((str(ring), f"{angles[0] + 0.0:.3f} deg"))
    if 1 < len(rows) <= MAX_LISTED_CHANNELS:
        return rows
    return []


def _iter_table(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(headers)} |"
    yield f"|{'---|' * len(headers)}"
    for row in rows:
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |"
