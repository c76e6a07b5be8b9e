"""Tests of promises on live input that involve several modules.

They are P9 (exact replay), P12 (the queue), P15 (whole files) and P16 (clocks).
"""

from __future__ import annotations

import ast
import hashlib
import os
import random
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Scan, simulate
from lidarspec.device.capture_thread import BoundedQueue
from lidarspec.formats import write
from lidarspec.packets.clocks import Unwrapper
from lidarspec.spec import Chunk
from tests.cli.running import ran
from tests.lines import Port, port, turning
from tests.shapes import SHAPES

SECOND = 10**9
TURNING = SHAPES["shape-commands"]
#: Readings of the wall clock, and where they are allowed: as a stamp, or beside the time of a file.
#: `transports.host_clock.HostClock` continues a stamp.
WALL = {"time.time", "time.time_ns", "datetime.now", "datetime.utcnow"}
STAMPED = {
    ("unfinished_files.py", "time.time"),
    ("recording/recorders.py", "datetime.now"),
    ("recording/recorders.py", "time.time_ns"),
    ("transports/simulated_files.py", "time.time_ns"),
}


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Port]:
    with port(tmp_path) as made:
        yield made


def digest(packets: list[ls.Packets]) -> str:
    """Return the SHA-256 of the packets' content and offsets."""
    found = hashlib.sha256()
    for name in ("raw", "offset", "host_ns", "breaks"):
        found.update(np.concatenate([getattr(batch, name) for batch in packets]).tobytes())
    return found.hexdigest()


def receive(device: ls.Device, number: int) -> list[ls.Packets]:
    found: list[ls.Packets] = []
    for batch in device.packets(wait=0.05):
        found += [batch] if len(batch) else []
        if sum(map(len, found)) >= number:
            return found
    raise AssertionError("the device ended")


class TestReplay:
    """Tests of P9: a recording decodes to the same values as the live data, repeatedly."""

    def test_a_frame_that_a_silence_cut_is_cut_again(self, line: Port, tmp_path: Path) -> None:
        frames, first, second = (
            turning(TURNING, 12),
            tmp_path / "first.lsr",
            tmp_path / "second.lsr",
        )
        with ls.open(f"serial://{line.name}", TURNING, start=False, record=first) as device:
            line.send(b"".join(frames[:6]) + frames[6][:5])
            live = receive(device, 6)
            deadline = time.monotonic() + 5
            while device.stats.pending and time.monotonic() < deadline:
                device.newest(0.05)
            assert device.stats.pending == 0, "what the silence cut off is given up"
            line.send(frames[6][5:] + b"".join(frames[7:]))
            live += receive(device, 5)
        ran("replay", first, "--to", second)
        for path in (first, second):
            with ls.open(path, TURNING) as again:
                assert digest(list(again.packets())) == digest(live)
                assert again.stats.frames == {"data": 11}


class TestQueue:
    """Tests of P12: produced == consumed + dropped + waiting, at any speed."""

    @pytest.mark.parametrize("policy", ["drop_oldest", "block"])
    @pytest.mark.parametrize("number", [20_000, pytest.param(1_000_000, marks=pytest.mark.soak)])
    def test_no_packet_disappears(self, policy: str, number: int) -> None:
        queue, source = BoundedQueue(policy, chunks=50, size=4000), random.Random(number)

        def produce() -> None:
            for start in range(0, number, 10):
                queue.put(
                    "data",
                    [Chunk(index.to_bytes(8, "little") * 10) for index in range(start, start + 10)],
                )
            queue.close()

        producer = threading.Thread(target=produce)
        producer.start()
        found: list[int] = []
        while not queue.closed or len(queue):
            for _, item in queue.take(0.5, max_events=source.choice([1, 7, 500])):
                assert isinstance(item, Chunk)
                found.append(int.from_bytes(item.data[:8], "little"))
            assert len(queue) <= 50
            if source.random() < 0.01:
                time.sleep(0.001)
        producer.join()
        assert (queue.produced, queue.consumed) == (number, len(found))
        assert queue.produced == queue.consumed + queue.dropped
        assert found == sorted(set(found)), "in order, none twice"
        assert (queue.dropped == 0) == (policy == "block")


class TestFiles:
    """Tests of P15: a file is kept until its replacement is complete."""

    @pytest.mark.parametrize("suffix", [".csv", ".npz"])
    def test_an_export_that_fails_half_way_changes_nothing(
        self, tmp_path: Path, suffix: str
    ) -> None:
        sensor, path = ls.sensor("ldrobot-stl27l"), tmp_path / f"points{suffix}"
        path.write_bytes(b"of yesterday")

        def failing() -> Iterator[Scan]:
            yield from list(sensor.scans(b"".join(simulate(sensor, 400))))
            raise ls.SourceError("the cable was pulled")

        with pytest.raises(ls.SourceError, match="cable"):
            write(path, failing())
        assert (path.read_bytes(), list(tmp_path.iterdir())) == (b"of yesterday", [path])

    def test_so_does_the_output_of_a_verb(self, tmp_path: Path) -> None:
        target = tmp_path / "list.json"
        target.write_text("of yesterday")
        os.link(target, tmp_path / "before.json")
        ran("sensors", "--json", "-o", target)
        assert target.read_text().startswith("[")
        assert (tmp_path / "before.json").read_text() == "of yesterday", (
            "it was not written over in place"
        )
        assert len(list(tmp_path.iterdir())) == 2
        assert "/dev/full: No space left" in ran("sensors", "-o", "/dev/full", code=3).stderr


class TestClocks:
    """Tests of P16: clocks are unwrapped over a hundred turns, also with late packets.

    No duration is measured by the wall clock.
    """

    @pytest.mark.parametrize("turn", [30, 3600])
    def test_a_clock_runs_on(self, turn: int) -> None:
        rng = np.random.default_rng(turn)
        true = np.cumsum(rng.integers(1, turn * SECOND // 8, 1900)) + 7
        order = np.argsort(
            np.arange(len(true)) + rng.choice([0, 0, 0, 2.5], len(true)), kind="stable"
        )
        order[order == 0], order[0] = order[0], 0
        assert true[-1] > 100 * turn * SECOND
        assert (np.diff(true[order]) < 0).any()
        clock, late = Unwrapper(turn), true[order]
        found = np.concatenate(
            [
                clock.push(part % (turn * SECOND), np.zeros(len(part), np.int64))
                for part in np.array_split(late, 71)
            ]
        )
        assert (found - found[0] == late - late[0]).all()

    def test_a_sequence_of_16_bits_runs_on(self) -> None:
        rng, sensor = np.random.default_rng(16), SHAPES["shape-headed"]
        true = 65_000 + np.cumsum(
            np.where(rng.random(2500) < 0.25, rng.integers(5000, 20_000, 2500), 1)
        )
        late = true.copy()
        swapped = [
            place for place in range(1, len(true) - 1, 2) if true[place + 1] - true[place] == 1
        ]
        late[swapped], late[[place + 1 for place in swapped]] = (
            true[[place + 1 for place in swapped]],
            true[swapped],
        )
        assert (true[-1] >> 16) > 100
        block = {"azimuth": 0, "channels": [{"distance": 400, "strength": 7}] * 3}
        packets = sensor.decode(
            [
                sensor.build("data", unit=4, counted=1, counter=int(n) & 0xFFFF, blocks=[block])
                for n in late
            ]
        )
        assert (packets.index - packets.index[0] == late - late[0]).all()
        assert (packets.stats.lost, packets.stats.late) == (
            true[-1] - true[0] + 1 - len(true),
            len(swapped),
        )

    def test_the_wall_clock_stamps_and_measures_nothing(self) -> None:
        package = Path(ls.__file__).parent
        sources = {path: path.read_text(encoding="utf-8") for path in package.rglob("*.py")}
        found = {
            (str(path.relative_to(package)), name)
            for path, source in sources.items()
            if any(call in source for call in WALL)
            for node in ast.walk(ast.parse(source))
            if isinstance(node, ast.Call) and (name := ast.unparse(node.func)) in WALL
        }
        assert found == STAMPED


@pytest.mark.parametrize("text", ["54 2c", Path("drive.pcap")], ids=["text", "path"])
@pytest.mark.parametrize("method", ["parse", "decode", "split", "scans"])
def test_text_where_bytes_are_taken_is_the_callers_fault(method: str, text: object) -> None:
    sensor = SHAPES["shape-count"]
    with pytest.raises(ls.UsageError, match="bytes"):
        list(getattr(sensor, method)(text))
