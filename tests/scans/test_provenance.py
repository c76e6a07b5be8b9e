"""Tests of the frame that each point of a scan came from, for any batches."""

from __future__ import annotations

import functools
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Scan, Sensor, simulate
from lidarspec.packets.stream import PacketStream
from lidarspec.scans.stream import ScanStream
from lidarspec.spec import Fields, Polar, following
from lidarspec.spec.sensor import with_frames
from tests.shapes import segments

FRAMES = 200
#: frames with parts, of which 20 are a turn.
FRAMES_OF_PARTS = 65
#: points of all scans that are explained, about.
POINTS = 24
#: The same of sensors whose frames take long to explain.
POINTS_OF_LARGE = 12
#: Sensors with long frames.
LARGE = ("robosense-airy", "velodyne-vlp16")
#: Sensors with short frames, with parts and without.
SMALL = ("parts", "waiting parts", "ldrobot-stl27l")
#: names and the frames that come at a time.
CASES = (
    *((name, together) for name in SMALL for together in (3, FRAMES)),
    *(pytest.param(name, 1, marks=pytest.mark.slow) for name in SMALL),
    *(pytest.param(name, 3, marks=pytest.mark.slow) for name in LARGE),
    *(pytest.param(name, FRAMES, marks=pytest.mark.slow) for name in LARGE),
)


def waiting_points(f: Fields) -> Polar:
    """Return the points of segments; each segment waits for the next one.

    The next segment may be in another frame.
    """
    cloud = segments.points(f)
    return replace(cloud, range=cloud.range + 0 * following(f.start))


def waiting() -> Sensor:
    """Return a sensor with parts, each of which waits for the next part."""
    data = replace(segments.SENSOR.frames["data"], points={"segments": waiting_points})
    return with_frames(segments.SENSOR, {"data": data})


@functools.cache
def frames_of(sensor: Sensor) -> list[bytes]:
    return simulate(sensor, FRAMES_OF_PARTS if sensor.id == segments.SENSOR.id else FRAMES)


def scans_of(sensor: Sensor, frames: list[bytes], together: int) -> tuple[list[Scan], list[int]]:
    """Return the scans of frames, and the offset of each frame in the input.

    `together` frames arrive at a time.
    """
    decoder = sensor.decoder()
    packets, stream, scans = (
        PacketStream(sensor, sensor.data_frame, decoder.stats),
        ScanStream(sensor),
        list[Scan](),
    )
    offsets = list[int]()
    for start in range(0, len(frames), together):
        found = []
        for frame in frames[start : start + together]:
            offsets.append(decoder.stats.bytes_in)
            found += decoder.frames(frame)
        scans += stream.add(packets.add(found))
    return scans + stream.finish(), offsets


@pytest.mark.parametrize(("name", "together"), CASES)
def test_each_point_leads_to_its_frame_and_row(name: str, together: int) -> None:
    known = segments.SENSOR if name in ("parts", "waiting parts") else ls.sensor(name)
    sensor, frames = waiting() if name == "waiting parts" else known, frames_of(known)
    scans, offsets = scans_of(sensor, frames, together)
    seen = 0
    explain = functools.cache(lambda data, frame: ls.explain(data, sensor, frame))
    points_per_scan = math.ceil((POINTS_OF_LARGE if name in LARGE else POINTS) / len(scans))
    for scan in scans:
        for index in range(0, len(scan), len(scan) // points_per_scan | 1):
            place = scan.provenance(index)
            assert place.data == frames[offsets.index(place.offset)]
            explanation = explain(place.data, place.frame)
            row = next(row for row in explanation.rows if (place.part, place.number) in row.numbers)
            assert row.path == explanation.path_of(place.number, place.part)
            point = row.points[row.numbers.index((place.part, place.number))]
            if not math.isnan(point.range):  # it follows from this frame alone
                assert point.range == pytest.approx(float(scan.points.range[index]), abs=1e-5)
            if not math.isnan(point.azimuth_deg):
                turned = math.degrees(float(scan.points.azimuth[index])) - point.azimuth_deg
                assert abs((turned + 180) % 360 - 180) < 0.01
            seen += 1
    assert seen > 10


def test_points_that_a_scan_has_not_have_no_frame() -> None:
    scans, _ = scans_of(segments.SENSOR, frames_of(segments.SENSOR), FRAMES)
    for index in (-1, len(scans[0])):
        with pytest.raises(IndexError, match=f"point {index} does not exist"):
            scans[0].provenance(index)


def test_packets_do_not_go_with_a_scan_to_another_process() -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    scan = next(iter(sensor.scans(b"".join(frames_of(sensor)))))
    sent = pickle.loads(pickle.dumps(scan))
    assert np.array_equal(sent.points.x, scan.points.x)
    with pytest.raises(IndexError):
        sent.provenance(0)
