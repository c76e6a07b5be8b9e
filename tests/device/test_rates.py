"""Full rates without loss: UDP with a consumer that stalls and a recording, a serial line; short here, long in `make soak`."""

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
from lidarspec.simulation.simulator import simulate
from lidarspec.transports.udp import BUFFER
from tests.lines import Port, free_port, port

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="counts what the kernel of Linux drops")

SENDING = Path(__file__).parents[2] / "benchmarks" / "sending.py"
M1_RATE, STL_RATE = 6300, 1800


def sensor(name: str) -> ls.Sensor:
    if name not in ls.sensors():
        pytest.skip(f"{name} is not installed")
    return ls.sensor(name)


@contextlib.contextmanager
def sending(
    folder: Path, frames: Sequence[bytes], rate: float, seconds: float, *where: object, burst: int = 1, descriptor: int | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """A process that sends; its output is the number."""
    path = folder / "frames.bin"
    path.write_bytes(b"".join(frames))
    words = [path, len(frames[0]), rate, seconds, burst, "-", *where]
    kept = () if descriptor is None else (descriptor,)
    with subprocess.Popen([sys.executable, SENDING, *map(str, words)], stdout=subprocess.PIPE, pass_fds=kept) as process:
        try:
            yield process
        finally:
            process.kill()


def drained(device: ls.Device, process: subprocess.Popen[bytes], stall: float) -> int:
    """Decode until the sender is done and the line silent, standing still for a while each second; the number sent."""
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


@pytest.mark.parametrize(
    ("seconds", "burst", "hog"),
    [
        (2.0, 1, False),
        pytest.param(10.0, 1, False, marks=pytest.mark.soak),
        pytest.param(60.0, 630, True, marks=pytest.mark.soak),
    ],
    ids=["2s", "10s", "60s in bursts beside a thread that computes"],
)
def test_udp_at_full_rate_with_a_consumer_that_stalls(tmp_path: Path, seconds: float, burst: int, hog: bool) -> None:
    m1, number, path = sensor("robosense-m1"), free_port(), tmp_path / "all.lsr"
    frames = simulate(m1, 630)
    stop = threading.Event()
    computing = threading.Thread(target=lambda: [sum(range(1000)) for _ in iter(stop.is_set, True)])
    with ls.open(f"udp://127.0.0.1:{number}", m1, record=path) as device:
        if any(f"of {BUFFER >> 10}" in warning for warning in device.warnings):
            pytest.skip(device.warnings[0])
        m1.decode(frames[:2]).points()
        if hog:
            computing.start()
        try:
            with sending(tmp_path, frames, M1_RATE, seconds, "udp", number, burst=burst) as process:
                sent = drained(device, process, 0.25)
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


@pytest.mark.parametrize("seconds", [2.0, pytest.param(60.0, marks=pytest.mark.soak)])
def test_a_serial_line_at_full_rate(tmp_path: Path, seconds: float) -> None:
    stl = sensor("ldrobot-stl27l")
    frames = simulate(stl, 1800)
    with port(tmp_path) as line, ls.open(f"serial://{line.name}", stl) as device:
        assert isinstance(line, Port)
        with sending(tmp_path, frames, STL_RATE, seconds, "fd", line._master, descriptor=line._master) as process:
            sent = drained(device, process, 0.0)
        assert sent == int(STL_RATE * seconds)
        assert device.stats.frames == {"data": sent}
        assert device.stats.bytes_in == sent * 47
        assert device.stats.bytes_skipped == 0
