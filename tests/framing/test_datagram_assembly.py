"""Tests of messages in several datagrams: any order, missing fragments, no mixtures."""

from __future__ import annotations

import dataclasses
import json
import random
from typing import Any

import numpy as np
import pytest
from construct import Array, Bytes, Const, CString, Int8ub, Int16ub, Int32ub, Struct, this

import lidarspec as ls
from lidarspec import Sensor, SpecError
from lidarspec.explaining.input_segments import iter_pieces
from lidarspec.framing.datagram_assembly import MAX_WAIT_NS, MAX_WAITING_MESSAGES
from lidarspec.spec import Assembled, Chunk, Udp
from tests.shapes.fragments import FRAGMENT, SENSOR

OFFSET = Struct(
    "magic" / Const(b"\x7a\xa7\x02"),
    "message" / Int8ub,
    "size" / Int16ub,
    "at" / Int32ub,
    "total" / Int32ub,
    "data" / Bytes(this.size),
)


def message(number: int) -> bytes:
    values: Any = dict(counter=number, angle=number * 100, samples=[1000 + number] * 40)
    return SENSOR.build("data", values)


def fragments(number: int, size: int = 30) -> list[bytes]:
    """Return the datagrams of a message."""
    data = message(number)
    parts = [data[start : start + size] for start in range(0, len(data), size)]
    return [
        FRAGMENT.build(dict(message=number, index=index, count=len(parts))) + part
        for index, part in enumerate(parts)
    ]


def counters(datagrams: list[bytes]) -> tuple[list[int], Any]:
    packets = SENSOR.decode(datagrams)
    stats = packets.stats
    total = sum(len(message(int(number))) for number in packets["counter"])
    assert stats.bytes_in == sum(map(len, datagrams)) == total + stats.bytes_skipped + stats.pending
    return packets["counter"].astype(int).tolist(), packets


def test_messages_are_joined_in_any_order_of_their_fragments_and_others_pass() -> None:
    sent = [
        message(1),
        *fragments(2),
        *reversed(fragments(3)),
        fragments(4)[0],
        *fragments(5),
        *fragments(4)[1:],
    ]
    numbers, packets = counters(sent)
    assert numbers == [1, 2, 3, 5, 4]
    assert packets.raw["samples"].tolist() == [[1000 + number] * 40 for number in numbers]
    assert not packets.stats.fragments_lost
    assert not packets.stats.fragments_late


def test_an_incomplete_message_is_dropped_and_counted() -> None:
    sent = [*fragments(1), *fragments(2)[:-1], *fragments(3)]
    numbers, packets = counters(sent)
    assert numbers == [1, 3]
    assert packets.stats.fragments_lost == 1
    assert packets.stats.lost == 1
    assert "fragments_lost 1" in str(packets.stats)


def test_duplicate_and_late_fragments_are_dropped_and_counted() -> None:
    doubled = [fragment for fragment in fragments(1) for _ in range(2)]
    numbers, packets = counters([*doubled, fragments(1)[0]])
    assert numbers == [1]
    assert packets.stats.fragments_late == len(fragments(1)) + 1
    late = [
        fragments(1)[0],
        *(
            fragment
            for number in range(2, MAX_WAITING_MESSAGES + 2)
            for fragment in fragments(number)[:-1]
        ),
        *fragments(1)[1:],
    ]
    numbers, packets = counters(late)
    assert numbers == []
    assert packets.stats.fragments_late == len(fragments(1)) - 1
    assert packets.stats.fragments_lost == MAX_WAITING_MESSAGES + len(fragments(1)) - 1


def test_fragments_of_two_messages_with_one_number_are_not_spliced() -> None:
    other = [
        FRAGMENT.build(dict(message=1, index=index, count=3)) + bytes([index] * 30)
        for index in range(3)
    ]
    numbers, packets = counters([fragments(1)[0], other[1], *fragments(1), *fragments(1)])
    assert numbers == [1]
    assert packets.stats.fragments_lost > 0


def test_memory_is_bounded_whatever_comes() -> None:
    decoder = SENSOR.decoder()
    source = random.Random(1)
    for _ in range(2000):
        head = dict(message=source.randrange(65536), index=source.randrange(3), count=200)
        decoder.feed(FRAGMENT.build(head) + bytes(1000))
    assert decoder.stats.pending <= MAX_WAITING_MESSAGES * SENSOR.frames["data"].max_length
    decoder.finish()
    assert decoder.stats.pending == 0
    assert decoder.stats.bytes_in == decoder.stats.bytes_skipped


def test_an_incomplete_message_times_out() -> None:
    decoder = SENSOR.decoder()
    first, *rest = fragments(1)
    decoder.feed(first, 0)
    assert [found for fragment in rest for found in decoder.feed(fragment, MAX_WAIT_NS // 2)]
    decoder.feed(fragments(2)[0], MAX_WAIT_NS)
    assert not [
        found for fragment in fragments(2)[1:] for found in decoder.feed(fragment, 3 * MAX_WAIT_NS)
    ]
    decoder.feed(fragments(3)[0], 4 * MAX_WAIT_NS)
    assert decoder.stats.pending
    decoder.idle()
    assert not decoder.stats.pending


@pytest.mark.parametrize("together", [1, 3, 100])
def test_the_same_is_found_however_datagrams_are_handed_over(together: int) -> None:
    source = random.Random(5)
    sent = [
        fragment for number in range(20) for fragment in fragments(number) if source.random() < 0.95
    ]
    decoder = SENSOR.decoder()
    found = [
        decoder.datagrams(sent[start : start + together]) for start in range(0, len(sent), together)
    ]
    frames = [(one.offset, one.data, one.gap) for frames in found for one in frames.to_found()]
    assert frames == [(one.offset, one.data, one.gap) for one in SENSOR.split(sent)]
    assert len(frames) > 8


def by_bytes(**changes: Any) -> Sensor:
    rule = dict(key="message", index="at", count="total", payload="data", in_bytes=True)
    return dataclasses.replace(
        SENSOR, links={"data": Udp(7780, assembled=Assembled(OFFSET, **{**rule, **changes}))}
    )


def test_fragments_by_their_place_in_bytes_are_joined() -> None:
    data = message(7)
    cuts = [(start, data[start : start + 32]) for start in range(0, len(data), 32)]
    sent = [
        OFFSET.build(dict(message=7, size=len(part), at=start, total=len(data), data=part))
        for start, part in cuts
    ]
    assert by_bytes().split(sent[::-1])[0].data == data
    assert np.asarray(by_bytes().decode(sent)["counter"]).tolist() == [7]


def test_declared_fragment_fields_must_exist() -> None:
    with pytest.raises(SpecError, match=r"links\.data\.assembled: .*'number'"):
        by_bytes(key="number")
    with pytest.raises(SpecError, match="stream"):
        Udp(
            7780,
            stream=True,
            assembled=Assembled(FRAGMENT, key="message", index="index", count="count"),
        )
    texts = "texts" / Array(1, CString("ascii"))
    odd = Assembled(Struct("a" / Int8ub, "b" / Int8ub, texts), key="a", index="b", count="b")
    with pytest.raises(SpecError, match="texts"):
        dataclasses.replace(SENSOR, links={"data": Udp(7780, assembled=odd)}).decoder()


def test_exports_and_explain_know_of_messages_in_fragments() -> None:
    rule = json.loads(ls.export(SENSOR, "json"))["links"]["data"]["assembled"]
    assert (rule["keys"], rule["index"], rule["fragment"]["kind"]) == (
        ["message"],
        "index",
        "struct",
    )
    with pytest.raises(ls.UsageError, match="several datagrams"):
        ls.export(SENSOR, "wireshark")
    found = list(
        iter_pieces(
            SENSOR,
            [Chunk(part, 0) for number in range(3) for part in fragments(number)],
            datagrams=True,
        )
    )
    assert [(piece.frame, piece.data) for piece in found] == [
        ("data", message(number)) for number in range(3)
    ]
