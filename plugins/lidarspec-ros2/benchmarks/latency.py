"""Measure the latency of scans at a subscriber, and the processor time of the node.

    python plugins/lidarspec-ros2/benchmarks/latency.py [SENSOR] [SECONDS]

There are three measurements of SECONDS each:

* A simulated sensor sends packets in real time, the node publishes, and a subscriber receives. The
  latency is the time from the last packet of a scan to the callback of the subscriber.
* `lidarspec stats` reads the same packets.
* A program that only publishes sends messages of the same size at the same rate.

The second and the third measurement show how much of the processor time is spent on decoding and on
publishing.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import socket
import subprocess
import sys
import tempfile
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import lidarspec as ls
from lidarspec.simulation.simulator import simulate

os.environ |= {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
#: The time for all processes to start before the measurement begins.
WARM_UP_S = 5.0
UDP_PORT = 26699


def send(sensor: str, seconds: float, place: str, notes: str) -> None:
    """Send simulated packets in real time, and store the time of the last packet of each scan.

    Args:
        place: the path of the pseudo-terminal to create; "" to send by UDP.
    """
    spec = ls.sensor(sensor)
    frames = list(simulate(spec, 20000))
    packets = spec.decode(b"".join(frames) if not spec.datagrams else frames)
    pace = (int(packets.time_ns[-1]) - int(packets.time_ns[0])) * 1e-9 / (len(frames) - 1)
    cloud = packets.points()
    each = len(cloud) // len(frames)
    ends = set((np.cumsum([len(scan) for scan in spec.scans(frames)]) // each).tolist())
    write = _make_line_writer(place) if place else _make_socket_writer()
    begin, left = time.monotonic(), []
    for number in range(int(seconds / pace)):
        time.sleep(max(begin + number * pace - time.monotonic(), 0))
        write(frames[number % len(frames)])
        if number % len(frames) in ends:
            left.append(time.time_ns())
    Path(notes).write_text(json.dumps(left), encoding="utf-8")


def _make_line_writer(place: str) -> Any:
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    os.symlink(os.ttyname(theirs), place)
    return lambda data: os.write(ours, data)


def _make_socket_writer() -> Any:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    return lambda data: sock.sendto(data, ("127.0.0.1", UDP_PORT))


def subscribe(kind: str, topic: str, seconds: float, notes: str) -> None:
    """Receive the messages of a topic, and store the arrival time and size of each.

    Args:
        kind: the message type in `sensor_msgs`.
    """
    import rclpy
    from sensor_msgs import msg

    rclpy.init()
    node, came = rclpy.create_node("subscriber"), list[tuple[int, int]]()
    node.create_subscription(
        getattr(msg, kind),
        topic,
        lambda data: came.append((time.time_ns(), len(data))),
        10,
        raw=True,
    )
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=0.1)
    Path(notes).write_text(json.dumps(came), encoding="utf-8")
    rclpy.shutdown()


def publish(kind: str, size: int, rate: float, seconds: float, notes: str) -> None:
    """Publish messages at a constant rate, and store the time of each.

    Args:
        kind: the message type in `sensor_msgs`.
        size: size of each message, in bytes.
        rate: messages per second.
    """
    import rclpy
    from sensor_msgs import msg

    rclpy.init()
    node = rclpy.create_node("publisher")
    publisher, left, data = (
        node.create_publisher(getattr(msg, kind), "alone", 10),
        list[int](),
        bytes(size),
    )
    begin, number = time.monotonic(), 0
    while time.monotonic() < begin + seconds:
        number += 1
        time.sleep(max(begin + number / rate - time.monotonic(), 0))
        left.append(time.time_ns())
        publisher.publish(data)
    Path(notes).write_text(json.dumps(left), encoding="utf-8")
    rclpy.shutdown()


@contextlib.contextmanager
def run_program(*words: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run Python with these arguments until the context ends."""
    begun = subprocess.Popen(
        [sys.executable, *map(str, words)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield begun
    finally:
        begun.terminate()
        begun.wait()


def measure_core_share(pid: int, seconds: float) -> float:
    """Measure for some seconds how much of a processor core a process uses, from 0 to 1."""

    def taken() -> float:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    before, begin = taken(), time.monotonic()
    time.sleep(seconds)
    return (taken() - before) / (time.monotonic() - begin)


def format_latency(sent_ns: list[int], received: list[tuple[int, int]]) -> str:
    """Return the median and the 99th percentile of the latency as text.

    Args:
        sent_ns: the times at which the data was sent, in ns.
        received: (time in ns, size) of each received message.
    """
    times = np.array(sent_ns)
    after = np.array([at for at, _ in received if at > times[0]])
    which = np.searchsorted(times, after, side="right") - 1
    found = (after - times[which]) * 1e-6
    return (
        f"median {np.median(found):6.2f} ms, 99 % {np.percentile(found, 99):6.2f} ms of"
        f" {len(found)}"
    )


def main(sensor: str = "ldrobot-stl27l", seconds: float = 20.0) -> None:
    """Run the three measurements and print their results."""
    os.environ["ROS_DOMAIN_ID"] = str(random.randrange(50, 100))
    spec, lasting = ls.sensor(sensor), seconds + 2 * WARM_UP_S
    kind, topic = ("PointCloud2", "points") if spec.datagrams else ("LaserScan", "scan")
    with tempfile.TemporaryDirectory() as folder:
        left, came, place = (
            f"{folder}/left",
            f"{folder}/came",
            "" if spec.datagrams else f"{folder}/port",
        )
        source = f"udp://127.0.0.1:{UDP_PORT}" if spec.datagrams else place
        with (
            run_program(__file__, "send", sensor, lasting, place, left) as sender,
            run_program(__file__, "subscribe", kind, topic, lasting, came) as subscriber,
        ):
            while place and not os.path.islink(place):
                time.sleep(0.1)
            with run_program(
                "-m", "lidarspec", "ros2", source, "-s", sensor, "--ros-args", "-p", "qos:=reliable"
            ) as node:
                time.sleep(WARM_UP_S)
                taken = measure_core_share(node.pid, seconds)
                sender.wait()
                subscriber.wait()
        ends, messages = json.loads(Path(left).read_text()), json.loads(Path(came).read_text())
        size, rate = messages[-1][1], len(ends) / lasting
        print(f"{sensor}: {size} bytes, {rate:.1f} a second")
        print(
            f"  the node, from the last byte:   {format_latency(ends, messages)};"
            f" {taken:.1%} of a core"
        )
        if place:
            Path(place).unlink()
        with run_program(__file__, "send", sensor, lasting, place, left):
            while place and not os.path.islink(place):
                time.sleep(0.1)
            with run_program("-m", "lidarspec", "stats", source, "-s", sensor) as stats:
                time.sleep(WARM_UP_S)
                reading = measure_core_share(stats.pid, seconds)
        with (
            run_program(__file__, "subscribe", kind, "alone", lasting, came) as subscriber,
            run_program(__file__, "publish", kind, size, rate, lasting - 2, left) as publisher,
        ):
            time.sleep(WARM_UP_S)
            publishing = measure_core_share(publisher.pid, seconds)
            subscriber.wait()
        alone = format_latency(
            json.loads(Path(left).read_text()), json.loads(Path(came).read_text())
        )
        print(f"  publishing alone:               {alone}; {publishing:.1%} of a core")
        print(
            f"  lidarspec stats: {reading:.1%} of a core; the node takes"
            f" {taken / (reading + publishing):.2f} times both"
        )


if __name__ == "__main__":
    role, *words = sys.argv[1:] or [""]
    if role == "send":
        send(words[0], float(words[1]), words[2], words[3])
    elif role == "subscribe":
        subscribe(words[0], words[1], float(words[2]), words[3])
    elif role == "publish":
        publish(words[0], int(words[1]), float(words[2]), float(words[3]), words[4])
    else:
        main(*[role] * bool(role), *map(float, words))
