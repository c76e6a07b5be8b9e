"""Tests of full data rates without loss: UDP and a slow consumer, and a serial port.

These tests send a number of packets; `make soak` sends for a time.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.recording.format import Recording
from lidarspec.transports.udp import REQUESTED_BUFFER_BYTES
from tests.lines import Port, free_port, port, turning, udp, until, working
from tests.shapes import SHAPES

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="counts what the kernel of Linux drops"
)

SENDING = Path(__file__).parents[2] / "benchmarks" / "rate_sender.py"
M1_RATE = 6300
STL_RATE = 1800
#: datagrams that a sensor sends at once in the long test.
BURST = 630


def skip_without_buffer(device: ls.Device) -> None:
    """Skip the test if the system grants less than the requested receive buffer."""
    short = [
        warning for warning in device.warnings if f"of {REQUESTED_BUFFER_BYTES >> 10}" in warning
    ]
    if short:
        pytest.skip(short[0])


def test_bursts_of_datagrams_are_all_read_and_recorded_while_the_consumer_stalls(
    tmp_path: Path,
) -> None:
    sensor, number, path = SHAPES["shape-datagrams"], free_port(), tmp_path / "all.lsr"
    frames = turning(sensor, 200) * 7
    with ls.open(f"udp://127.0.0.1:{number}", sensor, record=path) as device, udp() as sender:
        skip_without_buffer(device)
        for frame in frames:
            sender.sendto(frame, ("127.0.0.1", number))
        count = 0
        for batch in device.packets(wait=0.05):
            count += len(batch)
            if count == len(frames):
                break
        stats = device.stats
        assert (stats.kernel_drops, stats.queue_dropped) == (0, 0)
        assert stats.bytes_in == sum(map(len, frames))
    with Recording(path) as recording:
        assert [record.data for record in recording if record.direction == "in"] == frames


def read_some(device: ls.Device) -> int:
    """Read the available data; return the number of data frames so far."""
    device.newest(0.01)
    return device.stats.frames.get("data", 0)


def test_a_line_that_is_always_full_loses_nothing(tmp_path: Path) -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    frames = ls.simulate(sensor, 900)

    def send(stop: threading.Event) -> None:
        for frame in frames:
            line.send(frame)

    with port(tmp_path) as line, ls.open(f"serial://{line.name}", sensor) as device:
        with working(send):
            until(lambda: read_some(device) == len(frames))
        assert device.stats.bytes_in == len(frames) * 47
        assert device.stats.bytes_skipped == 0


@contextlib.contextmanager
def sending(
    folder: Path,
    frames: Sequence[bytes],
    rate: float,
    seconds: float,
    *where: object,
    burst: int = 1,
    descriptor: int | None = None,
) -> Iterator[subprocess.Popen[bytes]]:
    """Run a process that sends; its output is the number of frames."""
    path = folder / "frames.bin"
    path.write_bytes(b"".join(frames))
    words = [path, len(frames[0]), rate, seconds, burst, "-", *where]
    kept = () if descriptor is None else (descriptor,)
    with subprocess.Popen(
        [sys.executable, SENDING, *map(str, words)], stdout=subprocess.PIPE, pass_fds=kept
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def drain(device: ls.Device, process: subprocess.Popen[bytes], stall: float) -> int:
    """Decode until the sender is done and no data arrives; return the number sent.

    There is a pause each second.
    """
    due = time.monotonic() + 1
    for batch in device.packets(wait=0.3):
        if len(batch):
            batch.points()
        elif process.poll() is not None:
            break
        if time.monotonic() >= due:
            time.sleep(stall)
            due = time.monotonic() + 1 - stall
    assert process.stdout is not None
    return int(process.stdout.read())


@pytest.mark.soak
@pytest.mark.parametrize(
    ("seconds", "burst", "hog"),
    [(2.0, 1, False), (10.0, 1, False), (60.0, BURST, True)],
    ids=["2s", "10s", "60s in bursts beside a thread that computes"],
)
def test_udp_at_full_rate_with_a_consumer_that_stalls(
    tmp_path: Path, seconds: float, burst: int, hog: bool
) -> None:
    m1, number, path = ls.sensor("robosense-m1"), free_port(), tmp_path / "all.lsr"
    frames = ls.simulate(m1, 630)
    stop = threading.Event()
    computing = threading.Thread(target=lambda: [sum(range(1000)) for _ in iter(stop.is_set, True)])
    with ls.open(f"udp://127.0.0.1:{number}", m1, record=path) as device:
        skip_without_buffer(device)
        m1.decode(frames[:2]).points()
        if hog:
            computing.start()
        try:
            with sending(tmp_path, frames, M1_RATE, seconds, "udp", number, burst=burst) as process:
                sent = drain(device, process, 0.25)
        finally:
            stop.set()
            if hog:
                computing.join()
        assert sent == int(M1_RATE * seconds)
        stats = device.stats
        assert (stats.kernel_drops, stats.queue_dropped) == (0, 0)
        assert stats.frames["data"] == sent
        assert stats.bytes_in == sent * 1210
    with Recording(path) as recording:
        assert sum(record.direction == "in" for record in recording) == sent


@pytest.mark.soak
@pytest.mark.parametrize("seconds", [2.0, 60.0])
def test_a_serial_line_at_full_rate(tmp_path: Path, seconds: float) -> None:
    stl = ls.sensor("ldrobot-stl27l")
    frames = ls.simulate(stl, 1800)
    with port(tmp_path) as line, ls.open(f"serial://{line.name}", stl) as device:
        assert isinstance(line, Port)
        with sending(
            tmp_path, frames, STL_RATE, seconds, "fd", line._master, descriptor=line._master
        ) as process:
            sent = drain(device, process, 0.0)
        assert sent == int(STL_RATE * seconds)
        assert device.stats.frames == {"data": sent}
        assert device.stats.bytes_in == sent * 47
        assert device.stats.bytes_skipped == 0
