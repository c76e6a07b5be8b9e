"""Tests of splitting a stream into frames and damaged frames."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterable

import pytest

import lidarspec as ls
from lidarspec.errors import UnknownFrame
from lidarspec.explaining.input_segments import NEAREST, explain_piece, iter_pieces
from lidarspec.spec import Chunk
from tests.representatives import load_sensor

STL = ls.sensor("ldrobot-stl27l")
FRAMES = ls.simulate(STL, 40)
SPOT = 20


def list_damaged(
    sent: Iterable[bytes], *, sensor: ls.Sensor = STL, datagrams: bool = False
) -> list[tuple[str, int, str]]:
    """Return type, length and verdict of each segment that is not a valid frame.

    Fail unless the segments together are the input, in order.
    """
    sent = list(sent)
    found = iter_pieces(sensor, map(Chunk, sent), datagrams=datagrams)
    parts = [part for piece in found for part in explain_piece(sensor, piece)]
    assert b"".join(piece.data for piece, _ in parts) == b"".join(sent)
    assert [piece.offset for piece, _ in parts] == [
        0,
        *itertools.accumulate(len(piece.data) for piece, _ in parts),
    ][:-1]
    damaged = [(piece, part) for piece, part in parts if part.fault is not None or not part.frame]
    return [
        (part.frame, len(piece.data), " ".join((part.verdict, *part.notes)))
        for piece, part in damaged
    ]


def sent(damaged: Iterable[bytes]) -> list[bytes]:
    return [*FRAMES[:5], *damaged, *FRAMES[5:20]]


def test_kinds_of_damage_are_distinguished() -> None:
    data = FRAMES[30]
    flipped = data[:SPOT] + bytes([data[SPOT] ^ 4]) + data[SPOT + 1 :]
    headless = bytes([data[0] ^ 1]) + data[1:]
    for damaged, size, verdict in (
        (flipped, 47, "flipped bit explains the damage"),
        (headless, 47, "one flipped bit explains the damage: byte 0 bit 0, header"),
        (data[:SPOT] + data[SPOT + 1 :], 46, "one lost byte explains the damage; "),
        (data[1:], 46, "one lost byte explains the damage: 0x54 before byte 0, in header"),
        (data[:SPOT] + b"\x77" + data[SPOT:], 48, "byte 20, 0x77"),
        (
            data[:11],
            11,
            "the frame ends at byte 11 of 47: points[1].intensity requires 1 byte, but has 0",
        ),
    ):
        ((frame, length, said),) = list_damaged(sent([damaged]))
        assert (frame, length) == ("data", size)
        assert verdict in said


def test_consecutive_damaged_frames_are_listed_one_by_one() -> None:
    lost, flipped = (FRAMES[number][:SPOT] for number in (30, 31))
    lost, flipped = lost + FRAMES[30][SPOT + 1 :], flipped + b"\xfe" + FRAMES[31][SPOT + 1 :]
    assert [size for _, size, _ in list_damaged(sent([lost, flipped, lost, FRAMES[32][:11]]))] == [
        46,
        47,
        46,
        11,
    ]
    assert list_damaged(sent([b"\x01\x02\x03", flipped]))[0] == ("", 3, "valid")


def test_a_damaged_datagram_is_one_piece() -> None:
    sensor = ls.sensor("velodyne-vlp16")
    packets = ls.simulate(sensor, 4)
    ((frame, size, said),) = list_damaged(
        [packets[0], packets[1][:1000], packets[2]], sensor=sensor, datagrams=True
    )
    assert (frame, size) == ("data", 1000)
    assert "frame ends at byte 1000 of 1206" in said
    assert [
        size
        for _, size, _ in list_damaged(
            [packets[0], b"abc", b"defg", packets[2]], sensor=sensor, datagrams=True
        )
    ] == [3, 4]


@pytest.mark.parametrize(
    "sensor", ["shape-count", "shape-ahead", "cspc-m1c1-mini", "slamtec-rplidar-a1"]
)
def test_every_byte_of_a_damaged_stream_is_in_one_piece(sensor: str) -> None:
    value = load_sensor(sensor)
    chance = random.Random(4)
    stream = bytearray(b"".join(value.example(value.data_frame, seed=seed) for seed in range(12)))
    for _ in range(9):
        place = chance.randrange(len(stream))
        stream[place : place + chance.randrange(2)] = chance.randbytes(chance.randrange(3))
    list_damaged(
        [bytes(stream[start : start + 50]) for start in range(0, len(stream), 50)], sensor=value
    )


def test_pieces_are_yielded_before_the_input_ends() -> None:
    endless = map(Chunk, itertools.cycle(FRAMES))
    assert [
        piece.offset for piece in itertools.islice(iter_pieces(STL, endless, datagrams=False), 3)
    ] == [0, 47, 94]
    noise = map(Chunk, itertools.repeat(bytes(1 << 12)))
    assert next(iter_pieces(STL, noise, datagrams=False)).frame == ""


def test_a_frame_type_is_looked_for_in_the_whole_input() -> None:
    sensor = ls.sensor("slamtec-rplidar-a1")
    node = sensor.example("node")
    # No descriptor before it.
    found = list(iter_pieces(sensor, [Chunk(node * 600)], datagrams=False, frame="node"))
    assert [piece.frame for piece in found] == ["node"] * 600
    (short,) = iter_pieces(STL, [Chunk(b"\x00" + FRAMES[0][1:])], datagrams=False, frame="data")
    assert short.frame == NEAREST
    with pytest.raises(UnknownFrame, match="'data'"):
        next(iter_pieces(STL, [], datagrams=False, frame="dat"))
