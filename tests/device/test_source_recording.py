"""Tests of recording a source while it is decoded.

Other senders and a failing plugin lose no record.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.captures.pcap import CaptureReader
from lidarspec.device.capture_thread import BoundedQueue, CaptureThread
from lidarspec.device.source_recording import LimitedRecorder, SourceRecording
from lidarspec.recording.format import Recording
from lidarspec.recording.recorders import Recorder, open_recorder
from lidarspec.spec import Fields
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.open_url import open_live
from lidarspec.transports.protocol import Chunk
from tests.lines import free_port, send_paced, turning, udp, until, working
from tests.shapes import SHAPES


def fails(f: Fields) -> object:
    raise SystemExit("nothing that a plugin should do")


def test_recording_is_independent_of_decoding_and_senders(tmp_path: Path) -> None:
    good, number, path = SHAPES["shape-datagrams"], free_port(), tmp_path / "all.lsr"
    frames = {**good.frames, "data": replace(good.frames["data"], plausible=fails)}
    task = SourceRecording(f"udp://:{number}", str(path), replace(good, frames=frames))
    said, sent = "", turning(good, 50)
    with (
        udp("127.0.0.2") as own,
        udp("127.0.0.3") as other,
        contextlib.closing(task.run()) as running,
    ):
        said += next(running)
        for frame in sent:
            own.sendto(frame, ("127.0.0.1", number))
            other.sendto(frame, ("127.0.0.1", number))
        for remark in running:
            said += remark
            if task.recorder is not None and task.recorder.records >= 100:
                break
        said += next(running)
    assert (
        said.count(
            "decoding failed (SystemExit: nothing that a plugin should do); the recording continues"
        )
        == 1
    )
    with Recording(path) as recording:
        kept = [
            record.data
            for record in recording
            if record.sender is not None and record.sender[0] == "127.0.0.2"
        ]
    assert kept == sent


@pytest.mark.parametrize("knows", [True, False])
def test_a_recording_ends_in_time_and_reports_its_content(tmp_path: Path, knows: bool) -> None:
    sensor, number, path = SHAPES["shape-datagrams"], free_port(), tmp_path / "all.lsr"
    frames = turning(sensor, 50)
    task = SourceRecording(f"udp://:{number}", str(path), sensor if knows else None, seconds=0.3)
    with (
        udp() as sender,
        working(
            lambda stop: send_paced(
                lambda data: sender.sendto(data, ("127.0.0.1", number)), frames, 500, stop
            )
        ),
    ):
        for _ in task.run():
            pass
    with Recording(path) as recording:
        times = [record.at for record in recording if record.direction == "in" and record.data]
    assert task.packets == len(times) > 0
    assert task.elapsed == (times[-1] - times[0]) / 1e9 < 0.3


@pytest.mark.parametrize("seconds", [None, 1.0])
def test_the_duration_of_a_copy_is_that_of_its_arrivals(
    tmp_path: Path, seconds: float | None
) -> None:
    sensor = SHAPES["shape-datagrams"]
    with Recorder(tmp_path / "all.lsr", sensor) as recorder:
        for number, frame in enumerate(turning(sensor, 8)):
            recorder.write(Chunk(frame, 10**18 + number * 250_000_000))
    task = SourceRecording(
        str(tmp_path / "all.lsr"), str(tmp_path / "copy.lsr"), sensor, seconds=seconds
    )
    assert list(task.run())
    assert task.packets == (8 if seconds is None else 4)
    assert task.elapsed == (task.packets - 1) / 4


@pytest.mark.parametrize("at", [None, 10**18 + 1])
def test_an_ended_recording_ignores_arrivals(tmp_path: Path, at: int | None) -> None:
    writer = open_recorder(tmp_path / "ended.lsr", datagrams=True)
    with contextlib.closing(LimitedRecorder(writer, None)) as log:
        log.write(Chunk(b"before", 10**18))
        log.end()
        log.write(Chunk(b"after", at))
        log.write(Chunk(b"command", at), "out")
    with Recording(tmp_path / "ended.lsr") as recording:
        assert [record.data for record in recording] == [b"before", b"command"]


def test_other_senders_are_reported_once_while_recording(tmp_path: Path) -> None:
    sensor, number, path = SHAPES["shape-datagrams"], free_port(), tmp_path / "all.lsr"
    task, said = SourceRecording(f"udp://:{number}", str(path), sensor, count=60), list[str]()
    with (
        udp("127.0.0.2") as own,
        udp("127.0.0.3") as other,
        contextlib.closing(task.run()) as running,
    ):
        said.append(next(running))
        for frame in turning(sensor, 60):
            own.sendto(frame, ("127.0.0.1", number))
            said.append(next(running))
            other.sendto(frame, ("127.0.0.1", number))
        said += running
    assert "\n".join(said).count("and ignoring data from") == 1


def test_a_sensor_that_sends_over_ipv6_is_recorded_for_wireshark(tmp_path: Path) -> None:
    sensor, path = SHAPES["shape-datagrams"], tmp_path / "six.pcap"
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sender:
        try:
            sender.bind(("::1", 0))
        except OSError:
            pytest.skip("this system has no IPv6")
        number, sent = free_port(), turning(sensor, 20)
        with contextlib.closing(
            SourceRecording(f"udp://[::1]:{number}", str(path), sensor, count=20).run()
        ) as running:
            next(running)
            for frame in sent:
                sender.sendto(frame, ("::1", number))
            list(running)
        assert [datagram.data for datagram in CaptureReader(path)] == sent
        assert {datagram.source for datagram in CaptureReader(path)} == {sender.getsockname()[:2]}


def test_a_clock_change_changes_no_time_and_is_recorded(tmp_path: Path) -> None:
    path, number, wall = tmp_path / "all.lsr", free_port(), [0]
    sensor, warnings = SHAPES["shape-datagrams"], list[list[str]]()
    frames, queue = turning(sensor, 5), BoundedQueue()
    with udp() as sender, Recorder(path, sensor) as kept:
        clock = HostClock(wall=lambda: time.time_ns() + wall[0])
        with contextlib.closing(
            CaptureThread(open_live(f"udp://:{number}", sensor), queue, log=kept, clock=clock)
        ) as capture:
            for index, lead_ms in enumerate((0, 20, 3000, 3000, 1000)):
                wall[0] = lead_ms * 1_000_000
                sender.sendto(frames[index], ("127.0.0.1", number))
                until(lambda index=index: queue.produced == index + 1)  # type: ignore[misc]
                warnings.append(capture.warnings)
    assert warnings[0] == warnings[1] == []
    assert warnings[2] == warnings[3]
    assert warnings[3][0].startswith("the clock of this computer was stepped by +3.")
    assert warnings[4][0].startswith("the clock of this computer was stepped by -2.")
    with Recording(path) as recording:
        found = list(recording)
    directions = [record.direction for record in found]
    assert directions == ["in", "in", "event", "in", "in", "event", "in"]
    for record, lead_ns in ((found[2], 3_000_000_000), (found[5], 1_000_000_000)):
        assert abs(json.loads(record.data)["ahead_ns"] - lead_ns) < 50_000_000
    times = [record.at for record in found if record.at]
    assert times == sorted(times)
    assert times[-1] - times[0] < 2_000_000_000, "no step"
    with ls.open(path, sensor) as device:
        assert sum(map(len, device.packets())) == 5
        (said,) = (warning for warning in device.warnings if "clock" in warning)
        assert said == (
            f"{path}: the clock of the computer was stepped during the recording; arrival"
            " times continue without this step"
        )


def test_arrival_times_count_a_suspend() -> None:
    """The test uses a namespace in which the computer appears to have slept for 100 s."""
    slept = ["unshare", "--fork", "--user", "--map-root-user", "--time", "--boottime", "100"]
    if (
        shutil.which("unshare") is None
        or subprocess.run([*slept, "true"], capture_output=True, check=False).returncode
    ):
        pytest.skip("this system has no namespaces of time")
    program = (
        "import time; from lidarspec.transports.host_clock import steady_ns; print((steady_ns() -"
        " time.monotonic_ns()) // 10**9)"
    )
    assert (
        int(
            subprocess.run(
                [*slept, sys.executable, "-c", program], capture_output=True, check=True
            ).stdout
        )
        >= 99
    )
