"""Recognize bytes of known sensors that are not installed.

A sensor is recognized by the constant bytes at the start of its data frame, the frame size, and the
UDP ports. Several sensors of a vendor may share these values.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from lidarspec.detect.sample_bytes import SampleBytes
from lidarspec.errors import WireError, suggest
from lidarspec.framing.frame_engine import get_codec
from lidarspec.known_sensors import KnownSensor, Signature, install_command, known_sensors
from lidarspec.plugins import registry
from lidarspec.sensor_operations import Sensor

#: The maximum number of bytes at the start of a frame to put into a signature.
MAX_SYNC_BYTES = 16
#: The minimum number of constant bytes of a signature.
MIN_SYNC_BYTES = 2
#: The minimum share of the datagrams, or of the bytes of a stream, that must match a signature.
MIN_MATCHING_SHARE = 0.2
#: The minimum number of consecutive frames in a stream, for frames of fixed size.
MIN_CONSECUTIVE_FRAMES = 3
#: The minimum number of sync bytes in a stream, for frames of variable size.
MIN_SYNC_COUNT = 8
#: The minimum ratio of the number of sync bytes to the number that is expected in random bytes.
MIN_RATIO_TO_CHANCE = 20
#: The maximum number of sensors in a message.
MAX_LISTED_SENSORS = 6


def make_signatures(sensor: Sensor) -> tuple[Signature, ...]:
    """Return the signatures of a sensor's data frames.

    A frame type with fewer than `MIN_SYNC_BYTES` constant bytes at its start has no signature.
    """
    signatures = []
    for name in sensor.main_frames:
        engine = get_codec(sensor.frames[name])
        constant = {
            offset: value
            for offset, (mask, value) in engine.prefix.items()
            if mask == 0xFF and offset < MAX_SYNC_BYTES
        }
        signature = Signature(_format_sync(constant), engine.size or 0)
        if len(constant) >= MIN_SYNC_BYTES and signature not in signatures:
            signatures.append(signature)
    return tuple(signatures)


def _format_sync(constant: dict[int, int]) -> str:
    """Return the bytes at the start of a frame as text, such as "54 .. 2c".

    Args:
        constant: offset -> value. Other bytes become "..".
    """
    length = max(constant, default=-1) + 1
    return " ".join(
        f"{constant[offset]:02x}" if offset in constant else ".." for offset in range(length)
    )


def recognize(sample: SampleBytes) -> list[KnownSensor]:
    """Return the known sensors without a plugin that may have sent the bytes.

    If no frame matches, returns the sensors that send to a destination port of the sample.
    """
    installed = set(registry().names())
    missing = [row for row in known_sensors() if row.id not in installed]
    shares = [_measure_share(row, sample) if sample.size else 0.0 for row in missing]
    best = max(shares, default=0.0)
    matching = []
    if best >= MIN_MATCHING_SHARE:
        matching = [row for row, share in zip(missing, shares, strict=True) if share == best]
    at_port = [row for row in matching or missing if sample.ports & _find_udp_ports(row)]
    return at_port or matching


def _find_udp_ports(row: KnownSensor) -> set[int]:
    return {port for link in row.links.values() if link.kind == "udp" for port in link.numbers}


def _measure_share(row: KnownSensor, sample: SampleBytes) -> float:
    """Return the share of the sample that matches a signature of the sensor."""
    is_datagram = any(link.kind == "udp" for link in row.links.values())
    if is_datagram != sample.datagrams:
        return 0.0
    if sample.datagrams:
        measure = _measure_datagrams
    else:
        measure = _measure_stream
    return max((measure(signature, sample) for signature in row.signatures), default=0.0)


def _make_pattern(sync: str) -> bytes:
    """Return a regular expression that matches sync bytes, given as hexadecimal text."""
    return b"".join(
        b"." if byte == ".." else re.escape(bytes.fromhex(byte)) for byte in sync.split()
    )


def _measure_datagrams(signature: Signature, sample: SampleBytes) -> float:
    begins = re.compile(_make_pattern(signature.sync), re.DOTALL)
    if signature.size:
        sizes = {signature.size}
    else:
        sizes = {len(datagram) for datagram in sample.chunks}
    count = sum(
        begins.match(datagram) is not None for datagram in sample.chunks if len(datagram) in sizes
    )
    return count / len(sample.chunks)


def _measure_stream(signature: Signature, sample: SampleBytes) -> float:
    data = sample.data
    offsets = [
        match.start()
        for match in re.finditer(b"(?=" + _make_pattern(signature.sync) + b")", data, re.DOTALL)
    ]
    if not signature.size:
        constant_bytes = sum(byte != ".." for byte in signature.sync.split())
        count_by_chance = len(data) / 256**constant_bytes
        min_count = max(MIN_SYNC_COUNT, MIN_RATIO_TO_CHANCE * count_by_chance)
        if len(offsets) >= min_count:
            return MIN_MATCHING_SHARE
        return 0.0
    starts = set(offsets)
    has_next = sum(offset + signature.size in starts for offset in offsets)
    count = has_next + 1 if offsets else 0
    is_whole = count * signature.size == len(data)
    if count < MIN_CONSECUTIVE_FRAMES and not is_whole:
        return 0.0
    return min(1.0, count * signature.size / len(data))


def describe(sensors: Sequence[KnownSensor]) -> str:
    """Return a message with the sensors and the distributions to install."""
    ids = [row.id for row in sensors[:MAX_LISTED_SENSORS]]
    more = len(sensors) - len(ids)
    if more:
        listed = f"{', '.join(ids)} and {more} more"
    else:
        listed = " or ".join(ids)
    distributions = _list_distributions(sensors)
    verb = "are" if len(distributions) > 1 else "is"
    return f"this looks like data of {listed}; {' and '.join(distributions)} {verb} not installed"


def suggest_installation(error: WireError, sample: SampleBytes) -> WireError:
    """Add an installation note to an error about unknown bytes; return the error.

    The note names the known sensors that may have sent the bytes, and the distributions to install.
    Without such a sensor, the error is not changed.
    """
    missing = recognize(sample)
    if missing:
        error.add_note(describe(missing))
        suggest(error, make_install_command(missing))
    return error


def make_install_command(sensors: Sequence[KnownSensor]) -> str:
    """Return the command that installs the distributions of the sensors."""
    return install_command(*_list_distributions(sensors))


def _list_distributions(sensors: Sequence[KnownSensor]) -> list[str]:
    return sorted({row.distribution for row in sensors})
