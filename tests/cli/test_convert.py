"""Tests of `convert`: real captures give their published points."""

from __future__ import annotations

import contextlib
import csv
import errno
import gzip
import itertools
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.captures.records import WRITINGS
from lidarspec.recording.background_writer import RecordingFile
from lidarspec.simulation.simulator import simulate
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.protocol import Chunk
from tests.cli.running import COIN_D4, EXAMPLE, LD06, process, ran, run_json
from tests.evidence import capture
from tests.shapes import SHAPES, extras, inertia

EXTRAS = Path(extras.__file__)
INERTIA = Path(inertia.__file__)
COLUMNS = ["x", "y", "z", "range", "azimuth", "elevation", "intensity", "time", "scan"]


def read(path: Path) -> Mapping[str, np.ndarray]:
    """Return the columns of a .csv file."""
    with path.open(encoding="ascii", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def test_the_coin_d4_dump(tmp_path: Path) -> None:
    target = tmp_path / "out.csv"
    assert ran("convert", capture(COIN_D4), target, "-s", "cspc-coin-d4").stdout == ""
    packets = json.loads(
        capture(COIN_D4.replace("_partial.bin", "_expected.json")).read_text(encoding="utf-8")
    )
    angle = np.concatenate(
        [np.linspace(packet["fsa_deg"], packet["lsa_deg"], 25) for packet in packets]
    )
    rounded, distance = np.array(
        [pair for packet in packets for pair in packet["lds2d_angle_dist"]]
    ).T
    np.testing.assert_allclose(angle, rounded, atol=0.3)  # that decoder steps by whole 1/64 degrees
    quality = np.concatenate([packet["vendor_quality"] for packet in packets])
    angle, distance, quality = (column[distance > 0] for column in (angle, distance, quality))
    found = read(target)
    assert list(found) == COLUMNS
    assert len(found["x"]) == 97
    np.testing.assert_allclose(found["range"], distance / 1000, rtol=1e-6)
    np.testing.assert_allclose(found["intensity"], quality)
    np.testing.assert_allclose(found["x"], distance / 1000 * np.cos(np.deg2rad(angle)), atol=1e-5)
    np.testing.assert_allclose(found["y"], -distance / 1000 * np.sin(np.deg2rad(angle)), atol=1e-5)


def test_the_ld06_frames(tmp_path: Path) -> None:
    target = tmp_path / "out.csv"
    ran("convert", capture(LD06), target, "-s", "ldrobot-ld06")
    frames = json.loads(capture("ldrobot/ld_frames.json").read_text(encoding="utf-8"))
    expected = [frame for frame in frames if frame["name"].startswith("ld06_serialpacketsimulator")]
    angle = np.concatenate([np.linspace(frame["start"], frame["end"], 12) for frame in expected])
    distance, intensity = np.array([point for frame in expected for point in frame["pts"]]).T
    found = read(target)
    assert len(found["x"]) == 36
    np.testing.assert_allclose(found["range"], distance / 1000, rtol=1e-6)
    np.testing.assert_allclose(found["intensity"], intensity)
    np.testing.assert_allclose(found["x"], distance / 1000 * np.cos(np.deg2rad(angle)), atol=1e-5)
    np.testing.assert_allclose(found["y"], -distance / 1000 * np.sin(np.deg2rad(angle)), atol=1e-5)
    assert found["time"].min() == 0
    assert found["time"].max() == pytest.approx(0.005 + 11 / 4500, abs=1e-6)


def test_npz_holds_the_same_columns_and_the_stamps(tmp_path: Path) -> None:
    source = tmp_path / "in.bin"
    source.write_bytes(EXAMPLE * 2)
    for suffix in ("csv", "npz"):
        ran("convert", source, tmp_path / f"out.{suffix}", "-s", "ldrobot-stl27l")
    rows = read(tmp_path / "out.csv")
    with np.load(tmp_path / "out.npz") as arrays:
        assert [name for name in arrays if name in COLUMNS] == COLUMNS
        for name in COLUMNS:
            np.testing.assert_allclose(rows[name], arrays[name], rtol=1e-6, atol=1e-9)
        assert arrays["stamp_ns"].dtype == np.int64
        assert (
            len(arrays["stamp_ns"])
            == len(arrays["complete"])
            == len(arrays["rate_hz"])
            == int(arrays["scan"].max()) + 1
        )


def test_all_keeps_points_without_a_return(tmp_path: Path) -> None:
    target = tmp_path / "out.csv"
    assert (
        run_json("convert", capture(COIN_D4), target, "-s", "cspc-coin-d4", "--all")["points"]
        == 100
    )
    assert np.isinf(read(target)["range"]).sum() == 3
    assert np.isnan(read(target)["x"]).sum() == 3


def test_json_sums_up(tmp_path: Path) -> None:
    found = run_json("convert", capture(COIN_D4), tmp_path / "out.npz", "-s", "cspc-coin-d4")
    assert (found["sensor"], found["points"], found["stats"]["frames"]["data"]) == (
        "cspc-coin-d4",
        97,
        4,
    )
    assert found["stats"]["bytes_in"] == 396


@pytest.mark.slow  # a process, since convert asks for the descriptor of standard input
def test_hexadecimal_text_and_standard_input_are_read(tmp_path: Path) -> None:
    text, target = tmp_path / "in.hex", tmp_path / "out.csv"
    text.write_text("\n".join([EXAMPLE[:20].hex(" "), EXAMPLE[20:].hex(" ")]), encoding="ascii")
    ran("convert", text, target, "-s", "ldrobot-stl27l")
    first = target.read_bytes()
    assert (
        process("convert", "-", target, "--force", "-s", "ldrobot-stl27l", given=EXAMPLE).returncode
        == 0
    )
    assert target.read_bytes() == first
    assert len(read(target)["x"]) == 12


def test_several_sensors_with_the_same_frames_have_to_be_chosen_from(tmp_path: Path) -> None:
    source = tmp_path / "in.bin"
    source.write_bytes(b"".join(simulate(ls.sensor("ydlidar-tmini"), 30)))
    result = ran("convert", source, tmp_path / "out.csv", code=2)
    assert (
        "ydlidar-tmini, ydlidar-tmini-plus, ydlidar-tmini-pro send the same frames" in result.stderr
    )


def test_points_of_a_contradicted_sensor_have_a_warning(tmp_path: Path) -> None:
    (tmp_path / "vlp16.bin").write_bytes(b"".join(simulate(ls.sensor("velodyne-vlp16"), 60)))
    told = ran(
        "convert", tmp_path / "vlp16.bin", tmp_path / "out.csv", "-s", "velodyne-hdl32e"
    ).stderr
    assert (
        "the frames are those of velodyne-vlp16 (the clock advances by 1.33 ms per packet)" in told
    )


def test_every_verb_with_points_warns_of_nominal_angles(tmp_path: Path) -> None:
    path = tmp_path / "xt32.bin"
    path.write_bytes(b"".join(simulate(ls.sensor("hesai-xt32"), 300)))
    picture, table = tmp_path / "out.svg", tmp_path / "out.csv"
    for words in (
        ["convert", path, table],
        ["read", path, "-n", 1],
        ["view", path, "--once"],
        ["plot", path, "-o", picture],
        ["stats", path],
    ):
        assert ran(*words, "-s", "hesai-xt32").stderr.count("-O calibration=FILE") == 1


def test_a_log_without_its_descriptor_is_led_to_the_option_that_reads_it(tmp_path: Path) -> None:
    sensor, log, out = ls.sensor("slamtec-rplidar-a1"), tmp_path / "nodes.bin", tmp_path / "out.csv"
    log.write_bytes(b"".join(simulate(sensor, 900)))
    assert (
        "choose one, such as -s slamtec-rplidar-a1 -O answer=node"
        in ran("convert", log, out, code=2).stderr
    )
    told = ran("convert", log, out, "-s", "slamtec-rplidar-s2", code=4).stderr
    assert "to read the data frames, set answer=node" in told
    following = next(line for line in told.splitlines() if "next: " in line).split(
        "next: lidarspec "
    )[1]
    ran(*following.split())
    assert len(out.read_text().splitlines()) > 700
    assert "-s slamtec-rplidar-a1 -O answer=node" in ran("detect", log).stderr


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["-O", "answer=node"], "requires a sensor: name it with -s"),
        (["-s", "slamtec-rplidar-a1", "-O", "answer"], "expected NAME=VALUE"),
        (["-s", "slamtec-rplidar-a1", "-O", "answr=node"], "answr"),
        (
            ["-s", "slamtec-rplidar-a1", "-O", "mode=7000"],
            "mode must be a number from 0 to 255, not 7000",
        ),
    ],
)
def test_options_of_a_sensor_that_cannot_be(tmp_path: Path, options: list[str], said: str) -> None:
    (tmp_path / "nodes.bin").write_bytes(EXAMPLE)
    for words in (
        ["convert", tmp_path / "nodes.bin", tmp_path / "out.csv"],
        ["read", tmp_path / "nodes.bin"],
        ["parse", tmp_path / "nodes.bin"],
    ):
        assert said in ran(*words, *options, code=2).stderr


def test_scans_can_be_limited(tmp_path: Path) -> None:
    name = "velodyne/vlp16_dual/packets.derived.pcap"
    sensor = ("-s", "velodyne-vlp16")
    whole = run_json("convert", capture(name), tmp_path / "a.npz", *sensor)
    some = run_json("convert", capture(name), tmp_path / "b.npz", "-n", 2, *sensor)
    assert (whole["scans"], some["scans"]) == (5, 2)
    with np.load(tmp_path / "a.npz") as every, np.load(tmp_path / "b.npz") as first:
        np.testing.assert_array_equal(first["x"], every["x"][every["scan"] < 2])


@pytest.mark.parametrize("name", ["in.csv", "link.csv", "same.csv"])
@pytest.mark.parametrize(
    ("words"),
    [
        ("convert", "--force", "IN"),
        ("parse", "IN", "-o"),
        ("explain", "54", "2c", "--diff", "IN", "-o"),
        ("plot", "IN", "-o"),
    ],
)
def test_the_input_is_never_overwritten_by_whatever_name(
    tmp_path: Path, words: tuple[str, ...], name: str
) -> None:
    name = name.replace("csv", "svg") if words[0] == "plot" else name
    source = tmp_path / f"in{name[-4:]}"
    source.write_bytes(EXAMPLE)
    (tmp_path / f"link{name[-4:]}").symlink_to(source)
    os.link(source, tmp_path / f"same{name[-4:]}")
    typed = [source if word == "IN" else word for word in words]
    assert (
        "would be overwritten"
        in ran(*typed, tmp_path / name, "-s", "ldrobot-stl27l", code=2).stderr
    )
    assert source.read_bytes() == EXAMPLE


@pytest.mark.slow
def test_files_of_options_and_standard_input_are_inputs_too(tmp_path: Path) -> None:
    source, angles = tmp_path / "in.bin", tmp_path / "angles.csv"
    source.write_bytes(EXAMPLE)
    angles.write_text(
        "channel,elevation,azimuth\n"
        + "".join(f"{channel},{2 * channel - 17},0\n" for channel in range(1, 17))
    )
    words = (
        "convert",
        source,
        angles,
        "--force",
        "-s",
        "hesai-xt16",
        "-O",
        f"calibration={angles}",
    )
    assert "would be overwritten" in ran(*words, code=2).stderr
    with source.open("rb") as given:
        command = [
            sys.executable,
            "-m",
            "lidarspec",
            "parse",
            "-",
            "-o",
            str(source),
            "-s",
            "ldrobot-stl27l",
        ]
        done = subprocess.run(command, stdin=given, capture_output=True, check=False)
    assert (done.returncode, b"is standard input, and would be overwritten" in done.stderr) == (
        2,
        True,
    )
    assert source.read_bytes() == EXAMPLE


@pytest.mark.parametrize("suffix", ["csv", "npz"])
def test_a_file_is_overwritten_only_with_force(tmp_path: Path, suffix: str) -> None:
    source, target = tmp_path / "in.bin", tmp_path / f"out.{suffix}"
    source.write_bytes(EXAMPLE)
    target.write_bytes(b"a week of work")
    said = ran("convert", source, target, "-s", "ldrobot-stl27l", code=2).stderr
    assert f"{target} exists already" in said
    assert "--force" in said
    assert target.read_bytes() == b"a week of work"
    ran("convert", source, target, "--force", "-s", "ldrobot-stl27l")
    assert target.stat().st_size > 100


def test_files_for_each_scan_are_overwritten_only_with_force(tmp_path: Path) -> None:
    source, target = tmp_path / "00001.bin", tmp_path / "%05d.bin"
    source.write_bytes(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 300)))
    before = source.read_bytes()
    assert (
        f"{source} is the input, and would be overwritten"
        in ran("convert", "--force", source, target, "-s", "ldrobot-stl27l", code=2).stderr
    )
    assert source.read_bytes() == before
    ran("convert", source, tmp_path / "points" / "%05d.bin", "-s", "ldrobot-stl27l")
    files = sorted((tmp_path / "points").iterdir())
    assert [file.name for file in files] == ["00000.bin", "00001.bin"]
    files[0].unlink()
    said = ran(
        "convert", source, tmp_path / "points" / "%05d.bin", "-s", "ldrobot-stl27l", code=2
    ).stderr
    assert f"{files[1]} exists already" in said
    ran("convert", source, tmp_path / "points" / "%05d.bin", "--force", "-s", "ldrobot-stl27l")
    assert files[0].exists()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo terminals")
def test_a_terminal_shows_how_far_it_is(tmp_path: Path) -> None:
    from tests.view.terminal import Terminal

    (tmp_path / "drive.bin").write_bytes(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 900)))
    for more in ((), ("-q", "--force")):
        with Terminal(
            "convert", "drive.bin", "out.npz", "-s", "ldrobot-stl27l", *more, cwd=tmp_path
        ) as terminal:
            assert terminal.wait_until_end() == 0
            shown = terminal.text()
        assert bool(
            re.search(r"out\.npz: \d+ points of 1 scan .*\d+%.*\d:\d|--:--", terminal.raw)
        ) is not bool(more)
        assert "%" not in shown
        assert ("out.npz: 10800 points of" in shown) is not bool(more)


def test_reading_a_stored_file_reports_progress(tmp_path: Path) -> None:
    plain, packed = tmp_path / "drive.bin", tmp_path / "drive.bin.gz"
    plain.write_bytes(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 900)))
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    for path in (plain, packed):
        with ls.open(path, "ldrobot-stl27l") as device:
            assert device.progress is not None
            assert device.progress[1] == path.stat().st_size
            assert list(device.scans())
            assert device.progress == (path.stat().st_size, path.stat().st_size)
    with ls.open("sim:ldrobot-stl27l", "ldrobot-stl27l") as device:
        assert device.progress is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["velodyne-vlp16", "ldrobot-stl27l"])
def test_packets_go_from_container_to_container_as_they_are(name: str, tmp_path: Path) -> None:
    files = [tmp_path / f"drive.{suffix}" for suffix in ("pcap", "pcapng", "lsr", "pcap.pcap")]
    ran("sim", name, "--to", files[0], "-t", "300ms")
    for one, other in itertools.pairwise(files):
        assert f"{other}: " in ran("convert", one, other).stderr
    for file in files[1:]:
        with (
            contextlib.closing(open_transport(files[0])) as before,
            contextlib.closing(open_transport(file)) as after,
        ):
            assert list(after.chunks()) == list(before.chunks())
    assert files[3].read_bytes() == files[0].read_bytes()
    part = tmp_path / "part.pcapng"
    told = run_json("convert", files[2], part, "--slice", "100ms:200ms", "-s", name)
    assert told["packets"] < run_json("info", files[0])["packets"] / 2
    with contextlib.closing(open_transport(part)) as opened:
        times = [chunk.at or 0 for chunk in opened.chunks()]
    assert len(times) == told["packets"]
    assert 0 <= min(times) - run_json("info", files[0])["first_ns"] - 100_000_000 < 20_000_000
    assert max(times) - min(times) < 100_000_000


def test_packet_files_need_a_packet_source(tmp_path: Path) -> None:
    ran("sim", "ldrobot-stl27l", "--to", tmp_path / "drive.lsr", "-t", "100ms")
    out = tmp_path / "out.pcapng"
    assert (
        "selected only by --slice"
        in ran("convert", tmp_path / "drive.lsr", out, "--scans", "1:2", code=2).stderr
    )
    assert (
        f"lidarspec record sim:ldrobot-stl27l -o {out}"
        in ran("convert", "sim:ldrobot-stl27l", out, code=2).stderr
    )
    (tmp_path / "empty.pcap").write_bytes(WRITINGS[".pcap"].head(1))
    assert "without packets" in ran("convert", tmp_path / "empty.pcap", out, code=4).stderr
    assert not out.exists()
    assert not [file for file in tmp_path.iterdir() if file.name.startswith(".")]


def test_verbose_and_quiet_output(tmp_path: Path) -> None:
    path = tmp_path / "drive.bin"
    path.write_bytes(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 900)))
    words = ["convert", path, tmp_path / "out.npz", "-s", "ldrobot-stl27l", "--force"]
    assert re.search(r"10800 points .*\n[\d.]+ s, \d+ MB of memory\n", ran(*words, "-v").stderr)
    assert ran(*words, "-q").stderr == ""
    assert "points of" in ran(*words).stderr
    assert (
        "no/out.npz: folder"
        in ran(
            "convert", path, tmp_path / "no" / "out.npz", "-s", "ldrobot-stl27l", "-q", code=3
        ).stderr
    )


def test_further_columns_are_written_and_printed_with_their_units(tmp_path: Path) -> None:
    bytes_ = tmp_path / "in.bin"
    target = tmp_path / "out.csv"
    bytes_.write_bytes(b"".join(simulate(SHAPES["shape-extras"], 60)))
    told = ran("convert", bytes_, target, "-s", EXTRAS).stderr
    assert "that not every sensor has: velocity [m/s], near_ir, signal [photons]" in told
    assert set(read(target)["signal"]) == {2**24 + 1 + number for number in range(4)}
    assert (
        run_json("convert", bytes_, target, "-s", EXTRAS, "--force")["units"]["velocity"] == "m/s"
    )
    assert "velocity [m/s]" in ran("read", bytes_, "-s", EXTRAS, "-n", 1).stdout
    assert (
        "colours: velocity 0 to 0.001 m/s"
        in ran("view", bytes_, "-s", EXTRAS, "--once", "--colour", "velocity").stdout
    )
    assert (
        "did you mean 'velocity'"
        in ran("view", bytes_, "-s", EXTRAS, "--once", "--colour", "velocty", code=2).stderr
    )


def test_imu_samples_are_written_instead_of_points(tmp_path: Path) -> None:
    bytes_ = tmp_path / "in.bin"
    sensor = SHAPES["shape-inertia"]
    bytes_.write_bytes(b"".join(simulate(sensor, 40)))
    told = ran("convert", bytes_, tmp_path / "imu.csv", "-s", INERTIA, "--imu").stderr
    assert "120 IMU samples from shape-inertia" in told
    rows = read(tmp_path / "imu.csv")
    assert next(iter(rows)) == "time_ns"
    np.testing.assert_allclose(rows["linear_acceleration_z"], 9.80665)
    assert (
        run_json("convert", bytes_, tmp_path / "imu.npz", "-s", INERTIA, "--imu", "-n", 10)[
            "samples"
        ]
        == 10
    )
    with np.load(tmp_path / "imu.npz") as arrays:
        assert arrays["time_ns"].tolist() == rows["time_ns"][:10].tolist()
    assert (
        "unknown format '.pcd' (known: .csv, .npz)"
        in ran("convert", bytes_, tmp_path / "imu.pcd", "-s", INERTIA, "--imu", code=2).stderr
    )
    assert (
        "no frame type contains IMU samples"
        in ran(
            "convert", capture(COIN_D4), tmp_path / "b.csv", "-s", "cspc-coin-d4", "--imu", code=2
        ).stderr
    )


def test_reading_ends_after_the_requested_imu_samples(tmp_path: Path) -> None:
    bytes_ = tmp_path / "in.bin"
    bytes_.write_bytes(b"".join(simulate(SHAPES["shape-inertia"], 40)) * 2000)
    summary = run_json("convert", bytes_, tmp_path / "imu.csv", "-s", INERTIA, "--imu", "-n", 10)
    assert summary["samples"] == 10
    assert summary["stats"]["bytes_in"] < bytes_.stat().st_size


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--scans", ":1"), "IMU samples can be selected only by -n, --slice and --time"),
        (("--range", "1m:2m"), "IMU samples can be selected only by -n, --slice and --time"),
        (("--returns", "last"), "IMU samples can be selected only by -n, --slice and --time"),
        (("-f", "data"), "--imu cannot be combined with -f"),
    ],
)
def test_options_for_scans_are_refused_for_imu_samples(
    words: tuple[str, ...], reason: str, tmp_path: Path
) -> None:
    bytes_ = tmp_path / "in.bin"
    bytes_.write_bytes(b"".join(simulate(SHAPES["shape-inertia"], 40)))
    target = tmp_path / "imu.csv"
    error = ran("convert", bytes_, target, "-s", INERTIA, "--imu", *words, code=2).stderr
    assert reason in error
    assert not target.exists()


def test_a_slice_without_imu_samples_states_the_times_of_the_file(tmp_path: Path) -> None:
    bytes_ = tmp_path / "in.bin"
    bytes_.write_bytes(b"".join(simulate(SHAPES["shape-inertia"], 40)))
    words = ("convert", bytes_, tmp_path / "out.csv", "-s", INERTIA, "--slice", "100:200")
    for chosen in (("--imu",), ("-f", "data")):
        error = ran(*words, *chosen, code=2).stderr
        assert "in.bin has frames from 0 s to" in error
        assert "the selection is outside this range" in error


def test_imu_samples_with_and_without_a_clock_are_not_mixed(tmp_path: Path) -> None:
    plugin = tmp_path / "two.py"
    plugin.write_text(
        """
from dataclasses import replace
from lidarspec.spec import Frame, hookimpl
from tests.shapes.inertia import DATA, SENSOR, beside

FRAMES = {"fast": SENSOR.frames["imu"], "slow": Frame(DATA, imu=beside)}
NOTHING = dict(points=None, scan=None, clock=None, sequence=None)
TWO = replace(SENSOR, id="two-imus", frames=FRAMES, **NOTHING)

@hookimpl
def lidarspec_sensors():
    return [TWO]
"""
    )
    sensor = SHAPES["shape-inertia"]
    recording = tmp_path / "drive.lsr"
    with ls.Recorder(recording, sensor) as recorder:
        for number, data in enumerate((*simulate(sensor, 4), sensor.example("imu"))):
            recorder.write(Chunk(data, 1_785_283_200 * 10**9 + number))
    words = ("convert", recording, tmp_path / "imu.csv", "-s", plugin, "--imu")
    refused = ran(*words, code=2).stderr
    assert "fast frames have the sensor's time, but those of slow frames do not" in refused
    assert "next: repeat with --time host" in refused
    assert "13 IMU samples" in ran(*words, "--time", "host").stderr


def test_imu_samples_have_the_times_of_the_selected_clock(tmp_path: Path) -> None:
    """The clock of the shape counts from power-up, and every second frame is late.

    The UTC of a sample is the time at which it would have arrived without delay.
    """
    sensor = SHAPES["shape-inertia"]
    recording = tmp_path / "drive.lsr"
    began_ns = 1_785_283_200 * 10**9
    frames = simulate(sensor, 400)
    times_ns = sensor.decode(frames).time_ns
    with ls.Recorder(recording, sensor) as recorder:
        for number, (data, time_ns) in enumerate(zip(frames, times_ns.tolist(), strict=True)):
            delay_ns = 1_000_000 * (number % 2)
            recorder.write(Chunk(data, began_ns + time_ns + delay_ns))
    found = {}
    for time in ("sensor", "host", "utc"):
        target = tmp_path / f"{time}.csv"
        ran("convert", recording, target, "-s", INERTIA, "--imu", "--time", time)
        with target.open(encoding="ascii", newline="") as file:
            found[time] = np.array([int(row["time_ns"]) for row in csv.DictReader(file)])
    late_ns = np.repeat(np.arange(400) % 2 * 1_000_000, 3)
    np.testing.assert_array_equal(found["host"], began_ns + found["sensor"] + late_ns)
    np.testing.assert_allclose(found["utc"] - began_ns - found["sensor"], 0, atol=10_000)
    bytes_ = tmp_path / "in.bin"
    bytes_.write_bytes(b"".join(frames))
    for time in ("host", "utc"):
        target = tmp_path / "none.csv"
        failed = ran("convert", bytes_, target, "-s", INERTIA, "--imu", "--time", time, code=2)
        assert "no arrival times" in failed.stderr
        assert "next: repeat with --time sensor" in failed.stderr


@pytest.mark.parametrize("suffix", [".lsr", ".pcap", ".pcapng"])
def test_full_disk_names_the_output_and_leaves_nothing(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def append(self: RecordingFile, records: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    (path := tmp_path / "in.bin").write_bytes(EXAMPLE * 3)
    target = tmp_path / f"out{suffix}"
    monkeypatch.setattr(RecordingFile, "append", append)
    failed = ran("convert", path, target, "-s", "ldrobot-stl27l", code=3)
    assert failed.stderr.startswith(f"{target}: No space left on device; nothing was written\n")
    assert os.listdir(tmp_path) == ["in.bin"]
