"""The main job with nothing attached: a simulated sensor in a room, damaged on the way, decoded and summed up."""

from __future__ import annotations

import random
from dataclasses import dataclass

from lidarspec.decoder import Counters
from lidarspec.scans import Scan, ScanStream
from lidarspec.simulator import opening, simulate
from lidarspec.spec import Sensor
from lidarspec.streams import PacketStream

#: packets simulated at a time.
BATCH = 256


@dataclass(frozen=True, eq=False)
class DemoResult:
    """What the demo saw: the scans, the decoder's counters, and how many frames were sent and left the line unharmed."""

    sensor: Sensor
    scans: tuple[Scan, ...]
    stats: Counters
    sent: int
    intact: int


def run(sensor: Sensor, *, turns: int = 5, errors: float = 0.01, seed: int = 1, most: int = 20_000) -> DemoResult:
    """Simulate until so many whole scans have come out of the decoder.

    Args:
        turns: whole scans wanted.
        errors: share of the bytes of a stream that are damaged, or of the datagrams that are lost.
        most: packets after which it ends in any case.
    """
    source = random.Random(seed)
    decoder = sensor.decoder()
    packets, scans = PacketStream(sensor, sensor.data_frame, decoder.stats), ScanStream(sensor)
    found: list[Scan] = []
    sent = intact = 0
    if decoder.stream:
        decoder.feed(opening(sensor))
    for start in range(0, most, BATCH):
        chunks = [_damaged(frame, source, errors, stream=decoder.stream) for frame in simulate(sensor, BATCH, start=start)]
        sent, intact = sent + len(chunks), intact + sum(unharmed for _, unharmed in chunks)
        data = [data for data, _ in chunks if data]
        spans = decoder.spans(b"".join(data)) if decoder.stream else [decoder.datagrams(data)]
        found += scans.add(packets.add(spans))
        if sum(scan.complete for scan in found) >= turns:
            break
    found += scans.add(packets.add(decoder.rest())) + scans.finish()
    return DemoResult(sensor, tuple(found), decoder.stats, sent, intact)


def _damaged(frame: bytes, source: random.Random, errors: float, *, stream: bool) -> tuple[bytes, bool]:
    """A frame after the line, and whether it came through unharmed."""
    if not stream:
        lost = source.random() < errors
        return (b"", False) if lost else (frame, True)
    out = bytearray()
    for byte in frame:
        if source.random() >= errors:
            out.append(byte)
        else:
            out += source.choice((b"", bytes([byte ^ 1 << source.randrange(8)]), bytes([byte, source.randrange(256)])))
    return bytes(out), out == frame
