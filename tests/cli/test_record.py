"""Tests of `record` and `replay`: real ports, Ctrl-C, full disks, existing files."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.recording.format import Recording
from lidarspec.recording.recorders import Recorder
from lidarspec.spec import Chunk
from tests.cli.running import ran, run_json
from tests.lines import SLACK, port

STREAM, DATAGRAMS = "ldrobot-stl27l", "velodyne-vlp16"
posix = pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo terminals")


def frames(sensor: str, number: int) -> list[bytes]:
    return [ls.sensor(sensor).example("data", seed=seed) for seed in range(number)]


@pytest.fixture
def stream(tmp_path: Path) -> Path:
    """Return a recording of 40 frames in 0.2 s."""
    path = tmp_path / "stream.lsr"
    with Recorder(path, STREAM, "serial:///dev/ttyUSB0", baud=921600) as kept:
        for number, frame in enumerate(frames(STREAM, 40)):
            kept.write(Chunk(frame, 10**18 + number * 5_000_000))
    return path


@pytest.fixture
def datagrams(tmp_path: Path) -> Path:
    """Return a recording of 30 datagrams in 0.15 s."""
    path = tmp_path / "datagrams.lsr"
    some = frames(DATAGRAMS, 3)
    with Recorder(path, DATAGRAMS, "udp://") as kept:
        for number in range(30):
            kept.write(
                Chunk(
                    some[number % 3],
                    10**18 + number * 5_000_000,
                    ("10.0.0.1", 2368),
                    ("10.0.0.2", 2368),
                )
            )
    return path


class Running:
    """A verb that runs in a separate process."""

    def __init__(self, *words: object, folder: Path) -> None:
        command = [sys.executable, "-m", "lidarspec", *map(str, words)]
        self._said, self._lines = "", threading.Condition()
        self.child = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=folder, text=True
        )
        self._listener = threading.Thread(target=self._listen)
        self._listener.start()

    def _listen(self) -> None:
        assert self.child.stderr is not None
        for line in self.child.stderr:
            with self._lines:
                self._said += line
                self._lines.notify_all()

    def hears(self, pattern: str) -> re.Match[str]:
        """Wait for a line that matches the pattern; return the match."""
        with self._lines:
            assert self._lines.wait_for(lambda: re.search(pattern, self._said), 60), self._said
            found = re.search(pattern, self._said)
        assert found is not None
        return found

    def wait_until_end(self, code: int) -> str:
        """Return the output until the end; the process must exit with this code."""
        self.child.wait(60)
        self._listener.join()
        assert self.child.stdout is not None
        output = self.child.stdout.read()
        self.child.stdout.close()
        assert self.child.stderr is not None
        self.child.stderr.close()
        assert self.child.returncode == code, self._said
        assert "Traceback" not in self._said
        return self._said + output


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Callable[..., Running]]:
    """Yield a function that starts verbs; end the running ones after the test."""
    made: list[Running] = []

    def start(*words: object) -> Running:
        made.append(Running(*words, folder=tmp_path))
        return made[-1]

    yield start
    for running in made:
        if running.child.poll() is None:
            running.child.kill()
            running.wait_until_end(-signal.SIGKILL)


def read_received(path: Path) -> bytes:
    with Recording(path) as recording:
        return b"".join(item.data for item in recording if item.direction == "in")


def test_a_simulated_sensor_is_known_and_started(tmp_path: Path) -> None:
    """The sensor sends no data before it is started."""
    target = tmp_path / "a.lsr"
    result = run_json("record", "sim:slamtec-rplidar-a1?rate=4", "-o", target, "-n", 20)
    assert result["sensor"] == "slamtec-rplidar-a1"
    assert result["packets"] >= 20
    assert run_json("stats", target)["packets"] >= 20


def test_no_start_sends_nothing_to_a_simulated_sensor(tmp_path: Path) -> None:
    ran(
        "record",
        "sim:slamtec-rplidar-a1",
        "-o",
        tmp_path / "a.lsr",
        "-t",
        "0.2",
        "--no-start",
        code=5,
    )


@pytest.mark.slow
@posix
def test_recorded_replayed_and_recorded_again_it_is_the_same(
    stream: Path, tmp_path: Path, started: Callable[..., Running]
) -> None:
    player = started("replay", stream, "--json")
    place = player.hears(r"replaying \S+ to (/dev/\S+) when")[1]
    assert player.hears("next: (.*)")[1] == f"lidarspec view {place} -s {STREAM}"
    again = tmp_path / "again.lsr"
    ran("record", place, "-s", STREAM, "-o", again, "-n", 40)
    assert player.wait_until_end(0)
    assert (
        hashlib.sha256(read_received(again)).hexdigest()
        == hashlib.sha256(read_received(stream)).hexdigest()
    )
    with Recording(again) as recording:
        assert (recording.header.sensor, recording.header.source, recording.header.baud) == (
            STREAM,
            place,
            921600,
        )
        times = [item.at for item in recording if item.direction == "in" and item.at]
    # The stream lasts 0.2 s. The first frames may wait for a busy reader.
    assert 0.1 < (times[-1] - times[0]) / 1e9 < 0.2 * SLACK
    with ls.open(stream) as one, ls.open(again) as other:
        assert [p.raw.tobytes() for p in one.packets()] == [
            p.raw.tobytes() for p in other.packets()
        ]


@pytest.mark.slow
def test_datagrams_recorded_from_a_socket_as_capture_and_recording(
    datagrams: Path, tmp_path: Path, started: Callable[..., Running]
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        place = f"udp://127.0.0.1:{free.getsockname()[1]}"
    for name in ("again.pcap", "again.lsr"):
        taker = started("record", place, "-s", DATAGRAMS, "-o", name, "-n", 30)
        taker.hears("no data received")
        ran("replay", datagrams, "--to", place)
        assert "30 packets, 30 records" in taker.wait_until_end(0)
        with ls.open(datagrams) as one, ls.open(tmp_path / name, DATAGRAMS) as other:
            before, after = (
                b"".join(p.raw.tobytes() for p in device.packets()) for device in (one, other)
            )
        assert before == after


@pytest.mark.slow
@posix
def test_ctrl_c_ends_a_recording_properly(tmp_path: Path, started: Callable[..., Running]) -> None:
    data = b"".join(frames(STREAM, 20))
    with port(tmp_path) as line:
        taker = started("record", line.name, "-s", STREAM, "-o", "it.lsr")
        deadline = time.monotonic() + 60
        while not (tmp_path / "it.lsr").exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        line.send(data)
        while received_so_far(tmp_path / "it.lsr") < len(data) and time.monotonic() < deadline:
            time.sleep(0.02)
        taker.child.send_signal(signal.SIGINT)
        said = taker.wait_until_end(130)
    assert "20 packets" in said
    assert "next: lidarspec view it.lsr" in said
    assert read_received(tmp_path / "it.lsr") == data


def received_so_far(path: Path) -> int:
    try:
        return len(read_received(path))
    except ls.LidarSpecError:
        return 0


@pytest.mark.slow
@posix
def test_without_a_sensor_bytes_are_recorded_as_they_come(
    tmp_path: Path, started: Callable[..., Running]
) -> None:
    with port(tmp_path) as line:
        taker = started("record", f"{line.name}?baud=115200", "-o", "raw.lsr", "-t", "1s")
        deadline = time.monotonic() + 60
        while not (tmp_path / "raw.lsr").exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        time.sleep(0.2)
        line.send(b"what nobody knows")
        assert "next: lidarspec detect raw.lsr" in taker.wait_until_end(0)
    assert read_received(tmp_path / "raw.lsr") == b"what nobody knows"
    with Recording(tmp_path / "raw.lsr") as recording:
        assert (recording.header.sensor, recording.header.baud) == ("", 115200)


def test_captures_become_recordings_and_back(datagrams: Path, tmp_path: Path) -> None:
    capture, back = tmp_path / "it.pcap", tmp_path / "back.lsr"
    assert run_json("record", datagrams, "-o", capture)["packets"] == 30
    assert run_json("record", capture, "-s", DATAGRAMS, "-o", back)["bytes"] == 30 * 1206
    assert read_received(back) == read_received(datagrams)
    assert run_json("record", datagrams, "-o", tmp_path / "part.lsr", "-n", 7)["records"] == 7
    assert (
        run_json("record", datagrams, "-o", tmp_path / "begin.lsr", "-t", "50ms")["records"] == 10
    )


def test_the_bytes_of_a_stream_can_be_taken_out(stream: Path, tmp_path: Path) -> None:
    ran("record", stream, "-o", tmp_path / "it.bin")
    assert (tmp_path / "it.bin").read_bytes() == read_received(stream)


def test_standard_input_gets_the_times_of_its_arrival(tmp_path: Path) -> None:
    before = time.time_ns()
    ran("record", "-", "-o", tmp_path / "it.lsr", given=b"abc")
    with Recording(tmp_path / "it.lsr") as recording:
        assert [(item.data, before <= (item.at or 0) <= time.time_ns()) for item in recording] == [
            (b"abc", True)
        ]


def test_damaged_recordings_are_salvaged(stream: Path, tmp_path: Path) -> None:
    whole = bytearray(stream.read_bytes())
    whole[len(whole) // 2] ^= 1
    stream.write_bytes(whole)
    said = ran("record", stream, "-o", tmp_path / "stopped.lsr", code=1).stderr
    assert "corrupt at byte" in said
    assert f"next: lidarspec record {stream} --salvage" in said
    assert (
        "corrupt in 1 place"
        in ran("record", stream, "--salvage", "-o", tmp_path / "mended.lsr", code=1).stderr
    )
    with ls.open(tmp_path / "mended.lsr") as device:
        assert sum(len(packets) for packets in device.packets()) == 39


@pytest.mark.parametrize(
    "words",
    [
        ("info", "FILE"),
        ("parse", "FILE", "-s", STREAM),
        ("explain", "FILE", "-s", STREAM, "--bad"),
        ("record", "FILE", "-o", "NEW"),
        ("replay", "FILE", "--to", "NEW"),
        ("convert", "FILE", "NEW"),
        ("convert", "FILE", "FOLDER", "--to", "csv"),
        ("stats", "FILE"),
    ],
    ids=" ".join,
)
def test_every_verb_reports_a_damaged_recording(
    stream: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    paths = {"FILE": stream, "NEW": tmp_path / "new.lsr", "FOLDER": tmp_path / "new"}
    whole = bytearray(stream.read_bytes())
    whole[len(whole) // 2] ^= 1
    stream.write_bytes(whole)
    said = ran(*(paths.get(word, word) for word in words), code=1).stderr
    assert len(re.findall("corrupt.*bytes were not read", said)) == 1
    stream.write_bytes(whole[: len(whole) // 2])  # truncated: nothing after it is lost
    ran(*(paths.get(word, word) for word in words), *["--force"] * ("NEW" in words))


def test_an_old_recording_survives_a_silent_source(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        source = f"udp://127.0.0.1:{free.getsockname()[1]}"
    target = tmp_path / "it.lsr"
    target.write_bytes(b"precious")
    said = ran("record", source, "-o", target, "--force", "-t", "0.2s", code=5).stderr
    assert f"{target} was not changed\n{source} sent nothing" in said
    assert (target.read_bytes(), list(tmp_path.iterdir())) == (b"precious", [target])


@pytest.mark.parametrize("verb", [("record", "-o"), ("replay", "--to")])
def test_nothing_is_overwritten_without_force(
    stream: Path, tmp_path: Path, verb: tuple[str, str]
) -> None:
    target = tmp_path / "it.lsr"
    target.write_bytes(b"precious")
    result = ran(verb[0], stream, verb[1], target, code=2)
    assert "already exists" in result.stderr
    assert "--force" in result.stderr
    assert target.read_bytes() == b"precious"
    ran(verb[0], stream, verb[1], target, "--force")
    assert read_received(target) == read_received(stream)
    assert "would be overwritten" in ran(verb[0], target, verb[1], target, "--force", code=2).stderr
    assert read_received(target) == read_received(stream)


def test_unrecordable_sources_give_a_reason(stream: Path, datagrams: Path, tmp_path: Path) -> None:
    ran("record", stream, "-o", tmp_path / "raw.bin")
    assert (
        "byte stream"
        in ran("record", tmp_path / "raw.bin", "-o", tmp_path / "it.pcap", code=2).stderr
    )
    assert (
        "cannot separate datagrams"
        in ran("record", datagrams, "-o", tmp_path / "it.bin", code=2).stderr
    )
    assert (
        "unknown format '.csv'" in ran("record", stream, "-o", tmp_path / "it.csv", code=2).stderr
    )
    assert (
        "-n counts packets"
        in ran("record", stream, "-o", tmp_path / "it.lsr", "-n", 3, code=2).stderr
    )
    assert (
        "No such file"
        in ran("record", tmp_path / "nowhere.lsr", "-o", tmp_path / "it.lsr", code=3).stderr
    )
    assert (
        "next: lidarspec"
        in ran("record", "/dev/ttyNONE", "-s", STREAM, "-o", tmp_path / "it.lsr", code=3).stderr
    )
    assert not (tmp_path / "it.lsr").exists()
    (tmp_path / "empty.bin").touch()
    with Recorder(tmp_path / "sent.lsr") as recorder:
        recorder.write(Chunk(b"\x01"), "out")
    for name in ("empty.bin", "sent.lsr"):
        assert (
            "contains no data from a sensor"
            in ran("record", tmp_path / name, "-o", tmp_path / "it.lsr", code=4).stderr
        )
        assert not (tmp_path / "it.lsr").exists()


def test_a_silent_source_leaves_no_empty_file(tmp_path: Path) -> None:
    assert (
        "sent nothing"
        in ran(
            "record", "udp://127.0.0.1:45671", "-t", "0.2", "-o", tmp_path / "it.lsr", code=5
        ).stderr
    )
    assert not (tmp_path / "it.lsr").exists()


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root may mount a small disk"
)
def test_a_full_disk_ends_it_with_one_line_and_a_whole_file(tmp_path: Path, stream: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", disk], capture_output=True, check=False
    )
    if made.returncode:
        pytest.skip(f"no disk can be mounted here: {made.stderr.decode().strip()}")
    try:
        shutil.copy(stream, tmp_path / "long.bin")
        with open(tmp_path / "long.bin", "wb") as file:
            file.write(read_received(stream) * 100)
        result = ran("record", tmp_path / "long.bin", "-s", STREAM, "-o", disk / "it.lsr", code=3)
        assert re.fullmatch(
            r".*No space left on device; the recording is complete up to byte \d+\n  next: .*\n",
            result.stderr,
        ), result.stderr
        with Recording(disk / "it.lsr") as recording:
            list(recording)
            assert recording.leftover == 0
    finally:
        subprocess.run(["umount", "-l", disk], check=True)


def test_impossible_replays_give_a_reason(stream: Path, datagrams: Path, tmp_path: Path) -> None:
    assert (
        "the recording contains datagrams" in ran("replay", datagrams, "--to", "pty", code=2).stderr
    )
    assert (
        "the recording contains a byte stream"
        in ran("replay", stream, "--to", "udp://127.0.0.1:9", code=2).stderr
    )
    assert "is a live source" in ran("replay", "udp://:2368", code=2).stderr
    assert "expected a speed" in ran("replay", stream, "--speed", "0", code=2).stderr
    assert (
        "requires a port or socket"
        in ran("replay", stream, "--to", tmp_path / "it.lsr", "--loop", code=2).stderr
    )
    raw = tmp_path / "it.bin"
    raw.write_bytes(read_received(stream))
    assert (
        "has no arrival times"
        in ran("replay", raw, "--speed", "1", "--to", tmp_path / "it.lsr", code=2).stderr
    )


def test_a_replay_to_the_recorded_ports_suggests_a_valid_source(
    datagrams: Path, tmp_path: Path
) -> None:
    capture = tmp_path / "it.pcap"
    ran("replay", datagrams, "--to", capture)
    udp = ("--to", "udp://127.0.0.1", "--speed", "max")
    assert ran("replay", capture, *udp).stderr.count("next: lidarspec detect\n") == 1
    said = ran("replay", capture, *udp, "-s", DATAGRAMS).stderr
    assert f"next: lidarspec view udp:// -s {DATAGRAMS}\n" in said


def test_a_replay_of_nothing_does_not_wait_for_a_reader(stream: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty.bin"
    empty.touch()
    for target in ("tcp://127.0.0.1:0", tmp_path / "it.lsr"):
        said = ran("replay", empty, "--to", target, code=4).stderr
        assert f"{empty} contains no bytes\n  next: lidarspec info {empty}\n" in said
    slicing = ("--slice", "100s:101s")
    assert "outside" in ran("replay", stream, "--to", "tcp://127.0.0.1:0", *slicing, code=2).stderr


@pytest.mark.parametrize("suffix", [".lsr", ".pcap"])
def test_a_failed_replay_leaves_no_file(datagrams: Path, tmp_path: Path, suffix: str) -> None:
    target = tmp_path / f"it{suffix}"
    ran("replay", datagrams, "--to", target, "--slice", "100s:101s", code=2)
    assert not target.exists()
    target.write_bytes(b"precious")
    ran("replay", datagrams, "--to", target, "--slice", "100s:101s", "--force", code=2)
    assert target.read_bytes() == b"precious"


def test_a_replay_sums_up_with_a_digest(datagrams: Path) -> None:
    found = json.loads(
        ran("replay", datagrams, "--to", "udp://127.0.0.1:45672", "--speed", "10x", "--json").stdout
    )
    assert (found["chunks"], found["bytes"], found["sha256"]) == (
        30,
        36180,
        hashlib.sha256(read_received(datagrams)).hexdigest(),
    )


@pytest.mark.slow
@posix
def test_a_loop_serves_one_reader_after_another_until_ctrl_c(
    stream: Path, tmp_path: Path, started: Callable[..., Running]
) -> None:
    player = started("replay", stream, "--loop")
    place = player.hears(r"replaying \S+ to (/dev/\S+) when")[1]
    for number, name in enumerate(("one.lsr", "two.lsr"), start=1):
        ran("record", place, "-s", STREAM, "-o", tmp_path / name, "-n", 60)
        assert read_received(tmp_path / name).startswith(read_received(stream))
        player.hears(f"(?s)(the reader has disconnected.*){{{number}}}")
    player.child.send_signal(signal.SIGINT)
    assert "stream.lsr to /dev/" in player.wait_until_end(130)


def test_a_replay_prints_its_destination_on_standard_output(datagrams: Path) -> None:
    done = ran("replay", datagrams, "--to", "udp://127.0.0.1:45672", "--speed", "10x")
    assert done.stdout == "udp://127.0.0.1:45672\n"
