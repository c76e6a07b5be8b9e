"""Tests of notebook output: pictures and tables, bounded and escaped."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest

import lidarspec as ls
from tests.broken import interpreted
from tests.view.test_polar import cloud

SCRIPT = "<script>alert('x')</script>"


def dots(svg: str, view: int = 0) -> list[tuple[float, float]]:
    """Return the positions of the dots of a view, pixels from its upper left corner."""
    group = ET.fromstring(svg).findall("{*}svg")[view].find("{*}g[@transform]")
    assert group is not None
    scale = float(group.get("transform", "").removeprefix("scale(").removesuffix(")"))
    found = []
    for path in group:
        steps = np.array(
            [list(map(int, step)) for step in re.findall(r"m(-?\d+) (-?\d+)h0", path.get("d", ""))]
        )
        found += (np.cumsum(steps, axis=0) * scale).tolist()
    return [(across, down) for across, down in found]


def test_a_cloud_is_drawn_at_its_coordinates() -> None:
    svg = cloud((4, 0, 0), (0, 2, 0))._repr_svg_()
    assert svg is not None
    middle = 260
    # Two metres from the middle of the points to their ends, and a margin.
    metre = middle / (2 * 1.08)
    expected = [(middle - metre, middle + 2 * metre), (middle + metre, middle - 2 * metre)]
    np.testing.assert_allclose(sorted(dots(svg)), expected, atol=0.5)
    assert "2 returns as 2 dots" in svg
    assert len(ET.fromstring(svg).findall("{*}svg")) == 1  # flat: from above alone


def test_a_cloud_with_heights_is_drawn_from_the_side_as_well() -> None:
    svg = cloud((4, 0, 1), (2, 0, -1))._repr_svg_()
    assert svg is not None
    (first, high), (second, low) = sorted(dots(svg, 1), reverse=True)
    # The two metres between the points, with a margin, are the width of the picture.
    metres = 2 * 260 / 1.08
    assert first - second == pytest.approx(metres, abs=0.6)
    assert low - high == pytest.approx(metres, abs=0.6)


def test_single_points_and_empty_clouds_are_displayed_as_text() -> None:
    assert cloud((1, 2, 0))[0]._repr_svg_() is None
    assert "0 returns" in str(cloud()._repr_svg_())


@pytest.mark.slow
def test_a_large_cloud_makes_a_small_picture_that_says_so() -> None:
    rng = np.random.default_rng(1)
    svg = cloud(*map(tuple, rng.uniform(-9, 9, (200_000, 3)).tolist()))._repr_svg_()
    assert svg is not None
    assert len(svg) < 300_000
    told = re.search(r"200,000 returns as ([\d,]+) and ([\d,]+) dots", svg)
    assert told is not None
    assert [len(dots(svg, view)) for view in (0, 1)] == [
        int(number.replace(",", "")) for number in told.groups()
    ]


def packets(sensor: ls.Sensor, number: int) -> ls.Packets:
    data = [sensor.example(sensor.data_frame, seed=seed) for seed in range(number)]
    return sensor.decode(data if sensor.datagrams else b"".join(data))


def cells(html: str) -> list[list[str]]:
    """Return the texts of the cells of a table, row by row."""
    table = re.search(r"<table.*</table>", html, re.DOTALL)
    assert table is not None
    rows = ET.fromstring(table[0].replace("<br>", "<br/>").replace("&nbsp;", " ")).iter("tr")
    return [["".join(cell.itertext()).strip() for cell in row] for row in rows]


def test_packets_are_a_table_with_units_and_times() -> None:
    some = packets(ls.sensor("ldrobot-stl27l"), 12)
    heads, *rows = cells(str(some._repr_html_()))
    assert heads[:4] == ["offset", "time [s]", "speed [deg/s]", "start_angle [deg]"]
    assert [row[0] for row in rows] == [
        *map(str, range(0, 5 * 47, 47)),
        "⋮",
        *map(str, range(7 * 47, 12 * 47, 47)),
    ]
    assert [float(row[3]) for row in rows[:5]] == pytest.approx(some["start_angle"][:5].tolist())
    distances = some["points.distance"][0]
    assert (
        rows[0][heads.index("points.distance [m]")]
        == f"12 x {distances.min():.10g} to {distances.max():.10g}"
    )
    assert len(cells(str(some.take([])._repr_html_()))) == 1


#: sensors with long tables: deep, of many frames, of text, of parts.
LONG = ("ouster-os1", "sick-tim571", "ti-iwr6843", "velodyne-vls128")


@pytest.mark.parametrize(
    "sensor_id",
    [
        "robosense-m1",
        "slamtec-rplidar-a1",
        *(pytest.param(name, marks=pytest.mark.slow) for name in LONG),
    ],
)
def test_tables_and_diagrams_are_bounded(sensor_id: str) -> None:
    sensor = ls.sensor(sensor_id)
    some, frame = packets(sensor, 4), sensor.example(sensor.data_frame)
    assert len(str(some._repr_html_())) < 100_000
    explained = ls.explain(frame, sensor)
    table = explained._repr_html_()
    assert len(table) < 150_000
    shown = bytes.fromhex(
        " ".join(
            re.sub(r"[^0-9a-f ]", "", row[1].replace("\n", " "))
            for row in cells(table)[1:]
            if row[1]
        ).replace(" ", "")
    )
    assert frame.startswith(shown)
    assert (shown == frame) == ("further rows" not in table)
    diagrams = str(sensor._repr_html_())
    assert diagrams.count("<details") == len(sensor.frames)
    assert diagrams.count("<svg") >= len(sensor.data_frames)


def test_errors_are_marked() -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    frame = bytearray(sensor.example("data"))
    good = str(ls.explain(bytes(frame), sensor)._repr_html_())
    frame[-1] ^= 1
    bad = str(ls.explain(bytes(frame), sensor)._repr_html_())
    assert "<b>" not in good
    assert re.search(r"hsl\(0 90%[^>]*>[0-9a-f]{2}</code>.*<b>[^<]* wrong, expected", bad)


def test_text_of_frames_and_specs_is_escaped() -> None:
    sensor = dataclasses.replace(ls.sensor("ldrobot-stl27l"), model=SCRIPT, source=SCRIPT)
    scan = next(ls.sensor("ldrobot-stl27l").scans(sensor.example("data")))
    marked = dataclasses.replace(scan, sensor=dataclasses.replace(sensor, id="ldrobot-stl27l"))
    for text in (sensor._repr_html_(), marked._repr_svg_(), packets(sensor, 2)._repr_html_()):
        assert "<script" not in str(text)
    assert "&lt;script&gt;" in str(sensor._repr_html_())
    named = dataclasses.replace(
        ls.explain(sensor.example("data"), sensor), sensor=SCRIPT, notes=(SCRIPT,)
    )
    assert str(named._repr_html_()).count("&lt;script&gt;") == 2
    assert "<script" not in str(named._repr_html_())


def test_a_frame_that_no_export_draws_says_why() -> None:
    html = str(interpreted.lidarspec_sensors()[0]._repr_html_())
    assert "the fields after RepeatUntil have no fixed offset" in html
    assert "<svg" in html


@pytest.mark.slow
def test_nothing_that_draws_is_imported_before_a_notebook_asks() -> None:
    script = (
        "import sys, lidarspec as ls; s = ls.sensor('ldrobot-stl27l'); scans ="
        " list(s.scans(s.example('data')))\nassert not any(name.startswith(('lidarspec.view',"
        " 'lidarspec.exports')) for name in sys.modules)\nassert"
        " scans[0]._repr_svg_().startswith('<svg') and 'lidarspec.view.svg' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
