"""Tests of replays to pseudo terminals, sockets and files: exact bytes and timing."""

from __future__ import annotations

import contextlib
import hashlib
import os
import socket
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.errors import SourceError, UsageError
from lidarspec.recording.recorders import Recorder, open_recorder
from lidarspec.spec import Chunk, Disconnected
from lidarspec.transports import outlets
from lidarspec.transports.destinations import make_replay_outlet
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.outlets import Outlet, PtyLine, TcpLine, UdpLine
from lidarspec.transports.replays import Deadlines, Replay, iter_at_deadlines
from tests.lines import TIMEOUT_S, until, working

STREAM, DATAGRAMS = "ldrobot-stl27l", "velodyne-vlp16"
MS, SECOND = 1_000_000, 1_000_000_000
#: seconds that the recordings of these tests take.
LASTS = 0.25
#: times as fast as it was recorded; None: without a pause.
SPEEDS = [10.0, None, *(pytest.param(speed, marks=pytest.mark.slow) for speed in (0.5, 1.0))]
posix = pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo terminals")


@pytest.fixture
def stream(tmp_path: Path) -> Path:
    """Return a serial recording of 200 frames, in pieces that end within frames."""
    sensor = ls.sensor(STREAM)
    data = b"".join(sensor.example("data", seed=seed) for seed in range(200))
    pieces = [data[start : start + 100] for start in range(0, len(data), 100)]
    path = tmp_path / "stream.lsr"
    with Recorder(path, STREAM) as kept:
        for number, piece in enumerate(pieces):
            kept.write(Chunk(piece, 10**18 + int(number * LASTS * SECOND / (len(pieces) - 1))))
        kept.write(Chunk(b"a command", 10**18), "out")
    return path


@pytest.fixture
def datagrams(tmp_path: Path) -> Path:
    """Return a recording of 100 datagrams to two ports."""
    sensor = ls.sensor(DATAGRAMS)
    frames = [sensor.example("data", seed=seed) for seed in range(8)]
    path = tmp_path / "datagrams.lsr"
    with Recorder(path, DATAGRAMS) as kept:
        for number in range(100):
            data = frames[number % 8] if number % 9 else b""
            at = 10**18 + int(number * LASTS * SECOND / 99)
            kept.write(Chunk(data, at, ("192.168.1.201", 2368), ("192.168.1.10", 2368)))
    return path


@contextlib.contextmanager
def playing(
    path: Path, target: Outlet, *, speed: float | None, began: list[float] | None = None
) -> Iterator[list[BaseException]]:
    """Replay in a thread; yield the list of its errors.

    The time at which the replay began is added to `began`.
    """
    failed: list[BaseException] = []

    def run() -> None:
        try:
            target.await_listener()
            if began is not None:
                began.append(time.monotonic())
            with contextlib.closing(open_transport(path)) as source:
                for chunk, _ in iter_at_deadlines(source.chunks(), speed=speed):
                    target.deliver(chunk)
        except BaseException as error:
            failed.append(error)
        finally:
            target.finish()
            target.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield failed
    finally:
        thread.join(TIMEOUT_S)
        assert not thread.is_alive()


def content(path: Path) -> bytes:
    with contextlib.closing(open_transport(path)) as source:
        return b"".join(chunk.data for chunk in source.chunks())


def from_pty(place: str) -> bytes:
    descriptor = os.open(place, os.O_RDWR | os.O_NOCTTY)
    try:
        tty.setraw(descriptor)
        os.write(descriptor, b"start")
        return b"".join(until_the_end(lambda: os.read(descriptor, 997)))
    finally:
        os.close(descriptor)


def from_tcp(place: str) -> bytes:
    host, port = place.removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port))) as connection:
        connection.sendall(b"start")
        return b"".join(until_the_end(lambda: connection.recv(997)))


def until_the_end(read: Callable[[], bytes]) -> Iterator[bytes]:
    with contextlib.suppress(OSError):  # a terminal that was hung up
        while data := read():
            yield data


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("kind", [pytest.param("pty", marks=posix), "tcp"])
def test_a_replayed_stream_is_unchanged_at_every_speed(
    stream: Path, kind: str, speed: float | None
) -> None:
    target = Outlet(PtyLine() if kind == "pty" else TcpLine("127.0.0.1", 0, sole=True))
    with playing(stream, target, speed=speed) as failed:
        received = (from_pty if kind == "pty" else from_tcp)(target.local_source)
    assert not failed
    assert hashlib.sha256(received).hexdigest() == hashlib.sha256(content(stream)).hexdigest()
    sensor = ls.sensor(STREAM)
    assert sensor.decode(received).raw.tobytes() == sensor.decode(content(stream)).raw.tobytes()


@pytest.mark.parametrize("speed", SPEEDS)
def test_replayed_datagrams_are_unchanged_at_every_speed(
    datagrams: Path, speed: float | None
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(TIMEOUT_S)
        target = Outlet(UdpLine.to(ports=receiver.getsockname()[1:]))
        with playing(datagrams, target, speed=speed) as failed:
            received = [receiver.recv(65536) for _ in range(100)]
    assert not failed
    with contextlib.closing(open_transport(datagrams)) as source:
        sent = [chunk.data for chunk in source.chunks()]
    assert received == sent
    sensor = ls.sensor(DATAGRAMS)
    assert sensor.decode(received).raw.tobytes() == sensor.decode(sent).raw.tobytes()


@pytest.mark.parametrize("suffix", [".lsr", ".pcap", ".pcapng"])
def test_into_a_file_datagrams_keep_their_times_and_addresses(
    datagrams: Path, tmp_path: Path, suffix: str
) -> None:
    copy = tmp_path / f"copy{suffix}"
    with contextlib.closing(open_recorder(copy, DATAGRAMS, datagrams=True)) as log:
        assert not any(Replay(str(datagrams), log, speed=None).run())
    with (
        contextlib.closing(open_transport(datagrams)) as before,
        contextlib.closing(open_transport(copy)) as after,
    ):
        assert list(after.chunks()) == list(before.chunks())
    with ls.open(datagrams) as one, ls.open(copy, DATAGRAMS) as other:
        expected, found = ([p.points().xyz for p in device.packets()] for device in (one, other))
    np.testing.assert_array_equal(np.concatenate(expected), np.concatenate(found))


def test_datagrams_go_to_the_ports_of_then(datagrams: Path) -> None:
    with contextlib.ExitStack() as stack:
        receivers = [
            stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)
        ]
        for receiver in receivers:
            receiver.bind(("127.0.0.1", 0))
            receiver.settimeout(TIMEOUT_S)
        target = stack.enter_context(contextlib.closing(UdpLine.to()))
        for number, receiver in enumerate(receivers):
            target.send(
                [Chunk(bytes([number]), receiver=("10.0.0.1", receiver.getsockname()[1]))],
                patient=True,
            )
            assert receiver.recv(9) == bytes([number])
        with pytest.raises(UsageError, match="the recording does not contain the destination port"):
            target.send([Chunk(b"nowhere")], patient=True)


@posix
@pytest.mark.parametrize("speed", [2.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_arrivals_keep_the_times_of_then(stream: Path, speed: float) -> None:
    target, began, arrived = Outlet(PtyLine()), list[float](), list[tuple[float, int]]()
    with playing(stream, target, speed=speed, began=began):
        descriptor, total = os.open(target.local_source, os.O_RDWR | os.O_NOCTTY), 0
        with contextlib.suppress(OSError):
            while data := os.read(descriptor, 4096):
                total += len(data)
                arrived.append((time.monotonic(), total))
        os.close(descriptor)
    assert total == len(content(stream))
    due = [(size - 100) / (total - 100) * LASTS / speed for _, size in arrived[:-1]]
    late = [at - began[0] - when for (at, _), when in zip(arrived[:-1], due, strict=True)]
    assert min(late) >= 0  # nothing before its time; how late, depends on the machine


class Clock:
    """A clock with which each sleep ends later than the next chunk is due."""

    def __init__(self) -> None:
        self.time = 5 * SECOND

    def now(self) -> int:
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += round(seconds * SECOND) + 3 * MS


@pytest.mark.parametrize("speed", [0.25, 1.0, 3.0])
def test_oversleeping_does_not_add_up(speed: float) -> None:
    clock = Clock()
    chunks = [Chunk(b"x", 10**18 + number * MS) for number in range(10_000)]
    times, late = [], []
    for _, late_ns in iter_at_deadlines(chunks, speed=speed, now=clock.now, sleep=clock.sleep):
        times.append(clock.now())
        late.append(late_ns)
    due = [round(number * MS / speed) for number in range(10_000)]
    errors = [at - times[0] - when for at, when in zip(times, due, strict=True)]
    assert 0 <= min(errors) <= max(errors) <= 3 * MS
    assert late == errors


def test_as_fast_as_possible_never_waits() -> None:
    clock = Clock()
    chunks = [Chunk(b"", SECOND * number) for number in range(9)]
    sent = list(iter_at_deadlines(chunks, speed=None, now=clock.now, sleep=clock.sleep))
    assert sent == [(chunk, 0) for chunk in chunks]
    assert clock.now() == 5 * SECOND


def test_times_that_go_back_hold_nothing_up() -> None:
    deadlines = Deadlines(1.0, 0)
    overtaken = [deadlines.find(10**18 + at * MS) for at in (0, 10, 5, 20, 12, 30)]
    assert overtaken == [0, 10 * MS, 5 * MS, 20 * MS, 12 * MS, 30 * MS]
    set_back = [deadlines.find(at * MS) for at in (0, 10, 20)]
    assert set_back == [30 * MS, 40 * MS, 50 * MS]
    assert deadlines.find(None) == 0


@posix
def test_a_reader_that_leaves_is_noticed(stream: Path) -> None:
    target = Outlet(PtyLine())
    with playing(stream, target, speed=1.0) as failed:
        descriptor = os.open(target.local_source, os.O_RDWR | os.O_NOCTTY)
        os.read(descriptor, 1)
        os.close(descriptor)
    assert [type(error) for error in failed] == [Disconnected]
    server = Outlet(TcpLine("127.0.0.1", 0, sole=True))
    with (
        playing(stream, server, speed=1.0) as failed,
        socket.create_connection(("127.0.0.1", int(server.local_source.split(":")[2]))) as reader,
    ):
        reader.recv(1)
    assert [type(error) for error in failed] == [Disconnected]


def test_a_flooding_reader_does_not_delay_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outlets, "FETCH_TIMEOUT_S", 0.2)
    target = TcpLine("127.0.0.1", 0, sole=True)
    with socket.create_connection(("127.0.0.1", int(target.local_source.split(":")[2]))) as reader:
        target.await_listener()

        def flood(stop: threading.Event) -> None:
            with contextlib.suppress(OSError):
                while not stop.is_set():
                    reader.sendall(bytes(1 << 16))

        with working(flood):
            ending = threading.Thread(target=target.finish, daemon=True)
            ending.start()
            until(lambda: not ending.is_alive())
    target.close()


@posix
def test_a_reader_that_leaves_between_two_turns_is_reported(tmp_path: Path) -> None:
    path, count = tmp_path / "short.lsr", 5
    with Recorder(path, STREAM) as kept:
        for number in range(count):
            kept.write(Chunk(bytes(100), 10**18 + number))
    target = Outlet(PtyLine())
    opened = [os.open(target.local_source, os.O_RDWR | os.O_NOCTTY)]

    def return_later() -> None:
        until(lambda: not target.has_listener)
        opened.append(os.open(target.local_source, os.O_RDWR | os.O_NOCTTY))

    played = Replay(path, target, speed=None, loop=True).run()
    assert [next(played) for _ in range(count)] == [""] * count
    os.close(opened.pop())
    returning = threading.Thread(target=return_later, daemon=True)
    returning.start()
    assert next(played) == f"{target.local_source}: the reader has disconnected"
    assert next(played) == ""
    returning.join()
    os.close(opened.pop())
    target.close()


@posix
def test_the_last_bytes_reach_a_slow_reader(stream: Path) -> None:
    target = Outlet(PtyLine())
    received = bytearray()
    with playing(stream, target, speed=None):
        descriptor = os.open(target.local_source, os.O_RDWR | os.O_NOCTTY)
        time.sleep(0.4)
        for data in until_the_end(lambda: os.read(descriptor, 4096)):
            received += data
            time.sleep(0.02)
        os.close(descriptor)
    assert received == content(stream)


@pytest.mark.parametrize(
    ("place", "holds_datagrams", "reason"),
    [
        ("pty", True, "the recording contains datagrams"),
        ("tcp://127.0.0.1:0", True, "the recording contains datagrams"),
        ("udp://127.0.0.1:9", False, "the recording contains a byte stream"),
        ("nonsense", False, "invalid destination 'nonsense': expected pty, udp://host:port"),
        ("tcp://127.0.0.1", False, "specify the port"),
    ],
)
def test_impossible_destinations_give_a_reason(
    place: str, *, holds_datagrams: bool, reason: str
) -> None:
    with pytest.raises(UsageError, match=reason):
        make_replay_outlet(place, datagrams=holds_datagrams)


def test_an_address_in_use_is_reported() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(SourceError, match="in use"),
    ):
        TcpLine("127.0.0.1", taken.getsockname()[1])


@pytest.mark.skipif(sys.platform != "linux", reason="counts descriptors in /proc")
def test_players_give_everything_back(stream: Path) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for made in (PtyLine(), TcpLine("127.0.0.1", 0, sole=True), UdpLine.to(ports=[9])):
        made.close()
    assert len(os.listdir("/proc/self/fd")) == before
