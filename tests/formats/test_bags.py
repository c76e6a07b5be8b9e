"""Tests of points in robotics logs, read with other libraries."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Scan, SourceError, simulate
from lidarspec.errors import LibraryError, UsageError
from lidarspec.formats import write
from tests.formats.test_formats import scan
from tests.libraries import Library, needs
from tests.shapes import SHAPES

pytestmark = [pytest.mark.slow, needs("rosbags", "mcap")]
reading = Library("rosbags.highlevel")
mcap = Library("mcap.reader")
SUFFIXES = ["mcap", "bag", "rosbag2", "db3"]
TYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}


def messages(path: Path) -> list[tuple[str, int, Any]]:
    """Return topic, time and content of every message in a log, read by rosbags."""
    with reading.AnyReader([path]) as log:
        return [
            (link.topic, at, log.deserialize(raw, link.msgtype)) for link, at, raw in log.messages()
        ]


def points(message: Any) -> np.ndarray:
    """Return the points of a PointCloud2, (height, width), by the fields it declares."""
    fields = {
        "names": [field.name for field in message.fields],
        "formats": [TYPES[field.datatype] for field in message.fields],
        "offsets": [field.offset for field in message.fields],
        "itemsize": message.point_step,
    }
    assert message.row_step == message.width * message.point_step
    return np.frombuffer(bytes(message.data), np.dtype(fields)).reshape(
        message.height, message.width
    )


def simulate_scans(name: str, packets: int) -> list[Scan]:
    sensor = SHAPES.get(name) or ls.sensor(name)
    return list(sensor.scans(simulate(sensor, packets)))


@pytest.mark.parametrize("every_point", [False, True])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_log_has_a_cloud_for_each_scan_at_its_time(
    tmp_path: Path, suffix: str, every_point: bool
) -> None:
    scans = [scan(0), scan(1, points=3000), scan(2, intensity=False)]
    write(tmp_path / f"a.{suffix}", scans, every_point=every_point)
    found = [
        (at, message)
        for topic, at, message in messages(tmp_path / f"a.{suffix}")
        if topic == "/points"
    ]
    assert [at for at, _ in found] == [one.stamp_ns for one in scans]
    for one, (at, message) in zip(scans, found, strict=True):
        cloud = one.points if every_point else one.points[one.points.valid]
        (row,) = points(message)
        assert row.dtype.names == (
            "x",
            "y",
            "z",
            *(("intensity",) if cloud.intensity is not None else ()),
            "time",
        )
        for name in row.dtype.names:
            np.testing.assert_array_equal(row[name], getattr(cloud, name).astype(np.float32))
        assert (message.header.frame_id, message.is_dense) == ("laser", not every_point)
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == at
    assert [path.name for path in tmp_path.iterdir()] == [f"a.{suffix}"]


@pytest.mark.parametrize("name", ["ldrobot-stl27l", "shape-extras"])
def test_foxglove_has_its_own_messages(tmp_path: Path, name: str) -> None:
    decoding = pytest.importorskip(
        "mcap_protobuf.decoder", reason="mcap-protobuf-support is not installed"
    )
    pytest.importorskip(
        "foxglove_schemas_protobuf", reason="foxglove-schemas-protobuf is not installed"
    )
    scans = [dataclasses.replace(one, frame_id="front") for one in simulate_scans(name, 120)]
    write(tmp_path / "a.foxglove.mcap", scans)
    with (tmp_path / "a.foxglove.mcap").open("rb") as file:
        log = mcap.make_reader(file, decoder_factories=[decoding.DecoderFactory()])
        found = [
            (schema.name, record.log_time, message)
            for schema, _, record, message in log.iter_decoded_messages()
        ]
        told = [record.metadata for record in log.iter_metadata()]
    assert told == (
        [{"velocity": "m/s", "signal": "photons", "confidence": "1"}]
        if name == "shape-extras"
        else []
    )
    clouds = [(at, message) for kind, at, message in found if kind == "foxglove.PointCloud"]
    assert (
        [at for at, _ in clouds]
        == [message.timestamp.ToNanoseconds() for _, message in clouds]
        == [one.stamp_ns for one in scans]
    )
    for one, (_, message) in zip(scans, clouds, strict=True):
        kinds = ["", "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<f4", "<f8"]
        fields = {
            field.name: (np.dtype(kinds[field.type]), field.offset) for field in message.fields
        }
        rows = np.frombuffer(
            message.data,
            np.dtype(
                {
                    "names": list(fields),
                    "formats": [kind for kind, _ in fields.values()],
                    "offsets": [at for _, at in fields.values()],
                    "itemsize": message.point_stride,
                }
            ),
        )
        for column in {"x", "y", "z", *one.points.extra}:
            np.testing.assert_array_equal(
                rows[column], one.points.read(column)[column][one.points.valid]
            )
        assert (message.frame_id, message.pose.orientation.w) == ("front", 1)
    planar = [message for kind, _, message in found if kind == "foxglove.LaserScan"]
    assert len(planar) == (len(scans) if name == "ldrobot-stl27l" else 0)
    for one, message in zip(scans, planar, strict=False):
        same = one.to_laserscan()
        assert (message.start_angle, message.end_angle) == (same.angle_min, same.angle_max)
        np.testing.assert_array_equal(np.array(message.ranges, np.float32), same.ranges)
        np.testing.assert_array_equal(np.array(message.intensities, np.float32), same.intensities)


def test_a_folder_is_a_valid_ros_2_bag(tmp_path: Path) -> None:
    write(tmp_path / "a.rosbag2", [scan(0)])
    assert {path.name for path in (tmp_path / "a.rosbag2").iterdir()} == {
        "metadata.yaml",
        "scans.mcap",
    }
    write(tmp_path / "a.rosbag2", [scan(0), scan(1)])
    assert len(messages(tmp_path / "a.rosbag2")) == 4


def test_mcap_is_read_by_its_own_reader(tmp_path: Path) -> None:
    decoding = pytest.importorskip("mcap_ros2.decoder", reason="mcap is not installed")
    scans = simulate_scans("shape-extras", 60)
    write(tmp_path / "a.mcap", scans)
    with (tmp_path / "a.mcap").open("rb") as file:
        log = mcap.make_reader(file, decoder_factories=[decoding.DecoderFactory()])
        assert log.get_header().profile == "ros2"
        assert [record.metadata for record in log.iter_metadata()] == [
            {"velocity": "m/s", "signal": "photons", "confidence": "1"}
        ]
        found = [
            (channel.topic, record.log_time, message)
            for _, channel, record, message in log.iter_decoded_messages()
        ]
    assert [(topic, at) for topic, at, _ in found] == [("/points", one.stamp_ns) for one in scans]
    for one, (_, _, message) in zip(scans, found, strict=True):
        (row,) = points(message)
        for name in ("x", "velocity", "signal", "strong"):
            np.testing.assert_array_equal(row[name], one.points.read(name)[name][one.points.valid])


def test_further_columns_keep_their_types_where_ros_has_them_and_come_with_units(
    tmp_path: Path,
) -> None:
    one = scan(0)
    extra = {
        "count": np.arange(5) + 2**40,
        "half": np.arange(5, dtype=np.float16) / 2,
        "tag": np.arange(5, dtype=np.uint8),
    }
    cloud = dataclasses.replace(one.points, extra=extra, units={"half": "m/s"})
    write(tmp_path / "a.rosbag2", [dataclasses.replace(one, points=cloud)], every_point=True)
    (row,) = points(messages(tmp_path / "a.rosbag2")[0][2])
    assert [row.dtype[name].str for name in extra] == ["<f8", "<f8", "|u1"]
    for name, column in {**extra, "z": cloud.z}.items():
        np.testing.assert_array_equal(row[name], column)
    assert "unit of half: m/s" in (tmp_path / "a.rosbag2" / "metadata.yaml").read_text(
        encoding="utf-8"
    )


def test_organised_points_have_a_row_for_each_of_the_sensor(tmp_path: Path) -> None:
    one, *_ = (one for one in simulate_scans("velodyne-vlp16", 100) if one.points.shape)
    rows, columns = 16, len(one) // 16  # of which two stand in a column of the packet
    write(tmp_path / "a.bag", [one], every_point=True)
    ((_, _, message),) = messages(tmp_path / "a.bag")
    assert (message.height, message.width) == (rows, columns)
    np.testing.assert_array_equal(points(message)["ring"], one.points.ring.reshape(columns, rows).T)
    np.testing.assert_array_equal(points(message)["x"], one.points.x.reshape(columns, rows).T)


def test_a_scan_of_one_plane_is_a_laserscan_as_well(tmp_path: Path) -> None:
    scans = simulate_scans("ldrobot-stl27l", 200)
    write(tmp_path / "a.mcap", scans)
    found = [
        (at, message) for topic, at, message in messages(tmp_path / "a.mcap") if topic == "/scan"
    ]
    for one, (at, message) in zip(scans, found, strict=True):
        planar = one.to_laserscan()
        assert (at, message.header.frame_id) == (one.stamp_ns, "laser")
        for name in (
            "angle_min",
            "angle_max",
            "angle_increment",
            "time_increment",
            "scan_time",
            "range_min",
            "range_max",
        ):
            assert getattr(message, name) == np.float32(getattr(planar, name))
        np.testing.assert_array_equal(message.ranges, planar.ranges)
        np.testing.assert_array_equal(message.intensities, planar.intensities)
    write(tmp_path / "b.mcap", [scan(0, intensity=False)])
    assert len(messages(tmp_path / "b.mcap")[1][2].intensities) == 0
    write(tmp_path / "c.mcap", simulate_scans("velodyne-vlp16", 100))
    assert {topic for topic, _, _ in messages(tmp_path / "c.mcap")} == {"/points"}


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_scan_and_no_point_are_no_message_and_an_empty_one(tmp_path: Path, suffix: str) -> None:
    write(tmp_path / f"a.{suffix}", [])
    assert messages(tmp_path / f"a.{suffix}") == []
    write(
        tmp_path / f"b.{suffix}",
        [dataclasses.replace(one := scan(0), points=one.points[:0]), scan(1)],
    )
    assert [
        message.width
        for topic, _, message in messages(tmp_path / f"b.{suffix}")
        if topic == "/points"
    ] == [0, 4]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_failed_write_leaves_no_file(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def scans() -> Iterator[Scan]:
        yield scan(0)
        raise SourceError("the line broke")

    with pytest.raises(SourceError, match="the line broke"):
        write(tmp_path / f"a.{suffix}", scans())
    late: Sequence[Scan] = [
        dataclasses.replace(one := scan(0), points=dataclasses.replace(one.points, stamp_ns=2**61))
    ]
    with pytest.raises(UsageError, match="the years 1970 to 2038"):
        write(tmp_path / f"a.{suffix}", late)
    with pytest.raises(SourceError, match=f"none.a.{suffix}: folder"):
        write(tmp_path / "none" / f"a.{suffix}", [scan(0)])
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(LibraryError) as caught:
        write(tmp_path / f"a.{suffix}", [scan(0)])
    assert (caught.value.distribution, caught.value.extra) == ("rosbags", "ros")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of a process")
def test_a_full_disk_is_a_source_error(tmp_path: Path) -> None:
    script = f"""
import resource
from pathlib import Path
from lidarspec import SourceError
from lidarspec.formats import write
from tests.formats.test_formats import scan
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
for suffix in {SUFFIXES}:
    try:
        scans = (scan(number, points=3000) for number in range(20))
        write(Path({str(tmp_path)!r}) / f"a.{{suffix}}", scans)
    except SourceError as error:
        print(error)
"""
    told = subprocess.run(
        [sys.executable, "-c", script], check=True, timeout=60, capture_output=True, text=True
    ).stdout
    assert [line.partition(":")[0] for line in told.splitlines()] == [
        str(tmp_path / f"a.{suffix}") for suffix in SUFFIXES
    ], told
    assert not list(tmp_path.iterdir())
