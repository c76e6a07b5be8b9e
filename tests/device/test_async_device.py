"""Tests of the asyncio device, over real connections."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.errors import ReplyTimeout, SourceError, UsageError
from tests.device.test_commands import IMPATIENT, SENSOR, START, STOP, Obedient
from tests.lines import TIMEOUT_S, Port, port, send_paced, turning, until, working
from tests.shapes import SHAPES

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals are POSIX")

TURNING = SHAPES["shape-clock"]


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Port]:
    with port(tmp_path) as made:
        yield made


def test_scans_packets_and_commands_are_awaited(line: Port) -> None:
    device = Obedient(line)

    async def use() -> None:
        async with ls.open_async(f"serial://{line.name}", SENSOR) as opened:
            assert opened.sensor is SENSOR
            found = []
            async for scan in opened.scans():
                found.append(scan)
                if len(found) == 3:
                    break
            assert found[1].complete
            assert (await opened.send("speed", rate=10.0, trim=0.0)).confirmed
            await opened.write(SENSOR.command("spin"))
            assert (await opened.latest(TIMEOUT_S)).complete
            async for packets in opened.packets():
                assert len(packets)
                break
            assert opened.stats.frames["data"]
            assert (opened.state, opened.warnings) == ("streaming", [])

    with working(device.work):
        asyncio.run(use())
        until(lambda: device.heard[-1] == STOP)


def test_the_event_loop_continues_without_data(line: Port) -> None:
    async def use() -> int:
        turns = 0
        async with ls.open_async(f"serial://{line.name}", TURNING) as opened:
            waiting = asyncio.create_task(anext(opened.scans()))  # type: ignore[arg-type]
            for _ in range(50):
                await asyncio.sleep(0.004)
                turns += 1
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
            with pytest.raises(SourceError, match="no scan within the timeout"):
                await opened.latest(0.05)
        return turns

    threads = threading.active_count()
    assert asyncio.run(use()) == 50
    until(lambda: threading.active_count() == threads)


def test_a_wait_that_is_cancelled_loses_nothing(line: Port) -> None:
    frames = turning(TURNING, 400)

    async def use() -> list[int]:
        stamps: list[int] = []
        async with ls.open_async(f"serial://{line.name}", TURNING) as opened:
            with working(lambda stop: send_paced(line.send, frames, 400, stop) and None):
                while len(stamps) < 8:
                    feed = opened.scans()
                    try:
                        async with asyncio.timeout(0.02):
                            async for scan in feed:
                                stamps.append(scan.stamp_ns)
                    except TimeoutError:
                        continue
        return stamps

    stamps = asyncio.run(use())
    whole = [scan.stamp_ns for scan in TURNING.scans(b"".join(frames))]
    assert stamps == whole[: len(stamps)]


def test_cancelled_while_opening(line: Port) -> None:
    device = Obedient(line, deaf=True)

    async def use() -> None:
        async with asyncio.timeout(0.1):
            async with ls.open_async(f"serial://{line.name}", IMPATIENT):
                raise AssertionError("it does not answer")

    with working(device.work):
        with pytest.raises((TimeoutError, ReplyTimeout)):
            asyncio.run(use())
        until(lambda: device.heard == [START, STOP])
    ls.open(f"serial://{line.name}", SENSOR, start=False).close()


def test_a_file_ends(tmp_path: Path) -> None:
    path = tmp_path / "raw.bin"
    path.write_bytes(b"".join(turning(TURNING, 100)))

    async def use() -> list[ls.Scan]:
        async with ls.open_async(path, TURNING) as opened:
            return [scan async for scan in opened.scans()]

    assert len(asyncio.run(use())) == len(list(TURNING.scans(path.read_bytes())))


def test_it_has_to_be_opened() -> None:
    with pytest.raises(UsageError, match="async with"):
        _ = ls.open_async("udp://", TURNING).stats


def test_errors_of_opening_are_raised_in_the_loop() -> None:
    async def use() -> None:
        async with ls.open_async("/dev/ttyNONE9", TURNING):
            pass

    with pytest.raises(SourceError, match="no such port"):
        asyncio.run(use())


def test_async_with_a_synchronous_device_names_open_async(tmp_path: Path) -> None:
    (path := tmp_path / "data.bin").write_bytes(TURNING.example("data"))
    device = ls.open(path, TURNING)

    async def use() -> None:
        async with device:
            pass

    with pytest.raises(UsageError, match=r"call lidarspec\.open_async"):
        asyncio.run(use())
    assert device.state == "closed"
