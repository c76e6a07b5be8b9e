"""Workloads on captures, live input, single frames and program start."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import handwritten_packets
import libraries
from hostile_streams import streams
from inputs import QUICKER, Inputs
from measure import Contender, Rates, times
from packet_workloads import (
    FEW,
    Facts,
    Others,
    Work,
    beside_construct,
    beside_ouster_sdk,
    columns,
    points_of,
)
from peers import STRUCTS

import lidarspec as ls
from lidarspec.captures.bulk import CaptureBatches
from lidarspec.captures.pcap import CaptureReader
from lidarspec.packets.stream import PacketStream
from lidarspec.spec import Serial
from lidarspec.testing.sensor_under_test import SensorUnderTest

RATE = 6300  # packets per second of an RS-LiDAR-M1
TOGETHER = 63  # of them in 10 ms
HOSTILE = 100_000  # bytes of a hostile stream


def from_capture(inputs: Inputs, key: str, title: str, more: Others | None = None) -> Work:
    """Return the workload of computing scans from a capture, compared with packets in memory."""
    sensor = inputs.sensor(key)
    rows = inputs.array(key)
    path = inputs.capture(key)
    points = len(sensor.decode(rows).points())

    def scans(backend: str) -> int:
        with ls.open(path, sensor, backend=backend) as device:
            return sum(len(columns(scan.points)[0]) for scan in device.scans())

    def facts(backend: str, rates: Rates) -> Facts:
        return {"% of the in-memory figure": 100 * times(rates, "ours", "in memory")}

    return Work(
        title,
        "points",
        points,
        path.stat().st_size,
        lambda backend: lambda: scans(backend),
        {**beside_construct(inputs, key.removesuffix("-long")), **(more or {})},
        lambda backend: {"in memory": Contender(points_of(sensor, rows, backend), points)},
        facts,
    )


def m1_pcap(inputs: Inputs) -> Work:
    path = inputs.capture("m1")
    points = 125 * len(inputs.frames("m1"))
    return from_capture(
        inputs,
        "m1",
        "RS-LiDAR-M1 capture to scans",
        {"by hand": lambda: Contender(lambda: handwritten_packets.m1_scans(path), points)},
    )


def vlp16_pcap(inputs: Inputs) -> Work:
    path = inputs.capture("vlp16")
    points = 384 * len(inputs.frames("vlp16"))
    return from_capture(
        inputs,
        "vlp16",
        "VLP-16 capture to scans",
        {"velodyne-decoder": lambda: libraries.velodyne_pcap(path, points)},
    )


def m1_long(inputs: Inputs) -> Work:
    return from_capture(inputs, "m1-long", "RS-LiDAR-M1 capture of 10 s to scans")


def vlp16_long(inputs: Inputs) -> Work:
    return from_capture(inputs, "vlp16-long", "VLP-16 capture of 26 s to scans")


def payloads(inputs: Inputs) -> Work:
    path = inputs.capture("m1")
    packets = len(inputs.frames("m1"))
    others: Others = {
        "dpkt": lambda: libraries.dpkt_payloads(path, packets),
        "ouster-sdk": lambda: beside_ouster_sdk(libraries.ouster_payloads, path, packets),
        "our own objects": lambda: Contender(lambda: one_by_one_of(path), packets),
        "by hand": lambda: Contender(lambda: handwritten_packets.payloads(path).size, packets),
    }

    def run() -> int:
        with CaptureBatches(path) as reader:
            return sum(int(batch.sizes.sum()) for batch in reader.batches())

    return Work(
        "capture payloads, 1210 bytes",
        "packets",
        packets,
        path.stat().st_size,
        lambda _: run,
        others,
        has_backends=False,
    )


def one_by_one_of(path: Path) -> int:
    """Read the payloads as separate objects; return the sum of their sizes."""
    with CaptureReader(path) as reader:
        return sum(len(datagram.data) for datagram in reader)


def live(inputs: Inputs) -> Work:
    """Return the workload of decoding live packets every 10 ms.

    It is compared with the cost of decoding each packet separately.
    """
    sensor = inputs.sensor("m1")
    frames = inputs.frames("m1")

    def alone(backend: str) -> dict[str, Contender]:
        return {
            "one by one": Contender(as_they_come(sensor, frames[:TOGETHER], 1, backend), TOGETHER)
        }

    def facts(backend: str, rates: Rates) -> Facts:
        return {
            "% of one core at 6300 packets/s": 100 * RATE * median(rates["ours"]),
            "times decoding one by one": times(rates, "ours", "one by one"),
        }

    return Work(
        "live RS-LiDAR-M1, every 10 ms",
        "packets",
        len(frames),
        sum(map(len, frames)),
        lambda backend: as_they_come(sensor, frames, TOGETHER, backend),
        own=alone,
        facts=facts,
    )


def as_they_come(
    sensor: ls.Sensor, packets: list[bytes], together: int, backend: str
) -> Callable[[], None]:
    """Return a function that decodes live packets in batches of this size.

    The time to receive the packets is not counted.
    """

    def run() -> None:
        decoder = sensor.decoder(backend=backend)
        stream = PacketStream(sensor, sensor.data_frame, decoder.stats, backend=decoder.backend)
        waiting: list[bytes] = []
        for packet in packets:
            waiting.append(packet)
            if len(waiting) == together:
                columns(stream.add([decoder.datagrams(waiting)]).points())
                waiting = []

    return run


def parse(inputs: Inputs, key: str, title: str) -> Work:
    """Return the workload of parsing single frames to Containers, with checksums.

    It is compared with construct on a plain struct.
    """
    sensor = inputs.sensor(key)
    frames = inputs.frames(key)[:FEW]
    others: Others = {
        "construct": lambda: Contender(one_by_one(STRUCTS[key].parse, frames), len(frames)),
        "compiled": lambda: Contender(
            one_by_one(STRUCTS[key].compile().parse, frames), len(frames)
        ),
    }
    ours = one_by_one(sensor.parse, frames)
    return Work(
        title,
        "frames",
        len(frames),
        sum(map(len, frames)),
        lambda _: ours,
        others,
        has_backends=False,
    )


def one_by_one(function: Callable[[bytes], Any], frames: list[bytes]) -> Callable[[], None]:
    """Return a function that parses each frame and discards the result.

    Keeping all Containers would cost more than parsing.
    """

    def run() -> None:
        for frame in frames:
            function(frame)

    return run


def hostile(inputs: Inputs) -> Work:
    """Return the workload of finding frames in the most expensive streams.

    Each family is measured on its fastest serial port, and compared with the port's data rate.
    """
    families = {
        tuple(sensor.frames): sensor
        for sensor in sorted(ls.sensors().values(), key=line_rate)
        if line_rate(sensor) and sensor.has_points
    }
    tasks: dict[str, tuple[ls.Sensor, list[bytes]]] = {}
    length = HOSTILE // QUICKER if inputs.is_quick else HOSTILE
    for sensor in families.values():
        for name, parts in streams(SensorUnderTest(sensor), length=length).items():
            tasks[f"{name} of {sensor.id}"] = sensor, parts

    def make_search(sensor: ls.Sensor, parts: list[bytes]) -> Callable[[], Any]:
        return lambda: sensor.decoder().frames(b"".join(parts))

    own = {
        name: Contender(make_search(*task), sum(map(len, task[1]))) for name, task in tasks.items()
    }

    def run() -> None:
        for contender in own.values():
            contender.run()

    def facts(backend: str, rates: Rates) -> Facts:
        least, name = min(
            (1 / median(rates[name]) / line_rate(sensor), name)
            for name, (sensor, _) in tasks.items()
        )
        return {f"times its line's rate at least, in {name}": least}

    size = sum(contender.amount for contender in own.values())
    title = "Hostile streams of serial sensors"
    return Work(
        title,
        "bytes",
        size,
        size,
        lambda _: run,
        own=lambda _: own,
        facts=facts,
        has_backends=False,
    )


def line_rate(sensor: ls.Sensor) -> float:
    """Return the bytes per second of a sensor's serial port, 0 if it has none."""
    link = sensor.links.get("data")
    return max(link.bauds) / 10 if isinstance(link, Serial) else 0.0


def start_process(inputs: Inputs) -> Work:
    """Return the workload of starting a process that imports lidarspec and finds a sensor.

    It is compared with a process that imports only the required libraries.
    """

    # As pip leaves packages behind, and not as an editable one is the first time: compiled.
    compiled = {
        name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"
    }
    compiled["PYTHONPYCACHEPREFIX"] = str(inputs.folder / "bytecode")

    def python(code: str) -> Callable[[], Any]:
        return lambda: subprocess.run([sys.executable, "-c", code], check=True, env=compiled)

    def facts(backend: str, rates: Rates) -> Facts:
        return {"times the libraries' imports": times(rates, "libraries", "ours")}

    others: Others = {"libraries": lambda: Contender(python("import numpy, construct, pluggy"), 1)}
    ours = python("import lidarspec as ls; ls.sensor('ldrobot-stl27l')")
    return Work(
        "import and ls.sensor(...)",
        "imports",
        1,
        0,
        lambda _: ours,
        others,
        facts=facts,
        has_backends=False,
    )


ELSEWHERE: Mapping[str, Callable[[Inputs], Work]] = {
    "m1-pcap": m1_pcap,
    "m1-long": m1_long,
    "vlp16-pcap": vlp16_pcap,
    "vlp16-long": vlp16_long,
    "pcap": payloads,
    "live": live,
    "parse-stl27l": lambda inputs: parse(inputs, "stl27l", "parse one STL-27L frame"),
    "parse-m1c1": lambda inputs: parse(inputs, "m1c1", "parse one M1C1_Mini packet"),
    "parse-vlp16": lambda inputs: parse(inputs, "vlp16", "parse one VLP-16 packet"),
    "parse-xt32": lambda inputs: parse(inputs, "xt32", "parse one Pandar XT32 packet"),
    "parse-m1": lambda inputs: parse(inputs, "m1", "parse one RS-LiDAR-M1 packet"),
    "hostile": hostile,
    "import": start_process,
}
