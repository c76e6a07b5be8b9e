"""Tests of damaged, truncated and hostile captures.

The reader returns all readable packets, counts the rest, and uses bounded memory.
"""

from __future__ import annotations

import io
import random
import struct
import tracemalloc
from collections import Counter
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

import pytest

from lidarspec.captures.pcap import CaptureReader, CaptureStats
from lidarspec.captures.records import is_capture
from lidarspec.errors import SourceError
from tests import made_captures as made

FRAME = made.frame(b"one")
HEAD = made.section() + made.interface()
GOOD = made.packet(FRAME)
END = len(HEAD + GOOD)
# For each block: the datagrams that are read of GOOD, the block and GOOD, and the counters.
DAMAGE: dict[str, tuple[bytes, int, dict[str, Any]]] = {
    "unknown kind": (made.block(0x80001234, b"private!"), 2, {}),
    "unknown kind, longer than is ever held": (made.block(0x0BAD, bytes(3 << 20)), 2, {}),
    "name resolution and statistics": (made.block(4, bytes(4)) + made.block(5, bytes(12)), 2, {}),
    "packet, longer than is ever held": (
        made.block(made.ENHANCED, bytes(3 << 20)),
        2,
        {"malformed": 1, "damaged": 1, "lost": 12 + (3 << 20)},
    ),
    "interface, longer than is ever held": (
        made.block(made.INTERFACE, bytes(3 << 20)),
        1,
        {"malformed": 1, "damaged": 1, "lost": 12 + (3 << 20) + len(GOOD), "stopped_at": END},
    ),
    "length 0": (
        made.block(made.ENHANCED, b"", length=0),
        2,
        {"malformed": 1, "damaged": 1, "lost": 12},
    ),
    "length 8": (made.block(0x0BAD, b"", length=8), 2, {"malformed": 1, "damaged": 1, "lost": 12}),
    "length not a multiple of 4": (
        made.block(0x0BAD, b"ab"),
        2,
        {"malformed": 1, "damaged": 1, "lost": 14},
    ),
    "length beyond the file": (
        made.block(0x0BAD, b"", length=0x8000),
        2,
        {"malformed": 1, "damaged": 1, "lost": 12},
    ),
    "length of 4 GiB": (
        made.block(0x0BAD, b"", length=0xFFFFFFFC),
        2,
        {"malformed": 1, "damaged": 1, "lost": 12},
    ),
    "lengths differ": (
        made.block(0x0BAD, b"", trailer=16),
        2,
        {"malformed": 1, "damaged": 1, "lost": 12},
    ),
    "lengths differ, packet": (
        made.block(made.ENHANCED, GOOD[8:-4], trailer=12),
        2,
        {"malformed": 1, "damaged": 1, "lost": len(GOOD)},
    ),
    "lengths differ, interface": (
        made.block(made.INTERFACE, bytes(8), trailer=12),
        1,
        {"malformed": 1, "damaged": 1, "lost": 20 + len(GOOD), "stopped_at": END},
    ),
    "interface without its fields": (
        made.block(made.INTERFACE, bytes(4)),
        1,
        {"malformed": 1, "damaged": 1, "lost": 16 + len(GOOD), "stopped_at": END},
    ),
    "more interfaces than are ever held": (
        made.interface() * 1024,
        1,
        {"malformed": 1, "damaged": 1, "lost": 20 + len(GOOD), "stopped_at": END + 1023 * 20},
    ),
    "byte order magic": (
        made.block(0x0A0D0D0A, bytes(16)),
        2,
        {"malformed": 1, "damaged": 1, "lost": 28},
    ),
    "unknown interface": (made.packet(FRAME, number=1), 2, {"malformed": 1}),
    "unknown interface, obsolete": (
        made.packet(FRAME, number=1, kind=made.OBSOLETE),
        2,
        {"malformed": 1},
    ),
    "more captured than the block holds": (
        made.packet(FRAME, captured=len(FRAME) + 4),
        2,
        {"malformed": 1},
    ),
    "more captured, 4 GiB": (made.packet(FRAME, captured=0xFFFFFFFF), 2, {"malformed": 1}),
    "less captured than the block holds": (
        made.packet(FRAME, captured=len(FRAME) - 1),
        2,
        {"packets": 3, "snapped": 1},
    ),
    "packet without its fields": (made.block(made.ENHANCED, bytes(16)), 2, {"malformed": 1}),
    "simple packet without its field": (made.block(made.SIMPLE, b""), 2, {"malformed": 1}),
    "simple packet beyond its block": (made.block(made.SIMPLE, b"\x0c\0\0\0"), 2, {"malformed": 1}),
    "time beyond int64": (made.packet(FRAME, ticks=1 << 63), 2, {"malformed": 1}),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_damaged_blocks_are_passed_over_or_end_the_reading(case: str) -> None:
    damaged, count, counted = DAMAGE[case]
    data, stats = made.payloads(HEAD + GOOD + damaged + GOOD)
    assert data == [b"one"] * count
    assert stats == CaptureStats(**{"packets": count, "datagrams": count, **counted})


def test_record_too_long_for_a_packet_ends_the_reading_where_none_follows() -> None:
    capture, size = made.pcap(FRAME), (1 << 18) + 1
    long = struct.pack("<IIII", 0, 0, size, size) + bytes(size)
    counted = CaptureStats(packets=1, datagrams=1, malformed=1, damaged=1, lost=len(long))
    assert made.payloads(capture + long) == ([b"one"], replace(counted, stopped_at=len(capture)))
    following = made.record(FRAME) * 2
    assert made.payloads(capture + long + following) == (
        [b"one"] * 3,
        replace(counted, packets=3, datagrams=3),
    )


@pytest.mark.parametrize("is_pcapng", [False, True], ids=["pcap", "pcapng"])
def test_a_damaged_length_costs_one_packet(is_pcapng: bool) -> None:
    frames = [made.frame(bytes([number]) * 1200) for number in range(200)]
    records = [made.packet(each) if is_pcapng else made.record(each) for each in frames]
    head = made.section() + made.interface() if is_pcapng else made.pcap_head()
    draw = random.Random(4)
    for _ in range(25):
        at = draw.randrange(len(records))
        whole = records[at]
        place, length = (4, len(whole)) if is_pcapng else (8, len(whole) - 16)
        wrong = draw.choice(
            [length ^ 1 << draw.randrange(32), draw.randrange(300_000), draw.randrange(1 << 32)]
        )
        damaged = whole[:place] + struct.pack("<I", wrong) + whole[place + 4 :]
        found, stats = made.payloads(head + b"".join([*records[:at], damaged, *records[at + 1 :]]))
        others = [bytes([number]) * 1200 for number in range(200) if number != at]
        assert (found, stats.damaged, stats.lost, stats.stopped_at) == (
            others,
            1,
            len(whole),
            None if at < 199 else stats.stopped_at,
        )


def test_bytes_missing_from_a_file_and_a_hole_in_it_cost_the_packets_they_touch() -> None:
    frames = [made.frame(bytes([number]) * 1200) for number in range(200)]
    capture = made.pcap(*frames)
    size = len(made.record(frames[0]))
    for begin, gone in ((size * 50 + 90, 700), (size * 50 + 8, 2 * size + 5), (size * 50, 20)):
        found, stats = made.payloads(capture[:begin] + capture[begin + gone :])
        assert (stats.damaged, stats.stopped_at) == (1, None)
        assert len(found) >= 200 - 2 - -(-gone // size)
    hole = bytes(4096)
    found, stats = made.payloads(
        capture[: size * 50 + 300] + hole + capture[size * 50 + 300 + len(hole) :]
    )
    assert (len(found), stats.damaged, stats.stopped_at) == (197, 1, None)


def test_cut_packets_without_a_snap_length_are_not_damage() -> None:
    cut = [
        made.record(made.frame(bytes(400))[: 100 + number], original=442) for number in range(50)
    ]
    stats = made.read(made.pcap_head() + b"".join([*cut, made.record(FRAME), *cut]))[1]
    assert stats == CaptureStats(packets=101, datagrams=1, snapped=100)


def test_long_files_are_split_at_reported_offsets() -> None:
    capture = made.pcap(*[made.frame(bytes(1248))] * 300)
    expected = CaptureStats(
        packets=299, datagrams=299, truncated_tail=True, stopped_at=24 + 299 * 1306
    )
    assert made.read(capture[:-1])[1] == expected


@pytest.mark.parametrize("head", [b"", b"\xd4\xc3\xb2", b"PK\x03\x04 and more", b"# .PCD v0.7\n"])
def test_another_file_is_refused_with_its_first_bytes(head: bytes) -> None:
    assert not is_capture(head)
    with pytest.raises(SourceError, match=head[:4].hex(" ") or "empty"):
        CaptureReader(io.BytesIO(head))


PORTS = struct.pack(">HH", made.SOURCE[1], made.DESTINATION[1])  # in each part that is a packet
PCAP_PARTS = [
    made.pcap_head(),
    *(made.record(made.frame(data)) for data in (b"one", b"", b"three")),
]
PCAPNG_PARTS = [
    *(
        made.section(),
        made.interface(options=made.option(9, b"\x09")),
        GOOD,
        made.block(5, bytes(8)),
    ),
    *(
        made.packet(FRAME, kind=made.SIMPLE),
        made.section(">"),
        made.interface(">"),
        made.packet(FRAME, ">", kind=made.OBSOLETE),
    ),
]


@pytest.mark.parametrize("parts", [PCAP_PARTS, PCAPNG_PARTS], ids=["pcap", "pcapng"])
def test_truncated_at_every_byte_gives_all_complete_packets(parts: list[bytes]) -> None:
    capture = b"".join(parts)
    ends = list(accumulate(map(len, parts)))
    whole = made.read(capture)[0]
    assert len(whole) == 3
    for length in range(4, len(capture) + 1):
        datagrams, stats = made.read(capture[:length])
        complete = [end for end in ends if end <= length]
        is_cut = length not in ends
        count = sum(PORTS in part for part in parts[: len(complete)])
        assert datagrams == whole[:count]
        assert stats == CaptureStats(
            packets=count,
            datagrams=count,
            truncated_tail=is_cut,
            stopped_at=max(complete, default=0) if is_cut else None,
        )


@pytest.mark.parametrize("parts", [PCAP_PARTS, PCAPNG_PARTS], ids=["pcap", "pcapng"])
@pytest.mark.parametrize("inputs", [1000, pytest.param(5_000, marks=pytest.mark.slow)])
def test_mutations_raise_nothing_but_source_error(parts: list[bytes], inputs: int) -> None:
    draw = random.Random(14)
    capture = b"".join(parts)
    outcomes = Counter[str]()
    for _ in range(inputs):
        data = bytearray(capture)
        for _ in range(draw.randint(1, 6)):
            at = draw.randrange(len(data))
            edit = draw.randrange(4)
            if edit == 0:
                data[at] = draw.randrange(256)
            elif edit == 1:
                data[at : at + 4] = draw.choice(
                    [bytes(4), b"\xff" * 4, b"\0\0\0\x80", b"\x04\0\0\0"]
                )
            elif edit == 2:
                del data[at : at + draw.randint(1, 9)]
            else:
                data[at:at] = data[at : at + draw.randint(1, 40)]
        try:
            datagrams, stats = made.read(bytes(data))
        except SourceError:
            outcomes["refused"] += 1
            continue
        assert stats.datagrams == len(datagrams)
        assert stats.packets <= len(data) // 16
        assert stats.datagrams + stats.other + stats.snapped <= stats.packets
        assert stats.truncated_tail <= (stats.stopped_at is not None)
        outcomes.update(
            name
            for name in ("datagrams", "truncated_tail", "malformed", "stopped_at")
            if getattr(stats, name)
        )
    assert (
        min(
            outcomes[name]
            for name in ("refused", "datagrams", "truncated_tail", "malformed", "stopped_at")
        )
        > inputs / 50
    )


HUGE = struct.pack("<I", 0x7FFFFFFC)
HOSTILE = {
    "pcapng of 12 bytes": b"\x0a\x0d\x0d\x0a" + HUGE + b"\x4d\x3c\x2b\x1a",
    "pcapng block": HEAD + struct.pack("<I", 6) + HUGE + bytes(4),
    "pcap record": made.pcap_head() + bytes(8) + HUGE + HUGE,
    "pcap record within the limit": made.pcap_head()
    + bytes(8)
    + struct.pack("<II", 1 << 18, 1 << 18),
    "option": made.section() + made.interface(options=struct.pack("<HH", 2, 0xFFFF)) + GOOD,
}


@pytest.mark.parametrize("case", HOSTILE)
@pytest.mark.parametrize("buffering", [0, -1])
def test_declared_lengths_allocate_no_memory(case: str, buffering: int, tmp_path: Path) -> None:
    path = tmp_path / "hostile"
    path.write_bytes(HOSTILE[case])
    with open(path, "rb", buffering) as file:
        assert peak_memory(file) < 300_000


@pytest.mark.parametrize(
    "blocks",
    [
        pytest.param(made.block(0x0BAD, bytes(16 << 20)), id="block"),
        pytest.param(made.interface() * 50_000, id="interfaces"),
        pytest.param(made.packet(FRAME, number=1) * 10_000, id="packets"),
    ],
)
def test_long_files_take_bounded_memory(blocks: bytes) -> None:
    assert peak_memory(io.BytesIO(HEAD + blocks)) < 3 << 20


def peak_memory(file: BinaryIO) -> int:
    tracemalloc.start()
    try:
        for _ in CaptureReader(file):
            pass
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
