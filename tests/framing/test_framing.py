"""Tests of framing with input that has broken other parsers.

tests/engine tests the framing rule as a whole.
"""

from __future__ import annotations

import dataclasses
import random
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from construct import Array, Byte, Const, Int8ub, Int16ub, Struct, this

import lidarspec as ls
import lidarspec.spec
from lidarspec import Sensor, UsageError
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.spec import Checksummed, Frame, Sum, tree
from lidarspec.testing.sensor_under_test import SensorUnderTest, mutate
from tests.agreement import assert_backends_agree
from tests.by_construct import reader
from tests.engine import against_construct
from tests.engine.oracle import Oracle
from tests.engine.streams import Books, damage, decode_chunks
from tests.shapes import SHAPES

STREAMS = {name: sensor for name, sensor in SHAPES.items() if not sensor.datagrams}
#: about so many bytes to a stream: the oracle takes its time.
LENGTH = 1500
#: Datagrams that are judged together and alone.
DATAGRAMS = 150

each_stream = pytest.mark.parametrize("sensor", STREAMS.values(), ids=STREAMS)


def conversation(sensor: Sensor, *, seed: int = 0, length: int = LENGTH) -> bytes:
    rounds = max(length // len(SensorUnderTest(sensor).stream(rounds=1)), 1)
    return SensorUnderTest(sensor).stream(seed=seed, rounds=rounds)


@pytest.mark.parametrize("sensor", SHAPES.values(), ids=SHAPES)
def test_datagrams_of_any_size_raise_no_exception(sensor: Sensor) -> None:
    frame = sensor.example(sensor.data_frame, seed=3)
    data = [
        b"",
        frame[:1],
        frame[:-1],
        frame,
        frame + b"\x00",
        bytes(65507),
        b"\xff" * 65507,
        frame,
        b"\x00" * len(frame),
    ]
    assert_backends_agree(sensor, data)
    decoder = sensor.decoder(stream=False)
    found = [item for datagram in data for item in decoder.feed(datagram)] + decoder.finish()
    stats = decoder.stats
    assert (
        stats.bytes_in
        == sum(map(len, data))
        == sum(len(item.data) for item in found) + stats.bytes_skipped
    )
    if (
        sensor.frames[sensor.data_frame].after is None
        and sensor.frames[sensor.data_frame].confirm == 1
    ):
        assert [item.data for item in found].count(frame) == 2


@pytest.mark.parametrize(
    "sensor",
    [sensor for sensor in SHAPES.values() if sensor.datagrams],
    ids=lambda sensor: sensor.id,
)
def test_each_datagram_is_judged_independently(sensor: Sensor) -> None:
    source = random.Random(sensor.id)
    examples = [sensor.example(name, seed=seed) for name in sensor.incoming for seed in range(4)]
    datagrams = []
    for _ in range(DATAGRAMS):
        frame = source.choice(examples)
        head = frame[: source.randint(1, 12)] + source.randbytes(source.randint(0, 3))
        datagrams.append(source.choice((head, frame, mutate(frame, source))))
    together = sensor.decoder(stream=False)
    each = sensor.decoder(stream=False)
    found = together.datagrams(datagrams)
    alone = [each.datagrams([datagram]) for datagram in datagrams]
    assert found.kinds.tolist() == [kind for frames in alone for kind in frames.kinds.tolist()]
    assert together.stats == each.stats


def test_a_new_header_is_gone_through_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[tree.Formula]()
    evaluated = tree.evaluate

    def counting(formula: tree.Formula, read: tree.Read) -> Any:
        asked.append(formula)
        return evaluated(formula, read)

    monkeypatch.setattr(tree, "evaluate", counting)
    counts = Struct(
        "sync" / Const(b"\x5a\xa5"),
        "n" / Int8ub,
        "a" / Array(this.n, Byte),
        *(f"n{i}" / Int8ub for i in range(4)),
    )
    frame = counts + Struct(*(f"a{i}" / Array(getattr(this, f"n{i}"), Byte) for i in range(4)))
    engine = get_codec(Frame(frame, max_length=2000))
    assert isinstance(engine, CompiledCodec)
    asked.clear()
    assert (
        engine.tree.layout(bytes.fromhex("5aa50100 01020304".replace(" ", "")) + bytes(20))
        is not None
    )
    counted = [formula for formula in asked if "n" in [ref.path for ref in tree.refs(formula)]]
    assert len(counted) == 1


@each_stream
def test_idle_between_chunks_is_the_rule_on_each_part(sensor: Sensor) -> None:
    """Between two calls of `idle` the framing rule holds.

    Bytes that `idle` has released are not used again.
    """
    if any(frame.confirm > 1 or frame.after for frame in sensor.frames.values()):
        pytest.skip("what this sensor sends depends on what came before")
    data = conversation(sensor, seed=2, length=600)
    parts = [data[:200], data[200:350], data[350:]]
    books, expected, base = Books(sensor), [], 0
    for part in parts:
        books.feed(part).finish()
        expected += [
            (name, base + offset, frame) for name, offset, frame in Oracle(sensor, part).frames()
        ]
        base += len(part)
    assert books.found == expected


@pytest.mark.slow
def test_decoders_in_threads_do_not_know_of_each_other() -> None:
    work = [
        (sensor, damage(conversation(sensor, length=600), 5e-3, 1)[:1200])
        for sensor in STREAMS.values()
    ]
    alone = [decode_chunks(*item) for item in work]
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(lambda item: decode_chunks(*item), work)) == alone


def test_a_frame_inside_a_frame_belongs_to_it() -> None:
    sensor = SHAPES["shape-options"]
    inner = sensor.build(
        "data",
        options=dict(extended=0, coarse=0, kind=0),
        rows=0,
        columns=0,
        angle=0,
        distances=[],
        extension=None,
        extra=None,
    )
    words = [
        int.from_bytes(inner[spot : spot + 2].ljust(2, b"\0"), "little")
        for spot in range(0, len(inner), 2)
    ]
    options = dict(extended=0, coarse=0, kind=0)
    outer = sensor.build(
        "data",
        options=options,
        rows=1,
        columns=len(words),
        angle=100,
        distances=words,
        extension=None,
        extra=None,
    )
    assert inner[:8] in outer
    assert [data for _, _, data in decode_chunks(sensor, outer + inner)] == [outer, inner]
    broken = outer[:-1] + bytes([outer[-1] ^ 1])
    assert [data for _, _, data in decode_chunks(sensor, broken)] == [inner]


def test_a_false_header_does_not_cost_valid_frames() -> None:
    sensor = SHAPES["shape-count"]
    frames = [
        sensor.build(
            "data", count=2, first=0, last=100, samples=[dict(distance=0x1234, quality=1)] * 2
        )
        for _ in range(5)
    ]
    data = b"\xaa\x55\x28" + b"".join(frames)
    books = Books(sensor).feed(data)
    assert books.found == []
    assert [frame for _, _, frame in books.finish()] == frames


def test_a_claim_beyond_the_longest_length_is_not_waited_for() -> None:
    sensor = SHAPES["shape-count"]
    frame = sensor.example("data", seed=1)
    books = Books(sensor).feed(b"\xaa\x55\xff" + frame)
    assert [data for _, _, data in books.found] == [frame]
    assert books.decoder.stats.bad_length == 1


def test_the_longest_length_itself_is_allowed() -> None:
    sensor = SHAPES["shape-count"]
    samples = [dict(distance=index, quality=7) for index in range(40)]
    frame = sensor.build("data", first=0, last=100, samples=samples)
    assert len(frame) == sensor.frames["data"].max_length
    assert [data for _, _, data in decode_chunks(sensor, frame)] == [frame]
    too_many = dict(first=0, last=100, samples=[*samples, samples[0]])
    with pytest.raises(UsageError, match=r"samples: .* longer than 129 bytes"):
        sensor.build("data", too_many)
    roomy = dataclasses.replace(sensor.frames["data"], max_length=len(frame) + 3)
    longer = dataclasses.replace(sensor, frames={"data": roomy}).build("data", too_many)
    assert decode_chunks(sensor, longer) == []


def test_rejections_are_counted_by_their_reason() -> None:
    sensor = SHAPES["shape-count"]
    good = sensor.build("data", first=0, last=100, samples=[dict(distance=0x1234, quality=1)])
    far = sensor.build("data", first=36000, last=100, samples=[dict(distance=0x1234, quality=1)])
    wrong = good[:-1] + bytes([good[-1] ^ 0xFF])
    stats = sensor.decode(good + far + wrong + good[:5] + good).stats
    assert (stats.frames, stats.implausible, stats.bad_checksum) == ({"data": 2}, 1, 2)
    assert stats.bytes_skipped == len(far) + len(wrong) + 5


def test_a_datagram_with_a_wrong_constant_is_not_one_of_wrong_length() -> None:
    sensor = ls.sensor("velodyne-vlp16")
    (good,) = ls.simulate(sensor, 1)
    first, inner = b"\xff\xef" + good[2:], good[:100] + b"\xff\xef" + good[102:]
    for data, wrong in (
        ([first], "bad_constant"),
        ([inner], "bad_constant"),
        ([good[:-1]], "bad_length"),
        ([b"\xff"], "bad_length"),
    ):
        for backend in ("numpy", "construct"):
            decoder = reader(sensor, backend).decoder(stream=False)
            assert decoder.feed(data[0]) == []
            counted = {
                name: number
                for name, number in decoder.stats.to_dict().items()
                if name.startswith("bad_") and number
            }
            assert counted == {wrong: 1}, (backend, data[0][:4])
    for name in ("velodyne-vlp16", "slamtec-rplidar-a1"):
        noisy = (
            ls.sensor(name)
            .configure(**({"answer": "node"} if name.endswith("a1") else {}))
            .decoder(stream=True)
        )
        noisy.feed(b"\xff\xee" * 2000 + random.Random(1).randbytes(20_000))
        assert noisy.stats.bad_constant == 0


def test_fillers_are_skipped_bytes_with_a_count_of_their_own() -> None:
    sensor = SHAPES["shape-middle"]
    frame = sensor.example("data", seed=1)
    found = sensor.split(b"\xfe\xff" + frame + b"\xfe" + frame + b"\xfe\x01\xff" + frame)
    assert [item.gap for item in found] == [0, 0, 1]
    stats = sensor.decode(b"\xfe\xff" + frame + b"\xfe" + frame + b"\xfe\x01\xff" + frame).stats
    assert (stats.bytes_skipped, stats.bytes_filler) == (6, 5)


def test_a_descriptor_selects_the_frame_type() -> None:
    sensor = SHAPES["shape-modes"]
    plain, express = sensor.example("plain", seed=1), sensor.example("express", seed=1)
    begin_plain, begin_express = sensor.example("begin_plain"), sensor.example("begin_express")
    data = (
        plain
        + begin_plain
        + plain
        + plain
        + express
        + begin_express
        + express
        + plain
        + begin_plain
        + plain
    )
    assert decode_chunks(sensor, data) == Oracle(sensor, data).frames()
    assert [
        found.frame for found in sensor.split(begin_plain + plain + begin_express + express)
    ] == [
        "begin_plain",
        "plain",
        "begin_express",
        "express",
    ]
    assert sensor.split(plain) == []
    chosen = sensor.configure(answer="express")
    assert [found.frame for found in chosen.split(express + plain)] == ["express"]
    assert len(chosen.decode(express).points()) == 4


def test_runs_of_weak_frames_count_whole_or_not_at_all() -> None:
    sensor = SHAPES["shape-weak"]
    frames = [sensor.example("data", seed=seed) for seed in range(6)]
    for number in range(7):
        data = b"\x00" * 7 + b"".join(frames[:number]) + b"\x00" * 7
        assert [data for _, _, data in decode_chunks(sensor, data)] == (
            frames[:number] if number >= 3 else []
        )
        assert decode_chunks(sensor, data) == Oracle(sensor, data).frames()


def test_a_frame_of_an_earlier_type_ends_a_run() -> None:
    sensor = SHAPES["shape-weak"]
    node, info = (
        sensor.example("data", seed=1),
        sensor.build("info", revision=0x12, temperature=0x34),
    )
    assert sensor.parse(info, frame="data")
    for before in range(5):
        data = node * before + info + node * 2 + info + node * 3
        assert decode_chunks(sensor, data) == Oracle(sensor, data).frames()
        assert [name for name, _, _ in decode_chunks(sensor, data)] == ["data"] * (
            before if before >= 3 else 0
        ) + ["info", "info"] + ["data"] * 3


@pytest.mark.parametrize(
    "name",
    ["shape-count", "shape-options", "shape-state", "shape-modes", "shape-text", "shape-commands"],
)
def test_a_frame_is_out_with_its_last_byte(name: str) -> None:
    data = SensorUnderTest(SHAPES[name]).stream()
    decoder = SHAPES[name].decoder()
    for spot in range(len(data)):
        for found in decoder.feed(data[spot : spot + 1]):
            assert found.offset + len(found.data) == spot + 1
    assert decoder.stats.pending == 0


def test_frames_are_printed_in_one_line() -> None:
    sensor = ls.sensor("cspc-coin-d4")
    frame, decoder = sensor.frames["info"], sensor.decoder()
    data = sensor.example("info", seed=1)
    (found,) = decoder.feed(data) + decoder.finish()
    assert repr(frame) == f"Frame({frame.max_length} bytes: {', '.join(sensor.parse(data))})"
    assert repr(sensor.frames["data"]).startswith("Frame(data, up to ")
    assert repr(ls.sensor("cspc-m1c1-mini").frames["command"]).startswith("Frame(out, 4 bytes: ")
    assert (
        repr(decoder) == f"Decoder(cspc-coin-d4, stream, auto: 1 info frames, bytes_in {len(data)})"
    )
    assert repr(decoder.stats) == f"Counters(1 info frames, bytes_in {len(data)})"
    assert repr(found) == f"Found(info at byte 0, {len(data)} bytes: {data[:8].hex(' ')} ...)"
    assert (
        repr(ls.explain(data, sensor))
        == f"Explanation(cspc-coin-d4 info, {len(data)} bytes: valid)"
    )


def test_completion_offers_public_names_alone() -> None:
    for module in (ls, ls.spec):
        assert dir(module) == sorted(module.__all__)


def test_a_frame_that_begins_with_a_free_byte_may_be_cut_anywhere() -> None:
    """The sync bytes are second, so any last byte of a chunk may begin a frame."""
    struct = Struct(
        "free" / Int8ub, "magic" / Const(b"\x55\xaa"), "value" / Int16ub, "sum" / Int8ub
    )
    made = against_construct.sensor(Checksummed(struct, field="sum", algorithm=Sum(8)))
    frames = [
        made.build("data", free=37 * number % 256, value=999 * number % 65_536)
        for number in range(12)
    ]
    data = b"\x01\x02".join(frames)
    whole = [(found.offset, found.data) for found in made.split(data)]
    assert [frame for _, frame in whole] == frames
    for cut in range(1, len(data)):
        decoder = made.decoder(stream=True)
        found = decoder.feed(data[:cut]) + decoder.feed(data[cut:]) + decoder.finish()
        assert [(one.offset, one.data) for one in found] == whole


@pytest.mark.parametrize("confirm", [2, 3])
def test_a_weak_frame_counts_in_runs_of_the_declared_length(confirm: int) -> None:
    weak = SHAPES["shape-weak"]
    frames = {"data": dataclasses.replace(weak.frames["data"], confirm=confirm)}
    sensor = dataclasses.replace(weak, frames=frames)
    frame = weak.example("data")
    assert sensor.split(frame * (confirm - 1)) == []
    assert [found.data for found in sensor.split(frame * confirm)] == [frame] * confirm


def test_a_frame_of_a_later_type_with_the_same_header_is_no_error() -> None:
    head = "head" / Const(b"\x01")
    sensor = lidarspec.spec.Sensor(
        "acme-bus",
        vendor="Acme",
        model="Bus",
        links={"data": lidarspec.spec.Serial(9600)},
        frames={
            "short": Frame(Checksummed(Struct(head, "x" / Int16ub, "s" / Byte), "s", Sum(8))),
            "long": Frame(
                Checksummed(Struct(head, "x" / Int16ub, "y" / Int16ub, "s" / Byte), "s", Sum(8))
            ),
        },
        status="manual",
        source="invented",
    )
    frame = sensor.build("long", x=0x2233, y=0x4455)
    damaged = frame[:-1] + b"\xff"
    decoder = sensor.decoder()
    found = decoder.feed(frame * 10 + damaged + frame) + decoder.finish()
    assert [item.frame for item in found] == ["long"] * 11
    # Both types reject the damaged frame.
    assert (decoder.stats.bad_checksum, decoder.stats.bytes_skipped) == (2, len(damaged))
