"""Workloads on real connections: capture, decode and compute points as data arrives.

They measure latency, processor time and loss.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
import tty
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from inputs import Inputs
from measure import Rates
from packet_workloads import Facts, Work, columns

import lidarspec as ls

SENDING = Path(__file__).with_name("rate_sender.py")
#: seconds of one run.
SECONDS = 2.0
QUICK_SECONDS = 0.2


class Line:
    """A connection with a fixed frame rate, and the measurements of each run.

    Args:
        rate: frames per second.
        opened: a context manager that opens both ends of the connection. It yields the SOURCE to
            read from, and the arguments and descriptors of the process that sends.
    """

    def __init__(
        self,
        sensor: ls.Sensor,
        frames: list[bytes],
        rate: float,
        seconds: float,
        opened: Callable[[], contextlib.AbstractContextManager[Any]],
    ) -> None:
        self._sensor = sensor
        self._frames = frames
        self._rate = rate
        self._seconds = seconds
        self._opened = opened
        self.late: dict[str, list[float]] = {}
        self.share: dict[str, list[float]] = {}

    def run(self, backend: str) -> None:
        """Receive everything, and record the median delay in ms and the share of a core."""
        with tempfile.TemporaryDirectory() as folder, self._opened() as (source, words, kept):
            path = Path(folder, "frames")
            times = Path(folder, "times")
            path.write_bytes(b"".join(self._frames))
            arguments = [path, len(self._frames[0]), self._rate, self._seconds, 1, times, *words]
            with ls.open(source, self._sensor, backend=backend) as device:
                columns(
                    self._sensor.decode(
                        self._frames[:2] if self._sensor.datagrams else b"".join(self._frames[:2])
                    ).points()
                )
                began = time.monotonic()
                used = time.process_time()
                with subprocess.Popen(
                    [sys.executable, SENDING, *map(str, arguments)],
                    pass_fds=kept,
                    stdout=subprocess.DEVNULL,
                ) as sender:
                    arrived = np.array(list(arrivals(device, sender)), np.int64)
                spent = (time.process_time() - used) / (time.monotonic() - began)
            sent = np.frombuffer(times.read_bytes(), np.int64)
        if len(arrived) != len(sent):
            raise RuntimeError(
                f"{len(sent)} frames were sent, and {len(arrived)} arrived: {device.stats}"
            )
        self.late.setdefault(backend, []).append(float(np.median(arrived - sent)) / 1e6)
        self.share.setdefault(backend, []).append(100 * spent)

    def facts(self, backend: str, rates: Rates) -> Facts:
        """Return the medians over the runs."""
        return {
            "ms from a frame's last byte to its points": median(self.late[backend]),
            f"% of one core at {self._rate:.0f} frames/s": median(self.share[backend]),
        }


def arrivals(device: ls.Device, sender: subprocess.Popen[bytes]) -> Iterator[int]:
    """Yield the time at which the points of each packet were ready, ns.

    Ends when the sender has ended and no packets arrive.
    """
    for packets in device.packets(wait=0.15):
        if len(packets):
            columns(packets.points())
            now = time.monotonic_ns()
            yield from [now] * len(packets)
        elif sender.poll() is not None:
            return


@contextlib.contextmanager
def pseudo_terminal() -> Iterator[tuple[str, list[str], tuple[int, ...]]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    try:
        yield f"serial://{os.ttyname(slave)}", ["fd", str(master)], (master,)
    finally:
        os.close(slave)
        os.close(master)


@contextlib.contextmanager
def loopback() -> Iterator[tuple[str, list[str], tuple[int, ...]]]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        port = made.getsockname()[1]
    yield f"udp://127.0.0.1:{port}", ["udp", str(port)], ()


def live(
    inputs: Inputs,
    key: str,
    title: str,
    rate: float,
    opened: Callable[[], contextlib.AbstractContextManager[Any]],
) -> Work:
    """Return the workload of a connection at its sensor's rate for some seconds."""
    seconds = QUICK_SECONDS if inputs.is_quick else SECONDS
    frames = [row.tobytes() for row in inputs.array(key)]
    line = Line(inputs.sensor(key), frames, rate, seconds, opened)
    number = int(rate * seconds)
    return Work(
        title,
        "packets",
        number,
        number * len(frames[0]),
        lambda backend: lambda: line.run(backend),
        facts=line.facts,
    )


ON_LINES: Mapping[str, Callable[[Inputs], Work]] = {
    "line-stl27l": lambda inputs: live(
        inputs, "stl27l", "STL-27L over a serial line", 1800, pseudo_terminal
    ),
    "line-m1": lambda inputs: live(inputs, "m1", "RS-LiDAR-M1 over UDP", 6300, loopback),
}
