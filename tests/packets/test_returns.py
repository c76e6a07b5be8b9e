"""Tests of returns in pairs of packets, of the choice of one, and of incomplete pairs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Selection, SpecError, UsageError
from lidarspec.packets.stream import PacketStream
from lidarspec.points.cloud import PointCloud
from lidarspec.points.firings import MISSING, choose_returns, group_firings
from lidarspec.transports.protocol import Chunk
from tests.shapes import SHAPES
from tests.shapes.pairs import CHANNELS, DUAL_MODE, FIRINGS, LAST_NUMBER

PAIRS = SHAPES["shape-pairs"]


def make_packet(index: int, mode: int = DUAL_MODE) -> bytes:
    """Return packet `index`, with first or second returns.

    A first return is 1 m away, and a second return 2 m, both plus the index of the pair in cm.
    """
    second = index % 2 if mode == DUAL_MODE else 0
    pair = index // 2 if mode == DUAL_MODE else index
    return PAIRS.build(
        "data",
        number=index % LAST_NUMBER + 1,
        mode=mode,
        second=second,
        firings=[
            {
                "azimuth": (pair * FIRINGS + firing) % 36000,
                # the first return is stronger in channel 0, the second in channel 1
                "channels": [
                    {"distance": 100 * (1 + second) + pair, "intensity": 50 + 10 * (second == c)}
                    for c in range(CHANNELS)
                ],
            }
            for firing in range(FIRINGS)
        ],
    )


def decode(frames: Sequence[bytes], size: int | None = None) -> tuple[int, int]:
    """Decode packets in pieces; return the numbers of lost packets and of incomplete pairs."""
    decoder = PAIRS.decoder()
    stream = PacketStream(PAIRS, "data", decoder.stats)
    size = size or len(frames)
    for start in range(0, len(frames), size):
        part = frames[start : start + size]
        stream.add([decoder.datagrams(part, [None] * len(part))])
    return decoder.stats.lost, decoder.stats.incomplete_returns


def test_pairs_of_packets_are_put_together() -> None:
    packets = PAIRS.decode([make_packet(index) for index in range(2 * LAST_NUMBER)])
    returns = packets.returns()
    assert returns.shape == (LAST_NUMBER, FIRINGS, CHANNELS, 2)
    assert not returns["missing"].any()
    expected = [1 + 0.01 * 7, 2 + 0.01 * 7]
    np.testing.assert_allclose(returns["range"][7, 1, 0], expected, rtol=1e-6)
    assert (returns["return_index"] == [0, 1]).all()


def test_a_lost_half_is_missing_and_counted() -> None:
    frames = [make_packet(index) for index in range(20) if index not in (5, 8, 12, 13)]
    packets = PAIRS.decode(frames)
    returns = packets.returns()
    assert returns.shape == (9, FIRINGS, CHANNELS, 2)  # both halves of pair 6 are lost
    assert np.argwhere(returns["missing"].all(axis=(1, 2))).tolist() == [[2, 1], [4, 0]]
    assert not returns["valid"][2, ..., 1].any()
    assert returns["valid"][2, ..., 0].all()
    assert np.isnan(returns["range"][4, ..., 0]).all()
    assert (packets.stats.lost, packets.stats.incomplete_returns) == (4, 2)


@pytest.mark.parametrize(
    ("lost", "warnings"),
    [
        ((), []),
        ((5,), ["1 group of packets lacks a return, because packets were lost"]),
        ((5, 8, 12, 13), ["2 groups of packets lack a return, because packets were lost"]),
    ],
)
def test_lost_halves_are_one_warning(
    lost: tuple[int, ...], warnings: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "pairs.lsr"
    with ls.Recorder(path, PAIRS) as recorder:
        for index in range(40):
            if index not in lost:
                recorder.write(Chunk(make_packet(index), 10**18 + index * 10**7))
    with ls.open(path, PAIRS) as device:
        list(device.packets())
        assert device.warnings == [f"{path}: {text}" for text in warnings]


@pytest.mark.parametrize("size", [1, 2, 3, 7])
def test_pieces_of_input_do_not_change_the_count(size: int) -> None:
    frames = [make_packet(index) for index in range(60) if index not in (5, 8, 12, 13)]
    assert decode(frames, size) == (4, 2)


@pytest.mark.parametrize("size", [1, 3, 60])
def test_a_late_half_completes_its_pair(size: int) -> None:
    order = [0, 1, 2, 4, 5, 3, 6, 7, *range(8, 30)]
    assert decode([make_packet(index) for index in order], size) == (0, 0)


def test_a_duplicate_does_not_complete_a_pair() -> None:
    order = [0, 1, 2, 2, 4, 5, 6, 7]
    assert decode([make_packet(index) for index in order]) == (1, 1)


def test_a_stream_may_begin_and_end_within_a_pair() -> None:
    assert decode([make_packet(index) for index in range(1, 11)]) == (0, 0)


def test_a_lost_first_half_is_counted_at_the_end_of_the_input() -> None:
    assert decode([make_packet(index) for index in range(10) if index != 8]) == (1, 1)


def test_invalid_return_numbers_do_not_change_other_pairs() -> None:
    """Pair 0 has an invalid number, and pair 1 arrives with the second return first."""
    frames = [
        PAIRS.build("data", PAIRS.parse(make_packet(index)), second=second)
        for index, second in enumerate([4, 1, 1, 0])
    ]
    returns = PAIRS.decode(frames).returns()
    assert returns["return_index"][:, 0, 0].tolist() == [[4, 1], [0, 1]]


def test_single_returns_are_not_paired() -> None:
    packets = PAIRS.decode([make_packet(index, mode=1) for index in range(10)])
    assert packets.returns().shape == (10, FIRINGS, CHANNELS, 1)
    assert packets.stats.incomplete_returns == 0


def test_returns_in_one_packet_need_no_pairs() -> None:
    echoes = SHAPES["shape-echoes"]
    packets = echoes.decode(echoes.example("data"))
    assert packets.returns().shape == (1, 5, 2)
    blocks = ls.sensor("velodyne-vlp16")
    value = blocks.parse(blocks.example("data"))
    packets = blocks.decode([blocks.build("data", value, return_mode=0x39)] * 3)
    assert packets.returns().shape == (3, 6, 32, 2)


def scan_with(returns: Any) -> PointCloud:
    frames = [make_packet(index) for index in range(LAST_NUMBER) if index != 5]
    (scan,) = PAIRS.scans(frames, select=Selection(returns=returns))
    return scan.points


def test_one_return_of_each_firing_is_selected() -> None:
    count = LAST_NUMBER // 2 * FIRINGS * CHANNELS
    first = scan_with("first")
    assert len(first) == count
    assert first.shape == (count // CHANNELS, CHANNELS)
    assert (first.return_index == 0).all()
    last = scan_with("last")
    lost_pair = last.column // FIRINGS == 2  # type: ignore[operator]
    assert (last.return_index == ~lost_pair).all()  # the half that arrived stays
    assert (last.range >= 2).sum() == count - lost_pair.sum()
    strongest = scan_with("strongest")
    whole = strongest.column // FIRINGS != 2  # type: ignore[operator]
    assert (strongest.return_index == strongest.ring)[whole].all()
    assert len(scan_with("all")) == 2 * count - FIRINGS * CHANNELS


def test_the_origin_of_a_selected_point_is_its_own_packet() -> None:
    frames = [make_packet(index) for index in range(LAST_NUMBER)]
    (scan,) = PAIRS.scans(frames, select=Selection(returns="last"))
    width = FIRINGS * CHANNELS
    assert [scan.provenance(index * width + 1).data for index in range(3)] == frames[1:7:2]
    assert scan.provenance(1).number == 1
    with pytest.raises(IndexError):
        scan.provenance(len(scan))


def make_cloud(**columns: Any) -> PointCloud:
    (scan,) = SHAPES["shape-echoes"].scans(SHAPES["shape-echoes"].example("data"))
    cloud = scan.points[:4]
    return dataclasses.replace(
        cloud[np.arange(4)],
        valid=np.ones(4, np.bool_),
        **{k: np.array(v) for k, v in columns.items()},
    )


def test_the_names_of_returns_decide_which_is_first() -> None:
    cloud = make_cloud(
        range=[5.0, 3.0, 2.0, 4.0],
        intensity=[1.0, 9.0, 9.0, 1.0],
        return_index=np.array([0, 1, 0, 1], np.uint8),
    )
    assert choose_returns(cloud, "first").tolist() == [0, 2]
    assert choose_returns(cloud, "last").tolist() == [1, 3]
    assert choose_returns(cloud, "last", ("last", "strongest")).tolist() == [0, 2]
    assert choose_returns(cloud, "first", ("last", "strongest")).tolist() == [1, 2]  # the nearest
    assert choose_returns(cloud, "last", ("varying", "varying")).tolist() == [0, 3]  # the farthest
    assert choose_returns(cloud, "strongest").tolist() == [1, 2]
    without = dataclasses.replace(cloud, intensity=None)
    assert choose_returns(without, "strongest", ("last", "strongest")).tolist() == [1, 3]
    with pytest.raises(UsageError):
        choose_returns(without, "strongest")


def test_only_valid_returns_are_chosen() -> None:
    cloud = make_cloud(range=[5.0, 3.0, 2.0, 4.0], return_index=np.array([0, 1, 0, 1], np.uint8))
    cloud = dataclasses.replace(cloud, valid=np.array([False, True, False, False]))
    assert choose_returns(cloud, "first").tolist() == [1, 2]


def test_firings_of_several_packets_are_grouped_by_time_and_ring() -> None:
    cloud = make_cloud(
        time=[0.0, 0.1, 0.0, 0.2],
        ring=np.array([3, 3, 3, 3], np.uint16),
        return_index=np.array([0, 0, 1, 1], np.uint8),
    )
    cloud = dataclasses.replace(cloud, column=None)
    assert group_firings(cloud).tolist() == [[0, 2], [1, MISSING], [MISSING, 3]]


def test_unknown_names_are_refused() -> None:
    with pytest.raises(UsageError):
        Selection(returns="nearest")  # type: ignore[arg-type]
    with pytest.raises(SpecError):
        dataclasses.replace(PAIRS, returns=("nearest",))
