"""`read`: what a sensor sends, as rows."""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import click
import numpy as np

from lidarspec.cli.output import note, sensor_option
from lidarspec.cli.streams import Duration, Patience, nothing_came
from lidarspec.device import Device, open as open_device
from lidarspec.errors import UnknownFrame
from lidarspec.scans import Scan
from lidarspec.view.feed import LOOK, Feed

#: unit, width and decimals of the columns of points.
POINTS = {
    "x": ("m", 9, 3),
    "y": ("m", 9, 3),
    "z": ("m", 9, 3),
    "range": ("m", 9, 3),
    "azimuth": ("rad", 9, 4),
    "elevation": ("rad", 9, 4),
    "intensity": ("", 9, 0),
    "time": ("s", 10, 6),
    "ring": ("", 5, 0),
    "return_index": ("", 12, 0),
}
#: digits of a packet's field, and the width of its column at least.
DIGITS, NARROWEST = 10, 8
#: digits of a float64 in JSON.
KEPT = 14

Row = dict[str, Any]
Units = Mapping[str, str]


@click.command()
@click.argument("source", metavar="SOURCE")
@sensor_option
@click.option("--packets", "whole", is_flag=True, help="A row for each packet of the data frame, not for each point.")
@click.option("-f", "--frame", metavar="NAME", help="The packets of this frame type.")
@click.option("-n", "--count", type=click.IntRange(min=1), help="Rows at most.")
@click.option("-t", "--duration", type=Duration(), help="How long at most, such as 10s.")
@click.option("--all", "every_point", is_flag=True, help="Points without a valid return as well.")
@click.option("--json", "as_json", is_flag=True, help="Print a JSON object on each line.")
def read(
    source: str,
    sensor_id: str | None,
    whole: bool,
    frame: str | None,
    count: int | None,
    duration: float | None,
    every_point: bool,
    as_json: bool,
) -> None:
    """The points that a sensor sends, a row each; or its packets.

    Points come as their scan is completed, with the columns of a PointCloud and the number of the scan: metres, radians, seconds
    since the scan's stamp. Packets have their offset in the input, their time, and the values of their fields in units; arrays are
    printed only by --json.
    """
    with open_device(source, sensor_id) as device:
        if frame is not None and frame not in device.sensor.frames:
            raise UnknownFrame(frame, device.sensor.frames, place=device.sensor.id)
        until = time.monotonic() + duration if duration else math.inf
        patience = Patience(device, source)
        rows = _packets(device, frame, until, patience) if whole or frame else _points(device, until, patience, every_point=every_point)
        printed = 0
        for line in _lines(itertools.islice(rows, count), as_json=as_json):
            click.echo(line)
            printed += 1
        if not printed and not device.stats.frames:
            raise nothing_came(device, source, duration)
        for warning in device.warnings:
            note(warning)


def _lines(rows: Iterable[tuple[Units, Row]], *, as_json: bool) -> Iterator[str]:
    """Each row as JSON, or all as aligned columns with their names and units above."""
    widths: list[int] = []
    for units, row in rows:
        if as_json:
            yield json.dumps({name: _plain(value) for name, value in row.items()}, allow_nan=False)
            continue
        shown = {name: value for name, value in row.items() if not isinstance(value, np.ndarray)}
        if not widths:
            headers = [f"{name} [{units[name]}]" if units.get(name) else name for name in shown]
            widths = [max(len(header), _width(name)) for header, name in zip(headers, shown, strict=True)]
            yield _joined(headers, widths)
        yield _joined([_text(name, value) for name, value in shown.items()], widths)


def _points(device: Device, until: float, patience: Patience, *, every_point: bool) -> Iterator[tuple[Units, Row]]:
    """The points of each scan, when it is complete; of the pieces at the beginning and end too."""
    units = {name: unit for name, (unit, _, _) in POINTS.items()}
    for number, scan in enumerate(_scans(device, until, patience)):
        cloud = scan.points if every_point else scan.points[scan.points.valid]
        columns = dict(cloud.columns)
        for values in zip(*columns.values(), strict=True):
            yield units, {"scan": number, **dict(zip(columns, values, strict=True))}


def _scans(device: Device, until: float, patience: Patience) -> Iterator[Scan]:
    waiting: list[Scan] = []
    feed = Feed(device, seen=waiting.append)
    while not feed.ended and time.monotonic() < until:
        feed.pump(0.0)
        patience.check()
        yield from waiting
        waiting.clear()


def _packets(device: Device, frame: str | None, until: float, patience: Patience) -> Iterator[tuple[Units, Row]]:
    """The packets one by one, with the fields of their header in units; arrays as arrays."""
    for packets in device.packets(frame, wait=LOOK):
        patience.check()
        fields = {path: info for path, info in packets.table.schema.fields.items() if info.const is None}
        units = {path: info.unit for path, info in fields.items()}
        columns = {path: packets[path] for path in fields}
        for place in range(len(packets)):
            times = {"offset": int(packets.offset[place]), "time_ns": int(packets.time_ns[place])}
            yield units, {**times, **{path: _scalar(column[place]) for path, column in columns.items()}}
        if time.monotonic() >= until:
            return


def _scalar(value: Any) -> Any:
    return value if np.ndim(value) else float(value)


def _width(name: str) -> int:
    return POINTS[name][1] if name in POINTS else 20 if name.endswith("_ns") else NARROWEST


def _text(name: str, value: Any) -> str:
    if isinstance(value, int):
        return str(value)
    if not math.isfinite(value):
        return "-" if math.isnan(value) else "inf"
    return f"{value:.{POINTS[name][2]}f}" if name in POINTS else f"{value:.{DIGITS}g}"


def _joined(cells: Sequence[str], widths: Sequence[int]) -> str:
    return " ".join(cell.rjust(width) for cell, width in zip(cells, widths, strict=True))


def _plain(value: Any) -> Any:
    """A value as JSON takes it: null for nan and infinity, whole numbers without a point."""
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value]
    number, single = value.item() if isinstance(value, np.generic) else value, isinstance(value, np.float32)
    if isinstance(number, float):
        if not math.isfinite(number):
            return None
        # a float32 has the digits that it prints; scales of ten leave their rounding in the last digits of a float64
        return int(number) if number.is_integer() and abs(number) < 2**53 else float(str(value) if single else f"{number:.{KEPT}g}")
    return number
