"""What verbs say of captures and files that give less than they hold: damage, packets not read, several senders, containers."""

from __future__ import annotations

from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import Datagram, datagram_record
from lidarspec.captures.records import capture_head
from lidarspec.simulation.simulator import simulate
from tests import made_captures as made
from tests.cli.running import ran

M1 = "robosense-m1"


def records(number: int, *sources: tuple[str, int]) -> list[bytes]:
    """The records of a sensor's packets, from these senders in turn."""
    packets = simulate(ls.sensor(M1), number)
    ends = sources or (made.SOURCE,)
    return [
        datagram_record(Datagram(data, 10**18 + index * 158_730, ends[index % len(ends)], made.DESTINATION))
        for index, data in enumerate(packets)
    ]


def capture(path: Path, *records: bytes, link: int = ETHERNET) -> Path:
    path.write_bytes(capture_head(link) + b"".join(records))
    return path


@pytest.mark.parametrize("verb", ["convert", "read", "stats", "plot"])
def test_a_damaged_capture_is_read_on_and_said_to_be_damaged(verb: str, tmp_path: Path) -> None:
    some = records(1300)
    some[700] = some[700][:10] + b"\x7f" + some[700][11:]
    path = capture(tmp_path / "it.pcap", *some)
    target = {"convert": [tmp_path / "out.csv"], "plot": ["-o", tmp_path / "out.svg", "-n", 9]}.get(verb, [])
    done = ran(verb, path, *target, "-s", M1, *(["--packets", "--json"] if verb == "read" else []), code=1)
    assert f"{path} is damaged in 1 place: {len(some[700])} bytes were not read, everything else was" in done.stderr
    if verb == "read":
        assert done.stdout.count("\n") == 1299
