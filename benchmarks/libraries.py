"""Libraries for a single format that a user might install instead.

This module imports nothing of lidarspec, because a worker in another environment
(`remote_contender`) also runs these functions.
"""

from __future__ import annotations

import importlib
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measure import Contender


class Missing(Exception):
    """A library that is not installed, or that cannot be imported."""


def library(module: str) -> Any:
    """Import a module of a library.

    Raises:
        Missing: if it cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise Missing("not installed") from error
    except ImportError as error:
        raise Missing(f"cannot be imported: {error}") from error


#: models of velodyne-decoder: its name of the model, packets a second.
VELODYNE = {"vlp16": ("VLP16", 754), "vlp32c": ("VLP32C", 1507), "vls128": ("AlphaPrime", 6250)}


def velodyne_packets(key: str, frames: Sequence[bytes], points: int) -> Contender:
    """Prepare velodyne-decoder on packets, a tenth of a second to a scan.

    Its vectors of packets are made in advance.
    """
    vd = library("velodyne_decoder")
    (model, rate) = VELODYNE[key]
    config = vd.Config()
    turn = -(-rate // 10)
    config.model = getattr(vd.Model, model)
    packets = [vd.VelodynePacket(index / rate, frame) for index, frame in enumerate(frames)]
    scans = [
        vd.PacketVector(packets[start : start + turn]) for start in range(0, len(packets), turn)
    ]
    decoder = vd.ScanDecoder(config)
    return Contender(lambda: [decoder.decode(scan) for scan in scans], points)


def velodyne_pcap(path: Path, points: int) -> Contender:
    """Prepare velodyne-decoder on a pcap file of VLP-16 packets."""
    vd = library("velodyne_decoder")
    config = vd.Config()
    config.model = vd.Model.VLP16
    return Contender(lambda: list(vd.read_pcap(str(path), config)), points)


def dpkt_payloads(path: Path, packets: int) -> Contender:
    """Prepare dpkt, with an object for each protocol from Ethernet to UDP."""
    dpkt = library("dpkt")

    def run() -> int:
        with path.open("rb") as file:
            return sum(
                len(dpkt.ethernet.Ethernet(data).data.data.data)
                for _, data in dpkt.pcap.Reader(file)
            )

    return Contender(run, packets)


def ouster_payloads(path: Path, packets: int) -> Contender:
    """Prepare ouster-sdk's C++ reader, which copies the payloads of a capture to one buffer."""
    pcap = library("ouster.sdk._bindings.pcap")
    buffer = np.empty(1 << 16, np.uint8)

    def run() -> int:
        with warnings.catch_warnings():
            # its successor gives packets of Ouster sensors only
            warnings.simplefilter("ignore", FutureWarning)
            capture = pcap.replay_initialize(str(path))
            info = pcap.PacketInfo()
            total = 0
            while pcap.next_packet_info(capture, info):
                total += pcap.read_packet(capture, buffer)
            pcap.replay_uninitialize(capture)
            return total

    return Contender(run, packets)


def ouster_scans(
    frames: Sequence[bytes], metadata: dict[str, dict[str, Any]], points: int
) -> Contender:
    """Prepare ouster-sdk on lidar packets, 64 to a scan: all fields and coordinates.

    Its packets are made in advance.
    """
    core = library("ouster.sdk.core")
    flat = {
        key: value
        for name, section in metadata.items()
        if name != "lidar_data_format"
        for key, value in section.items()
    }
    info = core.SensorInfo(json.dumps({**flat, "data_format": metadata["lidar_data_format"]}))
    form = core.PacketFormat(info)
    table = core.XYZLut(info)
    packets = [core.LidarPacket(form) for _ in frames]
    for packet, frame in zip(packets, frames, strict=True):
        packet.buf[:] = np.frombuffer(frame, np.uint8)

    def run() -> int:
        scan = core.LidarFrame(info)
        batcher = core.FrameBatcher(info)
        made = 0
        for packet in packets:
            if batcher.batch(packet, scan):
                made += len(table(scan))
        return made + len(table(scan))

    return Contender(run, points)


def rplidar_nodes(frames: Sequence[bytes]) -> Contender:
    """Prepare the package rplidar, which converts each node."""
    parse = library("rplidar")._process_scan
    return Contender(lambda: [parse(frame) for frame in frames], len(frames))


def lds2d_stream(model: str, data: bytes, points: int) -> Contender:
    """Prepare lds2d's driver on a byte stream."""
    driver = library("lds2d").core.driver_for(model)
    return Contender(lambda: _until_end(driver(_RecordedPort(data))), points)


class _RecordedPort:
    """A serial port for lds2d that returns recorded bytes."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._offset = 0

    def read(self, size: int) -> bytes:
        if self._offset >= len(self._data):
            raise EOFError
        self._offset += size
        return self._data[self._offset - size : self._offset]


def _until_end(driver: Any) -> int:
    found = 0
    try:
        for _ in driver.points():
            found += 1
    except EOFError:
        return found
    return found
