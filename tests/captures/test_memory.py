"""Tests that long captures are decoded in constant memory."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import Datagram, make_datagram_record
from lidarspec.captures.records import make_capture_head
from lidarspec.simulation.simulator import simulate

SENSOR = "robosense-m1"
ENDS = ("192.168.1.200", 6699), ("192.168.1.102", 6699)

CHILD = r"""
import re, sys
from pathlib import Path
import lidarspec as ls
def most():
    # What getrusage tells begins with the memory of the process that started this one.
    return int(re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())[1])
count = 0
with ls.open(sys.argv[1], sys.argv[2]) as device:
    for scan in device.scans():
        count += len(scan.points.x)
        if count < 400_000:
            first = most()
print(count, first, most())
"""


def write_repeated_capture(path: Path, megabytes: int) -> int:
    """Write a capture that repeats the same frames; return the number of packets."""
    frames = simulate(ls.sensor(SENSOR), 630)
    with path.open("wb") as file:
        file.write(make_capture_head(ETHERNET))
        for index, frame in enumerate(frames):
            file.write(make_datagram_record(Datagram(frame, 10**18 + index * 158_730, *ENDS)))
    data = path.read_bytes()
    times = max((megabytes << 20) // len(data), 1)
    with path.open("ab") as file:
        for _ in range(times - 1):
            file.write(data[24:])
    return len(frames) * times


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("megabytes", [60, pytest.param(1024, marks=pytest.mark.soak)])
def test_a_capture_of_any_length_is_decoded_below_200_mb(megabytes: int, tmp_path: Path) -> None:
    path = tmp_path / "long.pcap"
    packets = write_repeated_capture(path, megabytes)
    command, alone = (
        [sys.executable, "-c", CHILD, str(path), SENSOR],
        {**os.environ, "LIDARSPEC_BACKEND": "numpy"},
    )  # without Numba's own 100 MB
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, timeout=500, env=alone
    )
    count, first, most = map(int, done.stdout.split())
    assert count == packets * 125
    assert most * 1024 < 200_000_000, f"{most} KiB"
    assert most - first < 40_000, f"from {first} to {most} KiB"
