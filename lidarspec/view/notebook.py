"""HTML and SVG for notebooks.

Scans and clouds are shown as pictures, packets and explained frames as tables, sensors as packet
diagrams. Texts are escaped, and the size of the output is limited. The output is readable on light
and dark pages: pictures have a background, and tables use the text colour of the page.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, escape_controls
from lidarspec.explaining.explanation import Explanation
from lidarspec.explaining.listing import list_parents
from lidarspec.exports import select_frame
from lidarspec.exports.diagram import svg as diagram
from lidarspec.packets.packets import Packets
from lidarspec.points.appearance import choose_appearance, fit_to_points
from lidarspec.points.cloud import PointCloud
from lidarspec.scans.scan import Scan
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.tree import FieldInfo
from lidarspec.view.svg import svg

#: size of a picture.
PICTURE_PX = 520
#: maximum number of dots of a view.
MAX_DOTS = 12_000
#: number of packets to show at the beginning, and also at the end.
END_ROWS = 5
#: maximum number of fields of packets.
MAX_FIELDS = 24
#: maximum number of rows of an explanation.
MAX_ROWS = 200
#: difference in hue between two consecutive fields.
HUE_STEP_DEG = 67
#: maximum height of a table; a higher table has a scroll bar.
MAX_TABLE_PX = 640
_CELL = "text-align:{align};white-space:nowrap;padding:1px 8px;vertical-align:top"


def scan(value: Scan) -> str:
    """Return a scan as SVG, seen from above, and also from the side if it is not flat."""
    return _make_picture(value.points, f"{value.sensor.id}: {value}")


def cloud(value: PointCloud) -> str | None:
    """Return a cloud as SVG; None for a single point."""
    if np.ndim(value.x):
        return _make_picture(value, str(value))
    return None


def packets(value: Packets) -> str:
    """Return the first and the last packets as an HTML table."""
    fields = {path: info for path, info in value.table.schema.fields.items() if info.const is None}
    shown = dict(list(fields.items())[:MAX_FIELDS])
    columns: dict[str, list[str]] = {
        "offset": [str(offset) for offset in value.offset[_end_indices(len(value))].tolist()]
    }
    columns["time [s]"] = _format_times(value.time_ns)
    if value.host_ns.any():
        columns["arrival [s]"] = _format_times(value.host_ns)
    ends = value.take(_end_indices(len(value)))
    for path, info in shown.items():
        columns[f"{path} [{info.unit}]" if info.unit else path] = _format_field(ends[path], info)
    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    if len(value) > 2 * END_ROWS:
        rows.insert(END_ROWS, ["⋮"] * len(columns))
    more = f"; {len(fields) - len(shown)} further fields" * (len(fields) > len(shown))
    if len(value):
        moment = np.datetime64(int(value.time_ns[0]), "ns")
        first = f"; time of the first packet: {moment} ({_name_clock(value)} clock)"
    else:
        first = ""
    return _make_table(
        f"{value}{first}{more}",
        list(columns),
        [[escape(cell) for cell in row] for row in rows],
        align="right",
    )


def explanation(value: Explanation) -> str:
    """Return every byte of a frame as an HTML table."""
    rows = []
    for number, row in enumerate(value.rows[:MAX_ROWS]):
        indent = "&nbsp;" * 2 * len(list_parents(row.path))
        name = escape(row.path.rpartition(".")[2])
        meaning = escape(escape_controls(row.meaning))
        if row.matches_spec:
            tint = f"hsl({number * HUE_STEP_DEG % 360} 70% 50% / .25)"
        else:
            tint = "hsl(0 90% 50% / .55)"
        data = "<br>".join(
            row.data[start : start + 16].hex(" ") for start in range(0, len(row.data), 16)
        )
        if data:
            code = f'<code style="background:{tint};padding:1px 3px;color:inherit">{data}</code>'
        else:
            code = ""
        meaning = meaning if row.matches_spec else f"<b>{meaning}</b>"
        rows.append(
            [
                f"<code>{row.offset:04x}</code>",
                code,
                f"{indent}{name}",
                f'<span style="white-space:normal">{meaning}</span>',
            ]
        )
    notes = [
        *value.notes,
        *[f"{len(value.rows) - MAX_ROWS} further rows: print(...) shows them"]
        * (len(value.rows) > MAX_ROWS),
    ]
    title = f"{value.sensor} {value.frame or 'skipped'}, {len(value.data)} bytes: {value.verdict}"
    return _make_table("; ".join([title, *notes]), ["offset", "bytes", "field", "meaning"], rows)


def sensor(value: Sensor) -> str:
    """Return the packet diagrams of a sensor as HTML."""
    head = (
        f"<b>{escape(escape_controls(f'{value.vendor} {value.model}'))}</b>"
        f" <code>{escape(value.id)}</code>, verified by {escape(value.status)}"
    )
    source = f'<div style="opacity:.75">{escape(escape_controls(value.source))}</div>'
    return "\n".join(
        [f"<div>{head}{source}</div>", *(_make_diagram(value, name) for name in value.frames)]
    )


def _make_diagram(sensor: Sensor, name: str) -> str:
    frame = sensor.frames[name]
    try:
        drawn = diagram(select_frame(sensor, name))
    except UsageError as refused:
        drawn = f"<div>{escape(str(refused))}</div>"
    title = f'<summary style="cursor:pointer">{escape(name)}</summary>'
    return (
        f'<details{" open" * frame.data}>{title}<div style="overflow:auto">{drawn}</div></details>'
    )


def _make_picture(points: PointCloud, title: str) -> str:
    return svg(
        points,
        fit_to_points(points, choose_appearance(points)),
        title,
        side=PICTURE_PX,
        max_dots=MAX_DOTS,
    )


def _end_indices(count: int) -> NDArray[np.intp]:
    """Return the indices of the rows to show: the first and the last of `count` rows."""
    return np.array(
        [index for index in range(count) if index < END_ROWS or index >= count - END_ROWS], np.intp
    )


def _name_clock(packets: Packets) -> str:
    if packets.sensor.clock is None:
        return "host's"
    return "sensor's"


def _format_times(times: NDArray[np.int64]) -> list[str]:
    """Return the times of the packets to show, as text, in seconds since the first."""
    return [
        f"{(at - int(times[0])) * 1e-9:.6f}" if at else "-"
        for at in times[_end_indices(len(times))].tolist()
    ]


def _format_field(column: NDArray[np.float64], info: FieldInfo) -> list[str]:
    """Return the values of a field, (n, ...), as a text for each packet."""
    if info.kind == "bytes":
        return [f"{row.size} bytes" for row in column]
    return [_format_number(float(row)) if not row.ndim else _format_span(row) for row in column]


def _format_span(values: NDArray[np.float64]) -> str:
    finite = values[np.isfinite(values)]
    if len(finite):
        low = _format_number(float(finite.min()))
        high = _format_number(float(finite.max()))
        return f"{len(finite)} x {low} to {high}"
    return "-"


def _format_number(value: float) -> str:
    if math.isfinite(value):
        return f"{value:.10g}"
    return "-"


def _make_table(
    caption: str, heads: Iterable[str], rows: Iterable[Sequence[str]], *, align: str = "left"
) -> str:
    """Return an HTML table; cells are HTML, the caption and the heads are plain text."""
    cell = _CELL.format(align=align)
    head = "".join(f'<th style="{cell}">{escape(escape_controls(name))}</th>' for name in heads)
    body = "\n".join(
        f"<tr>{''.join(f'<td style={chr(34)}{cell}{chr(34)}>{text}</td>' for text in row)}</tr>"
        for row in rows
    )
    return (
        f'<div style="overflow:auto;max-height:{MAX_TABLE_PX}px;font-size:90%">'
        f'<div style="padding:0 8px 4px">{escape(escape_controls(caption))}</div>'
        "<table"
        f' style="border-collapse:collapse"><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )
