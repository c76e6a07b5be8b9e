"""HTML and SVG for notebooks.

Scans and clouds are pictures, packets and explained frames tables, sensors packet diagrams.
`lidarspec.notebook_display` calls the functions here by the kind of value. Their output is limited
in size, escaped, and readable on light and dark pages: pictures have their own background, tables
use the text colour of the page.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, printable
from lidarspec.explaining.explanation import Explanation
from lidarspec.explaining.listing import parents
from lidarspec.exports import select_frame
from lidarspec.exports.diagram import svg as diagram
from lidarspec.packets.packets import Packets
from lidarspec.points.appearance import choose_appearance, fit_to_points
from lidarspec.points.cloud import PointCloud
from lidarspec.scans.scan import Scan
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.tree import FieldInfo
from lidarspec.view.svg import svg

#: size of a picture in pixels, and the maximum number of dots of a view.
SIDE = 520
DOTS = 12_000
#: rows of packets at the beginning and at the end, maximum number of fields, and of rows of an
#: explanation.
ENDS = 5
FIELDS = 24
ROWS = 200
#: degrees of hue between fields, and the height in pixels above which a table scrolls.
HUE = 67
TALL = 640
_CELL = "text-align:{align};white-space:nowrap;padding:1px 8px;vertical-align:top"


def scan(value: Scan) -> str:
    """Return a scan from above, and from the side unless it is flat, as SVG."""
    return _picture(value.points, f"{value.sensor.id}: {value}")


def cloud(value: PointCloud) -> str | None:
    """Return a cloud as SVG, None for a single point."""
    if np.ndim(value.x):
        return _picture(value, str(value))
    return None


def packets(value: Packets) -> str:
    """Return the first and the last packets as an HTML table.

    It has offset, times and fields in their units; for arrays, number and span.
    """
    fields = {path: info for path, info in value.table.schema.fields.items() if info.const is None}
    shown = dict(list(fields.items())[:FIELDS])
    columns: dict[str, list[str]] = {
        "offset": [str(place) for place in value.offset[_ends(len(value))].tolist()]
    }
    columns["time [s]"] = _since(value.time_ns)
    if value.host_ns.any():
        columns["arrival [s]"] = _since(value.host_ns)
    ends = value.take(_ends(len(value)))
    for path, info in shown.items():
        columns[f"{path} [{info.unit}]" if info.unit else path] = _values(ends[path], info)
    rows = [list(row) for row in zip(*columns.values(), strict=True)]
    if len(value) > 2 * ENDS:
        rows.insert(ENDS, ["⋮"] * len(columns))
    more = f"; {len(fields) - len(shown)} further fields" * (len(fields) > len(shown))
    if len(value):
        first = (
            f"; first at {np.datetime64(int(value.time_ns[0]), 'ns')} by the {_clock(value)} clock"
        )
    else:
        first = ""
    return _table(
        f"{value}{first}{more}",
        list(columns),
        [[escape(cell) for cell in row] for row in rows],
        align="right",
    )


def explanation(value: Explanation) -> str:
    """Return every byte of a frame as an HTML table, with a colour for each field.

    Invalid values are red.
    """
    rows = []
    for number, row in enumerate(value.rows[:ROWS]):
        indent = "&nbsp;" * 2 * len(parents(row.path))
        name = escape(row.path.rpartition(".")[2])
        meaning = escape(printable(row.meaning))
        if row.right:
            tint = f"hsl({number * HUE % 360} 70% 50% / .25)"
        else:
            tint = "hsl(0 90% 50% / .55)"
        data = "<br>".join(
            row.data[start : start + 16].hex(" ") for start in range(0, len(row.data), 16)
        )
        if data:
            code = f'<code style="background:{tint};padding:1px 3px;color:inherit">{data}</code>'
        else:
            code = ""
        meaning = meaning if row.right else f"<b>{meaning}</b>"
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
        *[f"{len(value.rows) - ROWS} further rows: print(...) shows them"]
        * (len(value.rows) > ROWS),
    ]
    title = f"{value.sensor} {value.frame or 'skipped'}, {len(value.data)} bytes: {value.verdict}"
    return _table("; ".join([title, *notes]), ["offset", "bytes", "field", "meaning"], rows)


def sensor(value: Sensor) -> str:
    """Return the packet diagrams of a sensor as HTML; only those of data are open."""
    head = (
        f"<b>{escape(printable(f'{value.vendor} {value.model}'))}</b>"
        f" <code>{escape(value.id)}</code>, verified by {escape(value.status)}"
    )
    source = f'<div style="opacity:.75">{escape(printable(value.source))}</div>'
    return "\n".join(
        [f"<div>{head}{source}</div>", *(_diagram(value, name) for name in value.frames)]
    )


def _diagram(sensor: Sensor, name: str) -> str:
    frame = sensor.frames[name]
    try:
        drawn = diagram(select_frame(sensor, name))
    except UsageError as refused:
        drawn = f"<div>{escape(str(refused))}</div>"
    title = f'<summary style="cursor:pointer">{escape(name)}</summary>'
    return (
        f'<details{" open" * frame.data}>{title}<div style="overflow:auto">{drawn}</div></details>'
    )


def _picture(points: PointCloud, title: str) -> str:
    return svg(
        points, fit_to_points(points, choose_appearance(points)), title, side=SIDE, most=DOTS
    )


def _ends(number: int) -> NDArray[np.intp]:
    """Return the indices of the first and the last rows."""
    return np.array(
        [index for index in range(number) if index < ENDS or index >= number - ENDS], np.intp
    )


def _clock(packets: Packets) -> str:
    if packets.sensor.clock is None:
        return "host's"
    return "sensor's"


def _since(times: NDArray[np.int64]) -> list[str]:
    """Return times of the first and the last packets, in seconds since the first.

    An unknown time is "-".
    """
    return [
        f"{(at - int(times[0])) * 1e-9:.6f}" if at else "-"
        for at in times[_ends(len(times))].tolist()
    ]


def _values(column: NDArray[np.float64], info: FieldInfo) -> list[str]:
    """Return a field of some packets, (n, ...), as text."""
    if info.kind == "bytes":
        return [f"{row.size} bytes" for row in column]
    return [_number(float(row)) if not row.ndim else _span(row) for row in column]


def _span(values: NDArray[np.float64]) -> str:
    finite = values[np.isfinite(values)]
    if len(finite):
        return f"{len(finite)} x {_number(float(finite.min()))} to {_number(float(finite.max()))}"
    return "-"


def _number(value: float) -> str:
    if math.isfinite(value):
        return f"{value:.10g}"
    return "-"


def _table(
    caption: str, heads: Iterable[str], rows: Iterable[Sequence[str]], *, align: str = "left"
) -> str:
    """Return an HTML table; cells are HTML, caption and heads are text."""
    cell = _CELL.format(align=align)
    head = "".join(f'<th style="{cell}">{escape(printable(name))}</th>' for name in heads)
    body = "\n".join(
        f"<tr>{''.join(f'<td style={chr(34)}{cell}{chr(34)}>{text}</td>' for text in row)}</tr>"
        for row in rows
    )
    return (
        f'<div style="overflow:auto;max-height:{TALL}px;font-size:90%"><div style="padding:0 8px'
        f' 4px">{escape(printable(caption))}</div>'
        "<table"
        f' style="border-collapse:collapse"><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )
