"""Tests of serial ports, on real pseudo terminals."""

from __future__ import annotations

import os
import termios
import time
from pathlib import Path
from typing import Any

import pytest

import lidarspec as ls
from lidarspec.errors import SourceError, UsageError
from lidarspec.spec import Disconnected
from lidarspec.transports.open_url import is_port, open_transport
from lidarspec.transports.serial import SerialTransport
from tests.lines import Port, port, until
from tests.shapes import SHAPES

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo terminals are POSIX")


def open_port(source: str, sensor: ls.Sensor | None = None) -> SerialTransport:
    made = open_transport(source, sensor)
    assert isinstance(made, SerialTransport)
    return made


@pytest.mark.parametrize(
    "form", ["serial://{}?baud=115200", "{}?baud=115200", "serial://{}?baud=150000&dtr=0&rts=1"]
)
def test_a_port_is_read_and_written(tmp_path: Path, form: str) -> None:
    with port(tmp_path) as line:
        name = str(line.name) if "serial" in form else os.path.realpath(line.name)
        one = open_port(form.format(name))
        line.send(b"\x01\x02\x03")
        before = time.time_ns()
        (chunk,) = one.read(5.0)
        assert chunk.data == b"\x01\x02\x03"
        assert abs((chunk.at or 0) - before) < 5e9
        one.write(b"\xff\x00")
        assert line.receive(2) == b"\xff\x00"
        assert one.read(0.01) == []
        one.close()
        one.close()


def test_the_sensor_says_the_baud_rate_and_the_source_overrides_it(tmp_path: Path) -> None:
    sensor = SHAPES["shape-commands"]
    with port(tmp_path) as line:
        for source, baud in (
            (f"serial://{line.name}", 115_200),
            (f"serial://{line.name}?baud=460800", 460_800),
        ):
            one = open_port(source, sensor)
            assert one.baud == baud
            one.close()


def test_a_port_is_opened_with_8n1_without_flow_control(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested: list[list[Any]] = []  # a pseudo terminal has 8 data bits whatever is requested
    monkeypatch.setattr(termios, "tcsetattr", lambda port, when, state: requested.append(state))
    with port(tmp_path) as line:
        descriptor = os.open(line.name, os.O_RDWR | os.O_NOCTTY)
        state = termios.tcgetattr(descriptor)
        os.close(descriptor)
        state[0] |= termios.IXON | termios.IXOFF
        state[2] |= termios.PARENB | termios.CSTOPB | termios.CRTSCTS
        state[2] = state[2] & ~termios.CSIZE | termios.CS7
        monkeypatch.setattr(termios, "tcgetattr", lambda port: [*state])
        open_port(f"serial://{line.name}", ls.sensor("ldrobot-stl27l")).close()
    iflag, _, cflag, _, ispeed, ospeed, _ = requested[-1]
    assert (ispeed, ospeed) == (termios.B921600, termios.B921600)
    assert cflag & termios.CSIZE == termios.CS8
    assert not cflag & (termios.PARENB | termios.CSTOPB | termios.CRTSCTS)
    assert not iflag & (termios.IXON | termios.IXOFF)


def test_control_lines_are_ignored_by_ports_without_them(tmp_path: Path) -> None:
    with port(tmp_path) as line:
        one = open_port(f"serial://{line.name}?baud=9600")
        one.lines(dtr=False, rts=True)
        one.close()


@pytest.mark.parametrize(
    ("source", "error", "text", "following"),
    [
        ("/dev/ttyNONE9?baud=9600", SourceError, "no such port", "lidarspec ports"),
        ("serial:///dev/ttyNONE9?baud=9600", SourceError, "no such port", "lidarspec ports"),
        ("COM44?baud=9600", SourceError, "no such port", "lidarspec ports"),
        ("serial:///dev/null?baud=9600", SourceError, "/dev/null: ", "lidarspec ports"),
        ("/dev/ttyNONE9", UsageError, "the baud rate is unknown", ""),
        ("/dev/ttyNONE9?bud=9600", UsageError, "did you mean 'baud'", ""),
        ("/dev/ttyNONE9?baud=fast", UsageError, "baud must be a number", ""),
        ("/dev/ttyNONE9?baud=9600&dtr=maybe", UsageError, "dtr must be 0 or 1", ""),
        ("serial://?baud=9600", UsageError, "expected a port", ""),
    ],
)
def test_a_port_that_cannot_be_opened_gives_a_reason(
    source: str, error: type[Exception], text: str, following: str
) -> None:
    with pytest.raises(error, match=text) as caught:
        open_transport(source)
    assert not following or caught.value.__notes__ == [f"next: {following}"]


def test_a_port_is_for_one_program(tmp_path: Path) -> None:
    with port(tmp_path) as line:
        one = open_port(f"serial://{line.name}?baud=9600")
        with pytest.raises(SourceError, match="in use by another program"):
            open_transport(f"serial://{line.name}?baud=9600")
        one.close()
        open_port(f"serial://{line.name}?baud=9600").close()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open everything")
def test_a_port_without_permission(tmp_path: Path) -> None:
    with port(tmp_path) as line:
        os.chmod(line.name, 0)
        with pytest.raises(SourceError, match="permission denied"):
            open_transport(f"serial://{line.name}?baud=9600")


def test_a_hang_up_is_a_disconnection_and_the_port_can_be_opened_again(tmp_path: Path) -> None:
    line = Port(tmp_path / "ttyTEST")
    one = open_port(f"serial://{line.name}?baud=9600")
    line.unplug()
    with pytest.raises(Disconnected, match="connection was lost"):
        until(lambda: one.read(0.1))
    with pytest.raises(Disconnected):
        one.write(b"\x00")
    with pytest.raises(SourceError, match="no such port"):
        one.reopen()
    line.plug()
    one.reopen()
    line.send(b"again")
    assert one.read(5.0)[0].data == b"again"
    one.close()
    line.close()


def test_no_descriptor_is_left_behind(tmp_path: Path) -> None:
    with port(tmp_path) as line:
        before = len(os.listdir("/dev/fd"))
        for _ in range(20):
            open_port(f"serial://{line.name}?baud=9600").close()
            with pytest.raises(SourceError):
                open_transport("/dev/ttyNONE9?baud=9600")
        assert len(os.listdir("/dev/fd")) == before


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("COM4", True),
        ("com12?baud=1", True),
        ("/dev/ttyUSB0", True),
        ("/dev/null", False),
        ("-", False),
        ("COM4.pcap", False),
        ("x/COM4", False),
    ],
)
def test_names_of_ports(text: str, expected: bool) -> None:
    assert is_port(text) is expected
