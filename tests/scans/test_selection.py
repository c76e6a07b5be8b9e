"""Tests of selecting scans by time, number and position."""

from __future__ import annotations

import asyncio
import gzip
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Scan, Selection, UsageError, simulate
from lidarspec.errors import suggestion
from lidarspec.simulation.clock_faults import parse_clock_faults
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.simulation.faults import Faults
from lidarspec.transports.simulated_files import write_file
from tests.cli.running import ran
from tests.shapes import SHAPES

ID = "ldrobot-stl27l"
#: the length of the recordings, and the scans in them.
SECONDS = 10
FRAMES_PER_SECOND = 1800
BYTES_PER_FRAME = 47
NUMBER_OF_SCANS = "(100|101)"
#: the last scan begins here, or at the end.
END = r"(9\.9|10)"


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return a recording, a capture and a compressed capture of the same seconds.

    Times are found without reading in the first two; the compressed one is read through.
    """
    folder = tmp_path_factory.mktemp("selection")
    ran("sim", ID, "--to", folder / "drive.lsr", "-t", f"{SECONDS}s")
    ran("replay", folder / "drive.lsr", "--to", folder / "drive.pcap", "-s", ID)
    (folder / "drive.gz").write_bytes(gzip.compress((folder / "drive.pcap").read_bytes(), 1))
    return {suffix: folder / f"drive.{suffix}" for suffix in ("lsr", "pcap", "gz")}


def scans(path: Path, select: Selection | None = None) -> Iterator[Scan]:
    """Return the selected scans of a file; fail if bytes after the last one are read."""
    with ls.open(path, ID) as device:
        yield from device.scans(select=select)


@pytest.fixture(scope="module")
def every(recordings: dict[str, Path]) -> list[Scan]:
    """Return all scans."""
    return list(scans(recordings["pcap"]))


def assert_same(some: list[Scan], others: list[Scan]) -> None:
    """Fail unless the scans have the same points at the same times."""
    assert [scan.stamp_ns for scan in some] == [scan.stamp_ns for scan in others]
    for one, other in zip(some, others, strict=True):
        assert list(one.points.columns) == list(other.points.columns)
        for name, column in one.points.columns.items():
            np.testing.assert_allclose(
                column, other.points.columns[name], rtol=0, atol=1e-12 if name == "time" else 0
            )


@pytest.mark.slow
def test_the_same_is_selected_wherever_scans_come_from(
    recordings: dict[str, Path], every: list[Scan]
) -> None:
    select = Selection(scans=(3, 20), every=4, columns=("x", "y"))
    wanted = list(scans(recordings["pcap"], select))
    assert [scan.stamp_ns for scan in wanted] == [scan.stamp_ns for scan in every[3:20:4]]
    frames = [
        frame for packets in ls.open(recordings["pcap"], ID).packets() for frame in packets.raw
    ]
    of_bytes = ls.sensor(ID).scans(b"".join(bytes(frame) for frame in frames), select=select)
    assert [len(scan) for scan in of_bytes] == [len(scan) for scan in wanted]

    async def collected() -> list[Scan]:
        async with ls.open_async(recordings["pcap"], ID) as device:
            found = [scan async for scan in device.scans(select=select)]
            with pytest.raises(UsageError, match="the selection is outside this range"):
                _ = [scan async for scan in device.scans(select=Selection(scans=(10_000, None)))]
            return found

    assert_same(asyncio.run(collected()), wanted)
    with pytest.raises(UsageError, match=r"the data has .* the selection is outside this range"):
        list(ls.sensor(ID).scans(bytes(frames[0]) * 30, select=Selection(scans=(10, 12))))


@pytest.mark.parametrize("suffix", ["lsr", "pcap"])
@pytest.mark.parametrize(
    ("times", "seconds"),
    [((6.0, 7.5), (6, 7.5)), ((8.5, None), (8.5, 99)), ((None, 0.5), (0, 0.5))],
)
def test_a_slice_is_the_scans_of_that_time(
    recordings: dict[str, Path], every: list[Scan], suffix: str, times: Any, seconds: Any
) -> None:
    first = every[0].stamp_ns
    wanted = [
        scan for scan in every if seconds[0] * 1e9 <= scan.stamp_ns - first < seconds[1] * 1e9
    ]
    assert 4 < len(wanted) < 22
    assert_same(list(scans(recordings[suffix], Selection(times=times))), wanted)
    dates = tuple(
        None
        if moment is None
        else datetime.fromtimestamp(0, UTC)
        + timedelta(microseconds=first // 1000)
        + timedelta(seconds=moment)
        for moment in times
    )
    with ls.open(recordings[suffix], ID) as device:
        found = list(device.scans(select=Selection(times=dates)))
    assert abs(len(found) - len(wanted)) <= 1


@pytest.mark.slow
@pytest.mark.parametrize(("suffix", "share"), [("lsr", 0.4), ("pcap", 0.8)])
def test_a_slice_of_a_long_file_skips_earlier_data(
    tmp_path: Path, suffix: str, share: float
) -> None:
    path = tmp_path / f"drive.{suffix}"
    ran("sim", ID, "--to", path, "-t", "40s")
    with ls.open(path, ID) as device:
        scans_of_slice = list(device.scans(select=Selection(times=(25.0, 26.5))))
        bytes_read = device.stats.bytes_in
    assert 13 < len(scans_of_slice) < 17
    bytes_sent = 40 * FRAMES_PER_SECOND * BYTES_PER_FRAME
    assert bytes_read < share * bytes_sent


def test_each_so_manieth_scan_of_some_by_number(
    recordings: dict[str, Path], every: list[Scan]
) -> None:
    for selection, wanted in (
        (Selection(scans=(5, 10)), slice(5, 10)),
        (Selection(scans=(5, 25), every=7), slice(5, 25, 7)),
        (Selection(times=(None, 1.0), every=3), slice(0, 11, 3)),
        (Selection(times=(0.5, 1.5), scans=(0, 9)), slice(5, 9)),
    ):
        found = list(scans(recordings["pcap"], selection))
        assert [scan.stamp_ns for scan in found] == [scan.stamp_ns for scan in every[wanted]]


def test_by_the_time_of_arrival(recordings: dict[str, Path]) -> None:
    every = list(scans(recordings["lsr"], Selection(scans=(0, 30))))
    hosts = [scan.host_ns for scan in every]
    found = list(scans(recordings["lsr"], Selection(times=(1.0, 2.0), time="host")))
    assert [scan.stamp_ns for scan in found] == [
        host for host in hosts if 10**9 <= host - hosts[0] < 2 * 10**9
    ]
    assert all(scan.points.stamp_ns == scan.stamp_ns == scan.host_ns for scan in found)
    assert all(scan.points.time[0] == 0 for scan in found)


def test_returns_outside_the_ranges_are_dropped(recordings: dict[str, Path]) -> None:
    every = list(scans(recordings["pcap"], Selection(scans=(3, 6))))
    for scan, near in zip(
        every, scans(recordings["pcap"], Selection(scans=(3, 6), ranges=(1.5, 3.0))), strict=True
    ):
        ranges, valid = scan.points.range, scan.points.valid
        inside = valid & (ranges >= 1.5) & (ranges <= 3.0)
        assert 0 < inside.sum() < valid.sum()
        cloud = near.points
        np.testing.assert_array_equal(cloud.valid, inside)
        np.testing.assert_array_equal(
            cloud.range,
            np.where(
                valid & (ranges < 1.5), -np.inf, np.where(valid & (ranges > 3.0), np.inf, ranges)
            ),
        )
        for axis in "xyz":
            np.testing.assert_array_equal(
                getattr(cloud, axis), np.where(inside, getattr(scan.points, axis), np.nan)
            )
        np.testing.assert_array_equal(cloud.intensity, scan.points.intensity)
        planar = near.to_laserscan(100)
        assert np.isin(planar.ranges[np.isfinite(planar.ranges)], ranges[inside]).all()


def test_columns_have_the_requested_order(recordings: dict[str, Path]) -> None:
    for scan in scans(recordings["pcap"], Selection(scans=(3, 5), columns=("intensity", "y"))):
        cloud = scan.points
        for some in (cloud, cloud[:100], cloud[cloud.valid]):
            assert list(some.columns) == ["intensity", "y"]
            assert len(some.columns["y"]) == len(some)
        assert cloud.to_structured()["time"].max() == 0 < cloud.time.max()
    with pytest.raises(UsageError, match=r"unknown name 'rings'; did you mean 'range'"):
        list(scans(recordings["pcap"], Selection(columns=("rings",))))


def test_beams_and_frame_go_with_the_scan(recordings: dict[str, Path]) -> None:
    for scan in scans(recordings["pcap"], Selection(scans=(0, 5), beams=450, frame_id="front")):
        assert scan.frame_id == "front"
        assert len(scan.to_laserscan().ranges) == 450


@pytest.mark.parametrize(
    ("suffix", "selection", "message"),
    [
        ("gz", Selection(times=(100.0, None)), rf"{NUMBER_OF_SCANS} scans, from 0 s to {END}"),
        ("pcap", Selection(times=(100.0, None)), rf"scans, from 0 s to {END}"),
        ("pcap", Selection(scans=(1000, None)), rf"{NUMBER_OF_SCANS} scans, from 0 to (99|100)"),
    ],
)
def test_a_slice_past_the_end_is_an_error_with_the_duration(
    recordings: dict[str, Path], suffix: str, selection: Selection, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        list(scans(recordings[suffix], selection))


def test_bytes_without_times_have_no_slice(tmp_path: Path) -> None:
    source = tmp_path / "timeless.bin"
    source.write_bytes(b"".join(simulate(ls.sensor("cspc-coin-d4"), 500)))
    for selection, command in (
        (Selection(time="host"), "repeat with --time sensor"),
        (Selection(times=(1.0, None)), "repeat with indices of scans, such as --scans 5:10"),
    ):
        with (
            ls.open(source, "cspc-coin-d4") as device,
            pytest.raises(UsageError, match="has no arrival times") as refused,
        ):
            list(device.scans(select=selection))
        assert suggestion(refused.value) == command


@pytest.mark.parametrize(
    "wrong",
    [
        {"scans": (-3, None)},
        {"scans": (5, 5)},
        {"every": 0},
        {"times": (5.0, 1.0)},
        {"ranges": (3.0, 1.0)},
    ],
)
def test_a_selection_of_nothing_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        Selection(**wrong)


def record(path: Path, sensor: ls.Sensor, clock: str, seconds: float = 2.0) -> Path:
    """Write a recording of a simulated sensor with faults of its clock."""
    faults = Faults(clock=parse_clock_faults(clock))
    write_file(SimulatedDevice(sensor, faults=faults), path, seconds)
    return path


def test_stamps_in_utc_follow_from_the_clock_and_changes_are_reported(tmp_path: Path) -> None:
    synced = SHAPES["shape-synced"]
    path = record(tmp_path / "drive.lsr", synced, "tai,unlock=0.5s@1s")
    stamps = dict[str, list[int]]()
    for time in ("sensor", "utc"):
        with ls.open(path, synced) as device:
            selection = Selection(time=time)  # type: ignore[arg-type]
            stamps[time] = [scan.stamp_ns for scan in device.scans(select=selection)]
            warnings = device.warnings
    assert len(stamps["utc"]) > 10
    offsets = {sensor - utc for sensor, utc in zip(*stamps.values(), strict=True)}
    assert offsets == {37_000_000_000}
    changes = [text for text in warnings if "UTC comes from" in text]
    assert len(changes) == 2
    assert "holdover" in changes[0]


def test_stamps_of_a_free_clock_are_mapped_to_utc_by_arrival(recordings: dict[str, Path]) -> None:
    """The simulated packets arrive up to 1 ms late, and the first packet arrives 1 ms late."""
    path = recordings["lsr"]
    with ls.open(path, ID) as device:
        first_arrival_ns = min(int(packets.host_ns.min()) for packets in device.packets())
    power_on_ns = first_arrival_ns - 1_000_000
    utc = [scan.stamp_ns for scan in scans(path, Selection(time="utc"))]
    own = [scan.stamp_ns for scan in scans(path)]
    errors_ms = (np.array(utc) - np.array(own) - power_on_ns) * 1e-6
    # The sensor counts milliseconds.
    assert errors_ms.min() > -1.1
    assert errors_ms.max() < 1.1


def test_a_slice_in_utc_selects_by_date(tmp_path: Path) -> None:
    synced = SHAPES["shape-synced"]
    path = record(tmp_path / "drive.lsr", synced, "tai")
    with ls.open(path, synced) as device:
        first, *_ = device.scans(select=Selection(time="utc"))
    begin = datetime.fromtimestamp(first.stamp_ns / 1e9 + 1, UTC)
    with ls.open(path, synced) as device:
        found = list(device.scans(select=Selection(time="utc", times=(begin, None))))
    assert 8 <= len(found) <= 11
    assert min(scan.stamp_ns for scan in found) >= first.stamp_ns + 999_999_000


@pytest.mark.parametrize("time", ["utc", "host"])
def test_imu_samples_have_the_clock_of_the_stamps(tmp_path: Path, time: Any) -> None:
    sensor = SHAPES["shape-inertia"]
    path = record(tmp_path / "drive.lsr", sensor, "step=1s")
    differences = []
    for selection in (Selection(), Selection(time=time)):
        with ls.open(path, sensor) as device:
            chosen = list(device.scans(select=selection))
        assert all(scan.imu is not None for scan in chosen)
        differences.append(
            [scan.imu.time_ns - scan.stamp_ns for scan in chosen if scan.imu is not None]
        )
    for before, after in zip(*differences, strict=True):
        np.testing.assert_array_equal(before, after)


def test_another_clock_is_refused() -> None:
    with pytest.raises(UsageError, match="sensor, utc, host"):
        Selection(time="device")  # type: ignore[arg-type]
