"""Make streams of an RPLIDAR for its tests: nodes and capsules with seeded content."""

from __future__ import annotations

import dataclasses
import math
import random

import lidarspec as ls

A1 = ls.sensor("slamtec-rplidar-a1")

#: the answers in capsules.
ANSWERS = ("express", "ultra", "dense", "ultra_dense", "hq")


def node(degrees: float, metres: float, *, quality: int = 40, start: bool = False) -> bytes:
    """Return a node of a scan."""
    head = {"quality": quality, "start": int(start), "inverse": int(not start)}
    return A1.build("node", head=head, beam={"angle": degrees}, distance=metres, units=True)


def capsule(answer: str, source: random.Random, degrees: float) -> bytes:
    """Return a capsule with random content.

    `degrees` is its first angle, except for "hq".
    """
    parsed = A1.parse(A1.example(answer, seed=source.randrange(1 << 30)), frame=answer)
    if answer != "hq":
        parsed.start.angle, parsed.start.sync = round(degrees * 64) % (360 * 64), 0
    return A1.build(answer, parsed)


def capsules(answer: str, number: int, *, step: float = 17.0, seed: int = 1) -> bytes:
    """Return a stream of random capsules after their descriptor."""
    source = random.Random(seed)
    return A1.example(f"{answer}_descriptor") + b"".join(
        capsule(answer, source, index * step) for index in range(number)
    )


def turns(number: int, *, seed: int = 1) -> bytes:
    """Return `number` nodes, 500 per revolution; 10 % of them have no return.

    The distances have a noise of a few millimetres.
    """
    source, found = random.Random(seed), bytearray()
    for index in range(number):
        distance = (
            0.0 if source.random() < 0.1 else 2 + math.sin(index / 80) + source.gauss(0, 0.004)
        )
        found += node(
            (index % 500 * 0.72 + source.uniform(0, 0.02)),
            distance,
            quality=source.randrange(48),
            start=index % 500 == 0,
        )
    return bytes(found)


def make_node_sensor(runs: int) -> ls.Sensor:
    """Return an A1 in node mode that requires `runs` consecutive nodes."""
    frames = {**A1.frames, "node": dataclasses.replace(A1.frames["node"], confirm=runs)}
    return dataclasses.replace(A1, frames=frames).configure(answer="node")


def find_nodes(sensor: ls.Sensor, data: bytes) -> list[int]:
    """Return the offsets of the nodes that the decoder finds."""
    return [found.offset for found in sensor.split(data) if found.frame == "node"]
