"""Tests of commands on live connections, sent on opening and on closing.

They cover every way in which a program can end, and separate control links.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.device import live_input
from lidarspec.errors import CommandError, OutOfRange, ReplyTimeout, SourceError, UsageError
from lidarspec.recording.format import Recording
from lidarspec.spec import Command, Serial, Tcp, Udp
from tests.broken import sound
from tests.lines import TIMEOUT_S, Port, free_port, port, read_until, turning, udp, until, working
from tests.shapes import SHAPES

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals are POSIX")

IMPATIENT = SHAPES["shape-commands"]
#: the same, which waits for a reply as long as a busy machine may need.
SENSOR = dataclasses.replace(
    IMPATIENT,
    commands={
        name: dataclasses.replace(command, timeout=TIMEOUT_S)
        for name, command in IMPATIENT.commands.items()
    },
)
START, STOP, SPEED = 1, 2, 3
ROOT = Path(__file__).parents[2]


class Obedient:
    """A device on a port that sends data between start and stop, and acknowledges."""

    def __init__(self, line: Port, *, deaf: bool = False, streaming: bool = False) -> None:
        self.line, self.deaf, self.streaming = line, deaf, streaming
        self.heard: list[int] = []
        self.sent = 0
        self._frames = turning(SENSOR, 180)  # ten turns
        self._rest = b""

    def work(self, stop: threading.Event) -> None:
        while not stop.is_set():
            with contextlib.suppress(OSError, ValueError):
                self._turn()

    def _turn(self) -> None:
        master = self.line._master
        if select.select([master], [], [], 0.002)[0]:
            self._rest += os.read(master, 100)
        while len(self._rest) >= 6:
            order, self._rest = self._rest[:6], self._rest[6:]
            self._obey(SENSOR.parse(order, "order").code)
        if self.streaming:
            self.line.send(self._frames[self.sent % len(self._frames)])
            self.sent += 1

    def _obey(self, code: int) -> None:
        self.heard.append(code)
        if self.deaf:
            return
        self.streaming = code != STOP and (self.streaming or code == START)
        if code != STOP:
            self.line.send(b"\xff\x17" + SENSOR.build("ack", code=code, result=0))


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Port]:
    with port(tmp_path) as made:
        yield made


def test_started_on_opening_and_stopped_on_closing(line: Port) -> None:
    device = Obedient(line)
    with working(device.work):
        with ls.open(f"serial://{line.name}", SENSOR) as opened:
            assert device.heard == [START]
            assert opened.latest(TIMEOUT_S).complete
        until(lambda: device.heard == [START, STOP])
        assert not device.streaming


def test_without_start_nothing_is_sent(line: Port) -> None:
    device = Obedient(line, streaming=True)
    with working(device.work), ls.open(f"serial://{line.name}", SENSOR, start=False) as opened:
        opened.latest(TIMEOUT_S)
    assert device.heard == []


def test_a_sensor_started_by_a_command_is_stopped(line: Port) -> None:
    device = Obedient(line)
    with working(device.work):
        with ls.open(f"serial://{line.name}", SENSOR, start=False) as opened:
            assert opened.send("start").confirmed
        until(lambda: device.heard == [START, STOP])


def test_a_reply_among_data_and_the_data_go_on(line: Port, tmp_path: Path) -> None:
    device = Obedient(line)
    path = tmp_path / "all.lsr"
    with working(device.work), ls.open(f"serial://{line.name}", SENSOR, record=path) as opened:
        reply = opened.send("speed", rate=10.0, trim=1.0)
        assert (reply.confirmed, reply.values.code, reply.frame) == (True, SPEED, "ack")
        with pytest.raises(OutOfRange):
            opened.send("speed", rate=100.0, trim=0.0)
        assert opened.send("spin").confirmed is False
        angles = np.concatenate(
            [batch["angle"] for batch, _ in zip(opened.packets(), range(3), strict=False)]
        )
        assert len(angles) > 3
        assert set(np.diff(angles) % 360) == {20.0}, "nothing is missing"
    assert opened.stats.bytes_skipped == opened.stats.bytes_filler + 2 * opened.stats.frames["ack"]
    with Recording(path) as recording:
        sent = [record.data for record in recording if record.direction == "out"]
    assert [SENSOR.parse(data, "order").code for data in sent] == [START, SPEED, STOP]


def test_an_arrived_reply_is_used_before_the_timeout(
    line: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        working(Obedient(line).work),
        ls.open(f"serial://{line.name}", SENSOR, start=False) as opened,
    ):
        clock, calls = opened._input._clock, itertools.count()  # type: ignore[attr-defined]
        now = clock.now

        def held_up() -> int:
            call = next(calls)
            if call == 1:
                until(lambda: opened.queued)
            return now() + (60_000_000_000 if call else 0)

        monkeypatch.setattr(clock, "now", held_up)
        assert opened.send("speed", rate=10.0, trim=1.0, timeout=1.0).confirmed


def test_bytes_by_hand_go_out_as_they_are(line: Port, tmp_path: Path) -> None:
    device = Obedient(line)
    with (
        working(device.work),
        ls.open(
            f"serial://{line.name}", SENSOR, start=False, record=tmp_path / "all.lsr"
        ) as opened,
    ):
        opened.write(SENSOR.command("start"))
        assert opened.latest(TIMEOUT_S).complete
        for wrong, reason in (
            (lambda: opened.write("a5 50"), "expected bytes"),
            (lambda: opened.write(b"1", "power"), "no link 'power'"),
        ):
            with pytest.raises(UsageError, match=reason):
                wrong()
    assert device.heard == [START]
    with Recording(tmp_path / "all.lsr") as recording:
        assert [record.data for record in recording if record.direction == "out"] == [
            SENSOR.command("start")
        ]
    with pytest.raises(SourceError, match="closed"):
        opened.write(b"1")
    (tmp_path / "drive.bin").write_bytes(b"")
    with (
        ls.open(tmp_path / "drive.bin", SENSOR) as file,
        pytest.raises(SourceError, match="is a file"),
    ):
        file.write(b"1")


def test_a_command_from_another_thread_while_scans_are_read(line: Port) -> None:
    device = Obedient(line)
    with working(device.work), ls.open(f"serial://{line.name}", SENSOR) as opened:
        replies = []
        thread = threading.Thread(
            target=lambda: replies.append(opened.send("speed", rate=10.0, trim=0.0))
        )
        for number, _ in enumerate(opened.scans()):
            if number == 1:
                thread.start()
            if replies:
                break
        thread.join()
    assert replies[0].confirmed


def test_a_device_that_does_not_answer_does_not_open(line: Port) -> None:
    device = Obedient(line, deaf=True)
    with working(device.work):
        with pytest.raises(ReplyTimeout) as caught:
            ls.open(f"serial://{line.name}", IMPATIENT)
        assert caught.value.__notes__[0].startswith("next: lidarspec doctor")
        until(lambda: device.heard == [START, STOP])
    ls.open(f"serial://{line.name}", SENSOR, start=False).close()


def test_a_streaming_device_can_be_opened(line: Port) -> None:
    device = Obedient(line, deaf=True, streaming=True)
    with working(device.work), ls.open(f"serial://{line.name}", IMPATIENT) as opened:
        assert any(
            "reading continues, because the sensor sends data" in warning
            for warning in opened.warnings
        )
        opened.latest(TIMEOUT_S)


def test_started_again_after_it_was_unplugged(line: Port) -> None:
    device = Obedient(line)
    with working(device.work):
        with ls.open(f"serial://{line.name}", SENSOR) as opened:
            opened.latest(TIMEOUT_S)
            device.streaming = False
            line.unplug()
            read_until(opened, lambda: opened.state == "disconnected")
            line.plug()
            until(lambda: opened.newest(0.01))
        until(lambda: device.heard == [START, START, STOP])


def test_a_command_to_a_device_that_is_gone_fails_at_once(line: Port) -> None:
    device = Obedient(line)
    with working(device.work), ls.open(f"serial://{line.name}", SENSOR) as opened:
        line.unplug()
        read_until(opened, lambda: opened.state == "disconnected")
        with pytest.raises(CommandError) as caught:
            opened.send("speed", rate=10.0, trim=0.0, timeout=10 * TIMEOUT_S)
    assert not isinstance(caught.value, ReplyTimeout)


def test_a_running_command_fails_when_the_device_disconnects(line: Port) -> None:
    device = Obedient(line, deaf=True)
    with working(device.work), ls.open(f"serial://{line.name}", SENSOR, start=False) as opened:
        timer = threading.Timer(0.1, line.unplug)
        timer.start()
        with pytest.raises(CommandError) as caught:
            opened.send("speed", rate=10.0, trim=0.0, timeout=10 * TIMEOUT_S)
        timer.join()
    assert not isinstance(caught.value, ReplyTimeout)


def test_closing_without_a_device_waits_for_no_reply(
    line: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_input, "SHUTDOWN_TIMEOUT_S", 10 * TIMEOUT_S)
    device = Obedient(line)
    with working(device.work), ls.open(f"serial://{line.name}", SENSOR) as opened:
        line.unplug()
        read_until(opened, lambda: opened.state == "disconnected")
        closing = threading.Thread(target=opened.close, daemon=True)
        closing.start()
        until(lambda: not closing.is_alive())


PROGRAM = """
import signal
import sys
import lidarspec as ls
from tests.shapes import SHAPES
signal.signal(signal.SIGINT, signal.default_int_handler)
device = ls.open("serial://" + sys.argv[1], SHAPES["shape-commands"])
print("open", flush=True)
{rest}
"""


@pytest.mark.parametrize(
    "rest",
    [
        pytest.param("with device: list(device.scans())", id="interrupt in with"),
        pytest.param("sys.exit(3)", id="exit", marks=pytest.mark.slow),
        pytest.param("with device: 1 / 0", id="exception in with", marks=pytest.mark.slow),
        pytest.param("1 / 0", id="exception", marks=pytest.mark.slow),
        pytest.param("del device", id="garbage", marks=pytest.mark.slow),
        pytest.param("list(device.scans())", id="interrupt", marks=pytest.mark.slow),
    ],
)
def test_stopped_whatever_ends_the_program(line: Port, rest: str) -> None:
    device = Obedient(line)
    with working(device.work):
        with subprocess.Popen(
            [sys.executable, "-c", PROGRAM.format(rest=rest), str(line.name)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        ) as program:
            assert program.stdout is not None
            assert program.stdout.readline() == b"open\n"
            if "scans" in rest:
                until(lambda: device.sent > 20)
                program.send_signal(signal.SIGINT)
            program.wait(TIMEOUT_S)
        until(lambda: device.heard == [START, STOP])


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as made:
        made.settimeout(TIMEOUT_S)
        yield made


@pytest.mark.parametrize(
    "named", ["src=127.0.0.1", "control=127.0.0.1:{port}", "control=tcp://127.0.0.1:{port}"]
)
def test_commands_over_a_link_of_their_own(server: socket.socket, named: str) -> None:
    number, data = server.getsockname()[1], free_port()
    commands = {
        name: dataclasses.replace(command, link="control")
        for name, command in SENSOR.commands.items()
        if name != "spin"
    }
    sensor = dataclasses.replace(
        SENSOR, links={"data": Udp(data), "control": Tcp(number)}, commands=commands
    )
    heard: list[int] = []

    def obey(stop: threading.Event) -> None:
        peer = server.accept()[0]
        with peer:
            while order := peer.recv(6, socket.MSG_WAITALL):
                heard.append(SENSOR.parse(order, "order").code)
                if heard[-1] != STOP:
                    peer.sendall(SENSOR.build("ack", code=heard[-1], result=0))

    with working(obey):
        with (
            ls.open(f"udp://127.0.0.1:{data}?{named.format(port=number)}", sensor) as opened,
            udp() as sender,
        ):
            assert heard == [START]
            for frame in turning(SENSOR, 3):
                sender.sendto(frame, ("127.0.0.1", data))
            assert (
                sum(
                    len(batch) for batch, _ in zip(opened.packets(wait=0.3), range(1), strict=False)
                )
                > 0
            )
            assert opened.send("speed", rate=10.0, trim=0.0).confirmed
        until(lambda: heard == [START, SPEED, STOP])


@contextlib.contextmanager
def silent_at_first(number: int, seconds: float, heard: list[str]) -> Iterator[None]:
    """Simulate a device that replies to orders, and sends its first datagram late.

    The datagrams are sent to a port of this computer.
    """

    def work(stop: threading.Event) -> None:
        with udp() as own:
            own.settimeout(0.02)
            stop.wait(seconds)
            for frame in itertools.cycle(turning(SENSOR, 30)):
                if stop.is_set():
                    return
                own.sendto(frame, ("127.0.0.1", number))
                with contextlib.suppress(TimeoutError):
                    order, sender = own.recvfrom(100)
                    heard.append("order")
                    own.sendto(
                        SENSOR.build("ack", code=SENSOR.parse(order, "order").code, result=0),
                        sender,
                    )

    with working(work):
        yield


def datagram_sensor(number: int) -> ls.Sensor:
    return dataclasses.replace(SENSOR, links={"data": Udp(number)}, on_open=(), on_close=())


def test_a_command_waits_for_the_address_of_the_sensor() -> None:
    number, heard = free_port(), list[str]()
    with (
        silent_at_first(number, 0.3, heard),
        ls.open(f"udp://127.0.0.1:{number}", datagram_sensor(number), start=False) as opened,
    ):
        assert opened.send("speed", rate=10.0, trim=0.0, timeout=TIMEOUT_S).confirmed
        assert heard
        assert (
            sum(len(batch) for batch, _ in zip(opened.packets(wait=0.3), range(3), strict=False))
            > 0
        )


def test_a_reply_of_another_sender_is_ignored() -> None:
    number = free_port()
    frames, ack = turning(SENSOR, 2), SENSOR.build("ack", code=SPEED, result=0)
    with (
        udp("127.0.0.2") as own,
        udp("127.0.0.3") as other,
        ls.open(f"udp://:{number}", datagram_sensor(number), start=False) as opened,
    ):
        own.sendto(frames[0], ("127.0.0.1", number))
        read_until(opened, lambda: opened.stats.frames)
        other.sendto(frames[1], ("127.0.0.1", number))
        read_until(opened, lambda: opened.stats.foreign)

        def answer(stop: threading.Event) -> None:
            who = own.recvfrom(100)[1]
            other.sendto(ack, ("127.0.0.1", number))
            own.sendto(SENSOR.build("ack", code=SPEED, result=7), who)

        own.settimeout(TIMEOUT_S)
        with (
            working(answer),
            pytest.raises(CommandError, match="result 7 instead of 0"),
        ):  # which is the sensor's own
            opened.send("speed", rate=10.0, trim=0.0, timeout=1.0)
        other.setblocking(False)
        with pytest.raises(BlockingIOError):
            other.recv(100)


def test_no_command_is_sent_before_the_address_is_known() -> None:
    number = free_port()
    with ls.open(f"udp://127.0.0.1:{number}", datagram_sensor(number), start=False) as opened:
        began = time.monotonic()
        with pytest.raises(CommandError, match="address"):
            opened.send("speed", rate=10.0, trim=0.0, timeout=0.2)
        assert time.monotonic() - began >= 0.2


def test_an_unknown_control_address_is_an_error() -> None:
    commands = {
        "start": dataclasses.replace(
            SENSOR.commands["start"], link="control", timeout=0.2, retries=0
        )
    }
    links: dict[str, Udp | Tcp] = {"data": Udp(7009), "control": Tcp(7010)}
    sensor = dataclasses.replace(SENSOR, links=links, commands=commands, on_close=())
    with pytest.raises(
        (SourceError, CommandError), match="the address of the control link is unknown"
    ):
        ls.open(f"udp://127.0.0.1:{free_port()}", sensor)


@pytest.mark.parametrize("source", ["sim:", "sim:?rate=max"])
def test_commands_use_the_control_link_of_a_simulated_sensor(source: str) -> None:
    start = Command(
        "order", {"code": 1}, reply="ack", echoes=("code",), link="control", starts=True
    )
    links = {"data": Serial(115_200), "control": Tcp(7010)}
    sensor = sound.sensor(
        links=links,
        commands={"start": start, "again": dataclasses.replace(start, starts=False)},
        on_open=("start",),
    )
    with ls.open(source, sensor) as device:
        assert len(next(iter(device.scans())).points.x) > 0
        assert device.send("again").confirmed
