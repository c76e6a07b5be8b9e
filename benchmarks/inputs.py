"""Input of the workloads: packets and streams from lidarspec's simulator.

They are the same in every run.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import lidarspec as ls
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import Datagram, make_datagram_record
from lidarspec.captures.records import make_capture_head
from lidarspec.simulation.simulator import make_opening_frame, simulate

#: sensor, frames of a full run, options of the sensor.
SENSORS: dict[str, tuple[str, int, dict[str, Any]]] = {
    "m1": ("robosense-m1", 6300, {}),
    "stl27l": ("ldrobot-stl27l", 40_000, {}),
    "m1c1": ("cspc-m1c1-mini", 20_000, {}),
    "vlp16": ("velodyne-vlp16", 2000, {}),
    "vlp32c": ("velodyne-vlp32c", 4000, {}),
    "vls128": ("velodyne-vls128", 12_000, {}),
    "xt32": ("hesai-xt32", 3000, {}),
    "rplidar": ("slamtec-rplidar-a1", 100_000, {"answer": "node"}),
    "m1-long": ("robosense-m1", 63_000, {}),
    "vlp16-long": ("velodyne-vlp16", 20_000, {}),
    "ouster": ("ouster-os1", 640, {"rows": 128}),
    "livox": ("livox-mid360", 10_000, {}),
    "multiscan": ("sick-multiscan136", 2000, {}),
    "picoscan": ("sick-picoscan150", 3000, {}),
    "colab-tim": ("sick-tim571", 1200, {"cola": "B"}),
    "colab-lms": ("sick-lms511", 2500, {"cola": "B"}),
    "colaa": ("sick-tim571", 600, {"cola": "A"}),
    "scip": ("hokuyo-utm30lxew", 600, {}),
}
QUICKER = 50  # times fewer frames in a quick run
NOISE = 0.02  # share of the frames that is damaged, and share of noise among the bytes
SEED = 27

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Noisy:
    """A stream with noise.

    Attributes:
        data: the bytes.
        intact: the offsets of the undamaged frames.
    """

    data: bytes
    intact: NDArray[np.int64]


class Inputs:
    """The inputs of one run, each made on first use.

    Args:
        folder: folder for capture files.
        quick: make few frames, for a short run.
        size: bytes of a capture that is converted.
    """

    def __init__(self, folder: Path, *, quick: bool = False, size: int = 0) -> None:
        self.folder = folder
        self.is_quick = quick
        self.size = size
        self.frames: Callable[[str], list[bytes]] = functools.cache(self._frames)
        self.capture: Callable[[str], Path] = functools.cache(self._capture)

    def sensor(self, key: str) -> ls.Sensor:
        """Return the sensor of this name, configured."""
        name, _, options = SENSORS[key]
        return ls.sensor(name).configure(**options) if options else ls.sensor(name)

    def array(self, key: str) -> Bytes:
        """Return the frames that have the full length, (n, size)."""
        frames = self.frames(key)
        size = max(map(len, frames))
        return np.frombuffer(
            b"".join(frame for frame in frames if len(frame) == size), np.uint8
        ).reshape(-1, size)

    def stream(self, key: str) -> bytes:
        """Return all frames in a row, after the frames that the sensor sends first."""
        return make_opening_frame(self.sensor(key)) + b"".join(self.frames(key))

    def noisy(self, key: str) -> Noisy:
        """Return the frames as a stream, with noise before some and damage in some.

        About one frame in fifty has noise before it, of up to twice the length of a frame. In about
        one frame in fifty, one byte is changed.
        """
        random = np.random.default_rng(SEED)
        pieces: list[bytes | bytearray] = []
        intact = []
        offset = 0
        for frame in self.frames(key):
            noise = (
                random.bytes(int(random.integers(1, 2 * len(frame))))
                if random.random() < NOISE
                else b""
            )
            sent = bytearray(frame)
            if random.random() < NOISE:
                sent[int(random.integers(len(frame)))] ^= int(random.integers(1, 256))
            else:
                intact.append(offset + len(noise))
            pieces += [noise, sent]
            offset += len(noise) + len(frame)
        return Noisy(b"".join(pieces), np.array(intact, np.int64))

    def _frames(self, key: str) -> list[bytes]:
        count = SENSORS[key][1]
        return simulate(self.sensor(key), count // QUICKER if self.is_quick else count)

    def _capture(self, key: str) -> Path:
        """Return a pcap file of the frames, one datagram each."""
        path = self.folder / f"{key}.pcap"
        sender = ("192.168.1.200", 6699)
        receiver = ("192.168.1.102", 6699)
        with path.open("wb") as file:
            file.write(make_capture_head(ETHERNET))
            for index, frame in enumerate(self.frames(key)):
                file.write(
                    make_datagram_record(
                        Datagram(frame, 1_700_000_000 * 10**9 + index * 158_730, sender, receiver)
                    )
                )
        return path
