"""Tests of parts with their own sizes: read, built and checked, singly and in bulk."""

from __future__ import annotations

import dataclasses
import random
from typing import Any

import pytest
from construct import (
    Array,
    Bytes,
    Const,
    CString,
    GreedyBytes,
    Int8ub,
    Int16ub,
    Int32ub,
    NullTerminated,
    Struct,
    this,
)

import lidarspec as ls
from lidarspec import Sensor, SpecError, UsageError, WireError
from lidarspec.frames.layout_tree import HeaderNode, HeaderTree
from lidarspec.spec import Checksummed, Clock, Frame, Parts, Scaled, Simulation, SizeOf, Sum, Xor
from tests.agreement import assert_backends_agree
from tests.by_construct import reader
from tests.engine import against_construct
from tests.engine.streams import Books
from tests.shapes import SHAPES

SEGMENTS, TAGS, CHANNELS = (SHAPES[f"shape-{name}"] for name in ("segments", "tags", "channels"))


def tags(*parts: dict[str, Any], **values: Any) -> bytes:
    size = 7 + sum(
        2
        + 4 * len(part.get("points", ()))
        + len(part.get("content", b""))
        + 2 * ("temperature" in part)
        for part in parts
    )
    return TAGS.build("data", number=1, tags=list(parts), padding=bytes(-size % 8), **values)


def pair(distance: int, angle: int) -> dict[str, int]:
    return dict(distance=distance, angle=angle)


def test_the_marker_of_the_last_part_is_filled_in() -> None:
    data = tags(dict(type=1, points=[pair(100, 0), pair(200, -1)]), dict(type=9, content=b"abc"))
    assert data[4:-1].hex(" ") == "01 02 01 08 64 00 00 00 c8 00 ff ff 09 03 61 62 63 00 00"
    parsed = TAGS.parse(data)
    assert (parsed.count, [tag.type for tag in parsed.tags], parsed.tags[0].points[1].distance) == (
        2,
        [1, 9],
        200,
    )
    segment = dict(
        turn=1,
        channels=1,
        beams=2,
        time=5,
        start=0,
        elevations=[4],
        data=[[dict(distance=1, strength=2)]] * 2,
    )
    chain = SEGMENTS.parse(
        SEGMENTS.build(
            "data",
            counter=7,
            step=15,
            segments=[segment, {**segment, "beams": 1, "data": segment["data"][:1]}],
        )
    )
    assert (chain.first_size, [part.next_size for part in chain.segments]) == (19, [16, 0])
    assert SEGMENTS.parse(SEGMENTS.build("data", counter=7, step=15, segments=[])).first_size == 0
    filled = CHANNELS.build("data", wide=0, azimuth=100, channels=[dict(ring=3, distances=[1, 2])])
    assert filled.hex(" ") == "ca 5c 00 00 05 00 64 03 02 01 02 02"


@pytest.mark.parametrize("sensor", [SEGMENTS, TAGS, CHANNELS], ids=lambda sensor: sensor.id)
def test_parts_are_read_as_construct_reads_them(sensor: Sensor) -> None:
    frames = [sensor.example("data", seed=seed) for seed in range(5)]
    for data in frames:
        assert sensor.build("data", sensor.parse(data)) == data
        assert sensor.build("data", sensor.parse(data, units=True), units=True) == data
    assert_backends_agree(sensor, frames if sensor.datagrams else b"".join(frames))


def test_a_part_is_a_packet_without_padding_and_knows_its_frame() -> None:
    frames = [
        tags(
            dict(type=1, points=[pair(1, 0)]),
            dict(type=7, content=b""),
            dict(type=1, points=[pair(2, 0), pair(3, 0)]),
        )
    ]
    frames += [tags(dict(type=2, temperature=-5)), tags(dict(type=1, points=[pair(4, 0)]))]
    packets = TAGS.decode(b"".join(frames))
    parts = packets.parts("tags.points")
    assert packets.count("tags").tolist() == [3, 1, 1]
    assert (len(parts), parts["length"].tolist(), parts.count("points").tolist()) == (
        3,
        [4, 8, 4],
        [1, 2, 1],
    )
    assert parts.offset.tolist() == [packets.offset[0]] * 2 + [packets.offset[2]]
    assert parts.frames[0] is packets.table
    assert parts.index.tolist() == [packets.index[0]] * 2 + [packets.index[2]]
    assert packets.parts("tags.temperature")["temperature"].tolist() == [-0.5]
    assert packets.points().range.tolist() == pytest.approx([0.01, 0.02, 0.03, 0.04])
    with pytest.raises(UsageError, match=r"tags\.points"):
        packets.parts("tags")
    with pytest.raises(UsageError, match="tags"):
        packets.parts("tag")


def test_the_clock_of_a_part_is_its_own() -> None:
    def segment(time: int) -> dict[str, Any]:
        return dict(
            turn=0,
            channels=1,
            beams=1,
            time=time,
            start=0,
            elevations=[0],
            data=[[dict(distance=1000, strength=0)]],
        )

    times = [[2**32 - 10, 5], [], [20, 30, 50]]
    frames = [
        SEGMENTS.build("data", counter=i, step=10, segments=[segment(time) for time in own])
        for i, own in enumerate(times)
    ]
    for backend in ("auto", "construct"):
        packets = reader(SEGMENTS, backend).decode(frames)
        first = (2**32 - 10) * 1000
        assert (packets.time_ns - first).tolist() == [0, 0, 30_000]
        assert (packets.parts("segments").time_ns - first).tolist() == [
            0,
            15_000,
            30_000,
            40_000,
            60_000,
        ]


@pytest.mark.parametrize("backend", ["auto", "construct"])
def test_the_clock_in_a_part_of_a_frame_without_points(backend: str) -> None:
    time = Struct("kind" / Const(1, Int8ub), "seconds" / Scaled(Int16ub, 0.001, "s"))
    heat = Struct("kind" / Const(2, Int8ub), "temperature" / Scaled(Int16ub, 0.1, "degC"))
    report = Struct(
        "head" / Const(b"\xc5\x02\x03"),
        "count" / Int8ub,
        "tags" / Parts({"time": time, "heat": heat}, this.count),
    )
    logger = dataclasses.replace(
        against_construct.sensor(report, max_length=99),
        frames={"data": Frame(report, max_length=99)},
        clock=Clock("tags.time.seconds"),
        points=None,
        scan=None,
    )
    frames = [
        logger.build("data", tags=[dict(kind=1, seconds=ms), dict(kind=2, temperature=5)])
        for ms in (1500, 2500)
    ]
    packets = reader(logger, backend).decode(frames, "data")
    assert packets.time_ns.tolist() == [1_500_000_000, 2_500_000_000]


def test_a_part_is_built_as_the_kind_with_no_further_fields() -> None:
    pair = Struct("kind" / Const(2, Int8ub), "a" / Int8ub, "next" / Const(3, Int8ub), "b" / Int8ub)
    single = Struct("kind" / Const(2, Int8ub), "a" / Int8ub)
    report = Struct(
        "count" / Int8ub,
        "tags" / Parts({"pair": pair, "single": single}, this.count),
        "end" / Const(b"\x99\x98"),
    )
    sensor = against_construct.sensor(report, max_length=99)
    frame = bytes.fromhex("03 02 07 02 08 03 01 02 09 99 98")
    parsed = sensor.parse(frame)
    assert [tag.a for tag in parsed.tags] == [7, 8, 9]
    assert sensor.build("data", parsed) == frame


FOUR = Struct("kind" / Const(4, Int8ub), "value" / Int16ub)
CHECKSUMMED = Checksummed(
    Struct("kind" / Const(5, Int8ub), "value" / Int8ub, "sum" / Int8ub),
    field="sum",
    algorithm=Xor(),
)
COUNTED = Struct(
    "count" / Int8ub, "parts" / Parts({"four": FOUR, "checksummed": CHECKSUMMED}, this.count)
)
LINK = Struct("next" / Int8ub, "x" / Bytes(this.next % 3))
CHAIN = Struct(
    "first" / Int8ub, "parts" / Parts(LINK, size=this.first, following=this.next), "end" / Int8ub
)
FILLING = Struct("n" / Int8ub, "x" / Array(this.n, Int8ub))
WITHIN = Struct("size" / Int8ub, "parts" / Parts(FILLING, within=this.size), "end" / Int8ub)
OUTER = Struct("x" / Bytes(this._.wide))
AROUND = Struct(
    "wide" / Int8ub,
    "count" / Int8ub,
    "parts" / Parts(OUTER, this.count),
    "rest" / Bytes(this.parts.size % 4),
)
#: structs, with frames of theirs and what is none.
FRAMES = {
    "count": (
        COUNTED,
        ["00", "01 04 00 09", "02 05 01 04 04 00 01"],
        ["01 09 00 09", "01 05 01 05"],
    ),
    "chain": (CHAIN, ["00 07", "01 00 07", "02 01 aa 00 07"], ["03 02 aa bb 03 07", "01 01 00 00"]),
    "within": (
        WITHIN,
        ["00 09", "01 00 09", "05 00 01 07 01 08 09"],
        ["02 03 01 09", "02 02 01 01 09"],
    ),
    "around": (
        AROUND,
        ["02 01 aa bb cc dd", "01 04 01 02 03 04", "03 01 aa bb cc 01 02 03"],
        ["00 01", "02 01 aa bb"],
    ),
}


@pytest.mark.parametrize("name", FRAMES)
def test_frames_are_valid_exactly_if_construct_parses_them(name: str) -> None:
    struct, good, bad = FRAMES[name]
    whole = list(map(bytes.fromhex, good))
    assert against_construct.agree(struct, [*whole, *map(bytes.fromhex, bad)]) == len(whole)
    damaged = [
        data[:spot] + bytes([byte]) + data[spot + 1 :]
        for data in whole
        for spot in range(len(data))
        for byte in (0, 1, 4, 5, 0xFF)
    ]
    against_construct.agree(
        struct,
        [*damaged, *(data[:-1] for data in whole), *(data + b"\0" for data in whole)],
        kept=False,
    )


def test_invalid_parts_are_refused_when_they_are_declared() -> None:
    with pytest.raises(SpecError, match="count="):
        Parts(FOUR, this.count, within=this.size)
    with pytest.raises(SpecError, match="count="):
        Parts(FOUR, size=this.size)
    with pytest.raises(SpecError, match="Struct"):
        Parts(Int8ub, this.count)
    with pytest.raises(SpecError, match="'frame'"):
        Frame(Struct("parts" / Parts(Struct("frame" / Int8ub), count=2)), max_length=9)
    with pytest.raises(SpecError, match="points"):
        Frame(Struct("parts" / Parts(FOUR, count=2)), max_length=9, points={})


def test_a_wrong_part_is_reported_with_its_place() -> None:
    data = CHANNELS.build(
        "data",
        wide=0,
        azimuth=100,
        channels=[dict(ring=3, distances=[1, 2]), dict(ring=4, distances=[])],
    )
    with pytest.raises(WireError) as fault:
        CHANNELS.parse(data[:-1] + b"\x05")
    assert (fault.value.path, fault.value.offset) == ("channels[1].check", 14)
    assert "0x05, expected 0x04" in fault.value.reason
    with pytest.raises(UsageError, match=r"tags\[0\].points\[0\].distance.*70000"):
        tags(dict(type=1, points=[pair(70_000, 0)]))
    assert CHANNELS.decode(data[:-1] + b"\x05" + data).stats.bad_checksum == 1
    with pytest.raises(WireError) as fault:
        against_construct.sensor(COUNTED).parse(bytes.fromhex("01 09 00 09"))
    assert (fault.value.path, fault.value.offset) == ("parts[0].kind", 1)


def test_a_wrong_part_is_reported_before_the_bytes_behind_the_parts() -> None:
    part = Struct("mark" / Const(b"\xaa\xbb"), "size" / Int8ub, "text" / Bytes(this.size))
    filled = Parts(part, within=this.size)
    struct = Struct("head" / Bytes(10), "size" / Int8ub, "parts" / filled, "end" / Const(b"\x99"))
    sensor = against_construct.sensor(struct)
    texts = [{"text": b"abc"}, {"text": b"defg"}]
    data = bytearray(sensor.build("data", head=bytes(10), parts=texts))
    data[data.rindex(b"\xbb")] = 0xBA
    with pytest.raises(WireError) as fault:
        sensor.parse(bytes(data))
    assert (fault.value.path, fault.value.offset) == ("parts[1].mark", 17)
    assert "constant aa ba, expected aa bb" in fault.value.reason
    last = ls.explain(bytes(data), sensor).rows[-1]
    assert (last.path, last.data, last.matches_spec) == ("end", b"\x99", True)


def test_a_header_that_is_cut_off_is_reported_before_the_parts() -> None:
    part = Struct("size" / Int8ub, "text" / Bytes(this.size))
    struct = Struct("count" / Int8ub, "time" / Int32ub, "parts" / Parts(part, this.count))
    with pytest.raises(WireError) as fault:
        against_construct.sensor(struct).parse(b"\1\0\0")
    assert (fault.value.path, fault.value.offset) == ("time", 1)


def test_a_part_that_is_longer_than_the_parts_is_cut_off_by_their_end() -> None:
    part = Struct("n" / Int8ub, "text" / Bytes(this.n))
    struct = Struct("size" / Int8ub, "parts" / Parts(part, within=this.size), "end" / Bytes(4))
    with pytest.raises(
        WireError, match=r"the sequence of parts ends at byte 4: parts\[0\].text requires 5 bytes"
    ):
        against_construct.sensor(struct).parse(b"\3\5abcdef")


def test_a_wrong_length_in_a_part_is_reported_with_its_place() -> None:
    part = Struct("size" / SizeOf(Int8ub, "text"), "n" / Int8ub, "text" / Bytes(this.n))
    struct = Struct("size" / SizeOf(Int8ub, "name"), "name" / Bytes(2), "parts" / Parts(part, 2))
    sensor = against_construct.sensor(struct)
    texts = [{"text": b"abc"}, {"text": b"defg"}]
    data = bytearray(sensor.build("data", name=b"xy", parts=texts))
    data[8] = 9
    with pytest.raises(WireError) as fault:
        sensor.parse(bytes(data))
    found = fault.value
    assert (found.path, found.offset, found.expected, found.got) == ("parts[1].size", 8, 4, 9)


def test_parts_with_texts_that_end_at_a_mark_are_built() -> None:
    name = Struct("type" / Const(1, Int8ub), "name" / CString("ascii"))
    raw = Struct("type" / Const(2, Int8ub), "raw" / NullTerminated(GreedyBytes))
    struct = Struct(
        "size" / Int8ub,
        "title" / CString("ascii"),
        "parts" / Parts({"name": name, "raw": raw}, within=this.size),
    )
    sensor = against_construct.sensor(struct)
    data = sensor.build("data", title="t", parts=[{"name": "abc"}, {"raw": b"z"}, {"name": ""}])
    assert data == b"\x0at\0" + b"\1abc\0" + b"\2z\0" + b"\1\0"
    assert sensor.build("data", sensor.parse(data)) == data
    with pytest.raises(UsageError, match=r"parts\[0\].raw: expected bytes without 00, got b'a"):
        sensor.build("data", title="", parts=[{"raw": b"a\0b"}])


def test_both_engines_count_unknown_parts_equally() -> None:
    sensor, data = against_construct.sensor(COUNTED), bytes.fromhex("01 09 00 09")
    assert_backends_agree(sensor, [data, bytes.fromhex("01 04 00 09")])
    assert (sensor.decode([data]).stats.bad_constant, sensor.decode([data]).stats.bad_length) == (
        1,
        0,
    )


def test_garbage_between_long_chains_is_walked_in_linear_time() -> None:
    """Each byte of the garbage begins a chain of parts; the frame after it is found."""
    link = Struct("next" / Int8ub, "x" / Bytes(3))
    struct = Checksummed(
        Struct(
            "head" / Const(b"\x04"),
            "first" / Int8ub,
            "parts" / Parts(link, size=this.first, following=this.next),
            "sum" / Int16ub,
        ),
        field="sum",
        algorithm=Sum(16, order="big"),
    )
    sensor = against_construct.sensor(struct, max_length=400)
    frame = sensor.build("data", parts=[dict(x=bytes(3))] * 5)
    decoder = sensor.decoder(stream=True)
    found = decoder.feed(b"\x04" * 20_000 + frame) + decoder.finish()
    assert [item.data for item in found] == [frame]


@pytest.mark.parametrize("sensor", [SEGMENTS, TAGS, CHANNELS], ids=lambda sensor: sensor.id)
def test_parts_know_which_frame_they_are_in(sensor: Sensor) -> None:
    frames = [sensor.example("data", seed=seed) for seed in range(6)]
    packets = sensor.decode(frames if sensor.datagrams else b"".join(frames))
    parts = packets.with_points
    assert len(parts.table.groups) > 1  # type: ignore[attr-defined]
    frames, which = parts.frames
    assert frames is packets.table
    assert (packets.offset[which] == parts.offset).all()
    assert (packets.index[which] == parts.index).all()


#: Bytes of the longest frame of `make_numbered_sensor`, and false headers of a stream.
LONGEST = 60
FALSE_HEADERS = 300


def make_numbered_sensor() -> Sensor:
    """Return a sensor with frames that give the number of parts in four bytes."""
    kinds = {
        "short": Struct("type" / Const(b"\x01"), "value" / Int8ub),
        "long": Struct("type" / Const(b"\x02"), "length" / Int8ub, "content" / Bytes(this.length)),
    }
    struct = Struct(
        "header" / Const(b"\xaa\x55"), "count" / Int32ub, "parts" / Parts(kinds, count=this.count)
    )
    frames = {"data": Frame(struct, max_length=LONGEST)}
    return dataclasses.replace(
        TAGS, id="shape-numbered", frames=frames, points=None, scan=None, simulation=Simulation()
    )


def test_numbers_of_parts_above_the_longest_frame_are_one_layout(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sensor = make_numbered_sensor()
    walks = 0
    explore = HeaderTree._explore

    def counting(self: HeaderTree, *arguments: Any, **named: Any) -> HeaderNode:
        nonlocal walks
        walks += 1
        return explore(self, *arguments, **named)

    monkeypatch.setattr(HeaderTree, "_explore", counting)
    source = random.Random(1)
    parts = [b"\x01\x07", b"\x02\x01\x09", b"\x02\xff", b"\x03", b""]
    data = b"".join(
        b"\xaa\x55" + source.randbytes(4) + b"".join(source.choices(parts, k=5))
        for _ in range(FALSE_HEADERS)
    )
    decoder = sensor.decoder()
    assert not decoder.feed(data)
    assert not decoder.finish()
    assert walks < FALSE_HEADERS // 5


@pytest.mark.parametrize("count", [0, 1, 2, 26, 27, 54, 55, 2**31, 2**32 - 1])
def test_errors_in_part_counts_match_construct(count: int) -> None:
    sensor = make_numbered_sensor()
    for part in (b"\x01\x07", b"\x02\x00", b"\x03"):
        data = b"\xaa\x55" + count.to_bytes(4, "big") + part * 40
        found = {
            backend: (Books(sensor, backend=backend).feed(data).finish())
            for backend in ("numpy", "construct")
        }
        assert found["numpy"] == found["construct"]
