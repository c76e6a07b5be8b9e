"""What a user would pick instead: construct on plain structs without adapters, and the libraries for one format each."""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from construct import Array, Bytes, Const, If, Int8ub, Int8ul, Int16ub, Int16ul, Int32ub, Int32ul, Struct, this
from measure import Contender

#: distribution of each library, by what it is called in the table.
LIBRARIES = ("dpkt", "velodyne-decoder", "ouster-sdk", "lds2d", "rplidar")

STRUCTS = {
    "m1": Struct(
        "magic" / Const(b"\x55\xaa\x5a\xa5"),
        "pkt_psn" / Int16ub,
        "protocol_version" / Int16ub,
        "wave_mode" / Int8ub,
        "time_sync_mode" / Int8ub,
        "seconds" / Bytes(6),
        "microseconds" / Int32ub,
        "reserved" / Bytes(10),
        "lidar_type" / Int8ub,
        "mems_tmp" / Int8ub,
        "blocks"
        / Array(
            25,
            Struct(
                "time_offset" / Int8ub,
                "return_seq" / Int8ub,
                "channels"
                / Array(
                    5,
                    Struct(
                        "radius" / Int16ub, "elevation" / Int16ub, "azimuth" / Int16ub, "intensity" / Int8ub, "reserved" / Bytes(2)
                    ),
                ),
            ),
        ),
        "tail" / Bytes(3),
    ),
    "stl27l": Struct(
        "header" / Const(b"\x54\x2c"),
        "speed" / Int16ul,
        "start_angle" / Int16ul,
        "points" / Array(12, Struct("distance" / Int16ul, "intensity" / Int8ul)),
        "end_angle" / Int16ul,
        "timestamp" / Int16ul,
        "crc" / Int8ul,
    ),
    "m1c1": Struct(
        "header" / Const(b"\xaa\x55"),
        "mt" / Int8ul,
        "lsn" / Int8ul,
        "fsa" / Int16ul,
        "lsa" / Int16ul,
        "cs" / Int16ul,
        "samples" / Array(this.lsn, Struct("low" / Int8ul, "middle" / Int8ul, "high" / Int8ul)),
    ),
    "vlp16": Struct(
        "blocks"
        / Array(
            12,
            Struct(
                "flag" / Const(b"\xff\xee"),
                "azimuth" / Int16ul,
                "channels" / Array(32, Struct("distance" / Int16ul, "intensity" / Int8ul)),
            ),
        ),
        "timestamp" / Int32ul,
        "return_mode" / Int8ul,
        "product" / Int8ul,
    ),
    "xt32": Struct(
        "sync" / Const(b"\xee\xff"),
        "version" / Bytes(4),
        "lasers" / Int8ul,
        "block_count" / Int8ul,
        "first_return" / Int8ul,
        "dis_unit" / Int8ul,
        "return_count" / Int8ul,
        "flags" / Int8ul,
        "blocks"
        / Array(
            this.block_count,
            Struct(
                "azimuth" / Int16ul,
                "channels" / Array(this._.lasers, Struct("distance" / Int16ul, "reflectivity" / Int8ul, "reserved" / Int8ul)),
            ),
        ),
        "tail" / Bytes(24),
        "sequence" / If(this.flags == 1, Int32ul),
    ),
    "rplidar": Struct("head" / Int8ul, "beam" / Int16ul, "distance" / Int16ul),
}


class Missing(Exception):
    """A library that is not installed."""


def library(module: str) -> Any:
    """The module of a library.

    Raises:
        Missing: where it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise Missing(module) from error


def versions() -> dict[str, str]:
    """The version of each library, or "not installed"."""
    found = {}
    for name in ("construct", "numpy", *LIBRARIES):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def construct_on(key: str, frames: Sequence[bytes], points: int, *, compiled: bool) -> Contender:
    """construct parsing these frames one after another; no points are made of them."""
    parse: Callable[[bytes], Any] = (STRUCTS[key].compile() if compiled else STRUCTS[key]).parse
    return Contender(lambda: [parse(frame) for frame in frames], points)


def velodyne_packets(frames: Sequence[bytes], points: int) -> Contender:
    """velodyne-decoder on VLP-16 packets, 76 to a scan, its vectors of packets made beforehand."""
    vd = library("velodyne_decoder")
    config = vd.Config()
    config.model = vd.Model.VLP16
    packets = [vd.VelodynePacket(index / 754, frame) for index, frame in enumerate(frames)]
    scans = [vd.PacketVector(packets[start : start + 76]) for start in range(0, len(packets), 76)]
    decoder = vd.ScanDecoder(config)
    return Contender(lambda: [decoder.decode(scan) for scan in scans], points)


def velodyne_pcap(path: Path, points: int) -> Contender:
    """velodyne-decoder on a pcap file of VLP-16 packets."""
    vd = library("velodyne_decoder")
    config = vd.Config()
    config.model = vd.Model.VLP16
    return Contender(lambda: list(vd.read_pcap(str(path), config)), points)


def dpkt_payloads(path: Path, packets: int) -> Contender:
    """dpkt's objects, from Ethernet to the payload of UDP."""
    dpkt = library("dpkt")

    def run() -> int:
        with path.open("rb") as file:
            return sum(len(dpkt.ethernet.Ethernet(data).data.data.data) for _, data in dpkt.pcap.Reader(file))

    return Contender(run, packets)


def ouster_payloads(path: Path, packets: int) -> Contender:
    """The C++ reader under ouster-sdk: the payloads of a capture into one buffer."""
    pcap = library("ouster.sdk._bindings.pcap")
    buffer = np.empty(1 << 16, np.uint8)

    def run() -> int:
        capture, info, total = pcap.replay_initialize(str(path)), pcap.PacketInfo(), 0
        while pcap.next_packet_info(capture, info):
            total += pcap.read_packet(capture, buffer)
        pcap.replay_uninitialize(capture)
        return total

    return Contender(run, packets)


def rplidar_nodes(frames: Sequence[bytes]) -> Contender:
    """The package rplidar, what it makes of each node."""
    parse = library("rplidar")._process_scan
    return Contender(lambda: [parse(frame) for frame in frames], len(frames))


def lds2d_stream(model: str, data: bytes, points: int) -> Contender:
    """lds2d's driver on a byte stream."""
    driver = library("lds2d.core").driver_for(library("lds2d") and model)
    return Contender(lambda: _until_end(driver(_Recorded(data))), points)


class _Recorded:
    """A serial port for lds2d that has sent all its bytes in the end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._spot = data, 0

    def read(self, size: int) -> bytes:
        if self._spot >= len(self._data):
            raise EOFError
        self._spot += size
        return self._data[self._spot - size : self._spot]


def _until_end(driver: Any) -> int:
    found = 0
    try:
        for _ in driver.points():
            found += 1
    except EOFError:
        return found
    return found
