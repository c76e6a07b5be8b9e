"""Tests of the two returns of an RS-LiDAR-M1, which consecutive packets contain.

Source: M1 user guide, 2.1.2 and Table 5. A packet has 25 blocks of 5 channels; with dual return the
odd packets have the first (nearer) and the even packets the second (farther) return.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls

M1 = ls.sensor("robosense-m1")
PACKETS = 1260
NEAR_M = 5.0
FAR_M = 7.5


def make_packet(number: int, second: int | None = None) -> bytes:
    """Return a packet with the first or the second returns of dual return.

    The first returns are 5 m away, and the second returns 7.5 m.

    Args:
        number: the packet counter, 1 to 1260.
        second: 0 for first returns, 1 for second returns; by default, packets with an even counter
            have the second returns.
    """
    second = (number - 1) % 2 if second is None else second
    firing = (number - 1) // 2 * 25
    blocks = [
        {
            "time_offset": block * 10 // 3,
            "return_seq": 1 + second,
            "channels": [
                {
                    "radius": (1500 if second else 1000),
                    "elevation": 32768,
                    "azimuth": 32768 + (firing + block) % 2000 + 2400 * channel,
                    # the second return of channel 4 is the stronger one
                    "intensity": 100 + 50 * (second == (channel == 4)),
                    "reserved": bytes(2),
                }
                for channel in range(5)
            ],
        }
        for block in range(25)
    ]
    return M1.build(
        "data",
        pkt_psn=number,
        protocol_version=0,
        wave_mode=0,
        time_sync_mode=0,
        seconds=1000,
        microseconds=number * 79,
        reserved=bytes(10),
        lidar_type=0x10,
        mems_tmp=105,
        blocks=blocks,
        tail=bytes(3),
    )


@pytest.fixture(scope="module")
def packets() -> list[bytes]:
    """Return the packets of one frame with dual return."""
    return [make_packet(number) for number in range(1, PACKETS + 1)]


def test_odd_and_even_packets_are_the_returns_of_the_same_firings(packets: list[bytes]) -> None:
    decoded = M1.decode(packets[:200])
    returns = decoded.returns()
    assert returns.shape == (100, 25, 5, 2)
    np.testing.assert_allclose(returns["range"], np.broadcast_to([NEAR_M, FAR_M], returns.shape))
    np.testing.assert_array_equal(returns["azimuth"][..., 0], returns["azimuth"][..., 1])
    assert decoded.stats.incomplete_returns == 0


def test_the_return_sequence_decides_not_the_counter() -> None:
    """The guide (2.1.2) judges the type of a packet by return_seq."""
    exchanged = [make_packet(number, number % 2) for number in range(1, 41)]
    returns = M1.decode(exchanged).returns()
    np.testing.assert_allclose(returns["range"], np.broadcast_to([NEAR_M, FAR_M], returns.shape))
    first = M1.decode(exchanged[:4] + exchanged[5:]).returns()[2]
    assert (first["missing"].all(axis=(0, 1)) == [False, True]).all()
    (scan,) = M1.scans(exchanged, select=ls.Selection(returns="first"))
    assert (scan.points.range == NEAR_M).all()


@pytest.mark.parametrize(("mode", "name"), [(4, "strongest"), (5, "last"), (6, "first")])
def test_each_mode_of_single_return_has_one_packet_for_its_firings(mode: int, name: str) -> None:
    packets = []
    for number in (1, 2):
        parsed = M1.parse(make_packet(number))
        blocks = [{**block, "return_seq": 0} for block in parsed.blocks]
        packets.append(M1.build("data", {**parsed, "wave_mode": mode, "blocks": blocks}))
    assert M1.parse(packets[0]).wave_mode.name == name
    assert M1.decode(packets).returns().shape == (2, 25, 5, 1)
    assert len(set(M1.decode(packets).points().column)) == 50


def test_the_counter_decides_if_the_return_sequence_does_not() -> None:
    same = [make_packet(number, 0) for number in (1, 2)]
    returns = M1.decode(same).returns()
    assert returns.shape == (1, 25, 5, 2)
    assert not returns["missing"].any()


def test_a_lost_half_is_counted(packets: list[bytes]) -> None:
    decoded = M1.decode(packets[:40] + packets[41:])
    assert (decoded.stats.lost, decoded.stats.incomplete_returns) == (1, 1)
    assert "incomplete_returns 1" in str(decoded.stats)
    assert np.flatnonzero(decoded.returns()["missing"].any(axis=(1, 2, 3))).tolist() == [20]


def test_lost_halves_are_in_the_contents_of_a_file(packets: list[bytes], tmp_path: Path) -> None:
    for name, sent, count in (
        ("whole.hex", packets[:40], 0),
        ("lossy.hex", packets[:9] + packets[10:20] + packets[21:40], 2),
    ):
        path = tmp_path / name
        path.write_text("\n\n".join(packet.hex() for packet in sent))
        command = [sys.executable, "-m", "lidarspec", "info", str(path)]
        text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        line = f"returns {count} groups of packets lack a return, because packets were lost"
        assert (line in " ".join(text.split())) == (count > 0)
        text = subprocess.run([*command, "--json"], check=True, capture_output=True, text=True)
        assert json.loads(text.stdout)["contents"][0]["incomplete_returns"] == count


def test_a_simulated_sensor_sends_pairs() -> None:
    dual = M1.configure(firmware="current").configure(simulated_returns="dual")
    decoded = dual.decode(ls.simulate(dual, PACKETS + 20))
    assert decoded["pkt_psn"].tolist() == [*range(1, PACKETS + 1), *range(1, 21)]
    assert set(decoded["mems_tmp"].tolist()) == {25}
    np.testing.assert_allclose(np.diff(decoded.time_ns), 1e8 / PACKETS, atol=1000)
    assert (decoded.stats.lost, decoded.stats.incomplete_returns) == (0, 0)
    returns = decoded.returns()
    assert returns.shape == (PACKETS // 2 + 10, 25, 5, 2)
    assert not returns["missing"].any()
    assert (returns["return_index"] == [0, 1]).all()
    for name in ("azimuth", "elevation", "column", "ring"):
        np.testing.assert_array_equal(returns[name][..., 0], returns[name][..., 1])
    (scan,) = dual.scans(ls.simulate(dual, PACKETS), select=ls.Selection(returns="last"))
    assert scan.points.shape == (630 * 25, 5)
    report = dual.frames["difop"].simulation.sweep
    assert report is not None
    assert report(0)["return_mode"] == 0
    single = dual.configure(simulated_returns="single")
    assert ls.simulate(single, 40) == ls.simulate(M1.configure(firmware="current"), 40)


@pytest.mark.parametrize(("which", "metres"), [("first", NEAR_M), ("last", FAR_M)])
def test_a_frame_has_one_point_of_each_firing(
    packets: list[bytes], which: str, metres: float
) -> None:
    (scan,) = M1.scans(packets, select=ls.Selection(returns=which))
    assert scan.points.shape == (630 * 25, 5)
    assert (scan.points.range == metres).all()
    assert scan.points.column.tolist() == np.repeat(np.arange(630 * 25), 5).tolist()


def test_the_strongest_return_has_the_highest_intensity(packets: list[bytes]) -> None:
    (scan,) = M1.scans(packets, select=ls.Selection(returns="strongest"))
    assert (scan.points.intensity == 150).all()
    assert (scan.points.return_index == (scan.points.ring == 4)).all()


def test_the_command_line_reads_one_return(packets: list[bytes], tmp_path: Path) -> None:
    file = tmp_path / "dual.hex"
    file.write_text("\n\n".join(packet.hex() for packet in packets[:4]))
    options = f"-s {M1.id} --returns last --columns range --json"
    command = shlex.split(f"{sys.executable} -m lidarspec read {file} {options}")
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    assert [json.loads(line)["range"] for line in lines] == [FAR_M] * 250
