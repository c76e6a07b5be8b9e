"""Tests of LAS and LAZ files, read with laspy."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from lidarspec import Scan, simulate
from lidarspec.errors import UsageError
from lidarspec.formats import write
from tests.formats.test_formats import scan
from tests.libraries import Library, needs
from tests.shapes import SHAPES

pytestmark = [pytest.mark.slow, needs("laspy", "lazrs")]
laspy = Library("laspy")


def with_points(one: Scan, **columns: object) -> Scan:
    return dataclasses.replace(
        one, points=dataclasses.replace(one.points[np.arange(len(one))], **columns)
    )


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_points_are_in_steps_of_a_tenth_of_a_millimetre_with_gps_time(
    tmp_path: Path, name: str
) -> None:
    scans = [scan(0, points=40_000), scan(1), scan(2, points=0), scan(3, points=2)]
    write(tmp_path / name, scans)
    las = laspy.read(tmp_path / name)
    clouds = [one.points[one.points.valid] for one in scans]
    assert (las.header.point_format.id, str(las.header.version), las.header.system_identifier) == (
        6,
        "1.4",
        "ldrobot-stl27l",
    )
    assert las.header.are_points_compressed == (name == "a.laz")
    np.testing.assert_allclose(
        las.xyz, np.concatenate([cloud.xyz for cloud in clouds]), atol=5.1e-5, rtol=0
    )
    np.testing.assert_array_equal(las.header.mins, las.xyz.min(axis=0))
    np.testing.assert_array_equal(
        las.intensity, np.concatenate([cloud.intensity for cloud in clouds])
    )
    np.testing.assert_array_equal(
        las.scan, np.repeat([0, 1, 2, 3], [len(cloud) for cloud in clouds])
    )
    assert set(las.return_number) == set(las.number_of_returns) == {1}
    assert las.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.STANDARD
    # 2001-09-09 01:46:40, 1131.07 weeks after the GPS epoch, less 10^9 s, and 18 leap seconds
    seconds = 10**9 - 315_964_800 + 18 - 10**9
    expected = np.concatenate([one.time for one in clouds]) + seconds
    np.testing.assert_allclose(las.gps_time, expected, atol=1e-7, rtol=0)


def test_further_columns_are_extra_dimensions_with_their_units(tmp_path: Path) -> None:
    sensor = SHAPES["shape-extras"]
    scans = list(sensor.scans(simulate(sensor, 60)))
    write(tmp_path / "a.las", [*scans, scan(1)], every_point=True)
    las = laspy.read(tmp_path / "a.las")
    told = {dimension.name: dimension for dimension in las.point_format.extra_dimensions}
    assert [*told][-7:] == [*scans[0].points.extra, "scan"]
    assert (told["velocity"].description, told["signal"].description) == ("m/s", "photons")
    assert told["signal"].dtype == np.uint32
    for name in scans[0].points.extra:
        np.testing.assert_array_equal(
            las[name][:-5], np.concatenate([one.points.extra[name] for one in scans])
        )
    assert np.isnan(las.velocity[-5:]).all()
    assert not las.signal[-5:].any()


def test_rings_returns_and_points_without_a_return(tmp_path: Path) -> None:
    ring, order = np.arange(5, dtype=np.uint16) * 300, np.array([0, 1, 0, 1, 20], np.uint8)
    hot = np.array([np.nan, 1e6, -1, 2.6, 65535], np.float32)
    one = with_points(
        scan(0),
        ring=ring,
        return_index=order,
        intensity=hot,
        extra={"classification": ring + 1, "on": ring > 300},
    )
    write(tmp_path / "a.las", [one, scan(1, intensity=False)], every_point=True)
    las = laspy.read(tmp_path / "a.las")
    assert las.ring.tolist() == [0, 300, 600, 900, 1200, 0, 0, 0, 0, 0]
    assert list(las.return_number[:5]) == [1, 2, 1, 2, 15]
    assert list(las.number_of_returns) == [15] * 5 + [1] * 5
    assert las.intensity.tolist() == [0, 65535, 0, 3, 65535, 0, 0, 0, 0, 0]
    assert list(las.withheld) == [0, 1, 0, 0, 0] * 2
    assert las.xyz[1].tolist() == [0, 0, 0]
    assert las.classification_[:5].tolist() == (ring + 1).tolist()
    assert las.on[:5].tolist() == [0, 0, 1, 1, 1]


def test_places_far_away_count_from_nearby(tmp_path: Path) -> None:
    one = scan(0)
    write(tmp_path / "a.las", [with_points(one, x=one.points.x + np.float32(500_000))])
    las = laspy.read(tmp_path / "a.las")
    np.testing.assert_allclose(
        las.x, (one.points.x + np.float32(500_000))[one.points.valid], atol=5.1e-5, rtol=0
    )
    assert abs(las.header.offsets[0] - 500_000) < 5
    with pytest.raises(UsageError, match=r"a point is 500 km from the origin of the file \(x = "):
        write(tmp_path / "b.las", [one, with_points(one, x=one.points.x + np.float32(500_000))])
    assert [path.name for path in tmp_path.iterdir()] == ["a.las"]


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_no_scan_is_a_file_without_points(tmp_path: Path, name: str) -> None:
    write(tmp_path / name, [])
    assert len(laspy.read(tmp_path / name)) == 0
