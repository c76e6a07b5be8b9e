"""Tests of commands over separate links: TCP, UDP, broadcast and HTTP.

Each is a real socket of a simulated sensor.
"""

from __future__ import annotations

import contextlib
import dataclasses
import http.client
import queue
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.errors import CommandError, ReplyTimeout, SpecError, UsageError
from lidarspec.plugins import Registry, use_registry
from lidarspec.recording.format import Header
from lidarspec.spec import (
    Chunk,
    Command,
    Frame,
    Http,
    HttpReply,
    HttpRequest,
    Link,
    LiveTransport,
    Sensor,
    Serial,
    Tcp,
    Text,
    Udp,
    hookimpl,
)
from lidarspec.testing.fixtures import virtual_port
from tests.lines import TIMEOUT_S, free_port, read_until, udp, working
from tests.shapes.conversation import SENSOR

PAGES = {
    "page": Frame(HttpReply, max_length=4096),
    "ask": Frame(HttpRequest, direction="out", max_length=4096),
}
STATUS = Command(
    "ask",
    {"method": "GET", "path": b"/status", "body": b""},
    reply="page",
    matches={"status": 200},
    link="web",
    timeout=TIMEOUT_S,
)
SET = Command(
    "ask",
    {"method": "PUT", "path": b"/mode"},
    args={"mode": ("body", Text(40))},
    reply="page",
    link="web",
    timeout=TIMEOUT_S,
)


def make_linked_sensor(control: Link, **more: Any) -> Sensor:
    """Return the shape with its commands over another link, on free ports."""
    return dataclasses.replace(SENSOR, links={"data": Udp(free_port()), "control": control}, **more)


def with_pages(answers: dict[str, Any], link: Http | None = None) -> Sensor:
    """Return the shape with a web server."""
    links = {
        "data": Udp(free_port()),
        "control": Udp(free_port()),
        "web": link or Http(free_port()),
    }
    commands = {**SENSOR.commands, "status": STATUS, "set_mode": SET}
    simulation = dataclasses.replace(SENSOR.simulation, answers=answers)
    return dataclasses.replace(
        SENSOR,
        frames={**SENSOR.frames, **PAGES},
        links=links,
        commands=commands,
        simulation=simulation,
    )


@pytest.mark.parametrize("kind", [Udp, Tcp])
def test_a_simulated_sensor_answers_over_a_link_of_its_own(kind: type[Udp | Tcp]) -> None:
    sensor = make_linked_sensor(kind(free_port()))
    data = sensor.links["data"].ports[0]
    with (
        virtual_port(sensor, to=f"udp://127.0.0.1:{data}") as port,
        ls.open(port.path, sensor) as device,
    ):
        assert (
            port.path
            == f"udp://127.0.0.1:{data}?control=127.0.0.1:{port.outlet.controls['control'].port}"
        )
        assert device.send("call", name="anna").values.head == {"number": 7, "code": 3}
        assert device.send("send_to", host="127.0.0.1", port=data).values.head == {
            "number": 8,
            "code": 2,
        }
        assert device.send("hello").values.head.number == 9
        port.wait_for_commands(["call", "send_to", "hello"])
        assert device.latest(TIMEOUT_S).complete


ANGLES = [0.5, 1.0, 1.5, 2.0]


def teaching(**more: Any) -> Sensor:
    """Return the shape with a command on opening that requests its table."""
    return dataclasses.replace(make_linked_sensor(Udp(free_port())), on_open=("get_table",), **more)


def angles(device: ls.Device) -> list[float]:
    """Return the angles of a packet's samples relative to the model's first, in degrees."""
    packets = next(batch for batch in device.packets(wait=0.3) if len(batch))
    found = np.rad2deg(packets.points().azimuth[:4]) - packets["angle"][0]
    return [round(float(angle), 3) % 360 for angle in found]


def test_reported_values_configure_the_sensor_and_its_recording(tmp_path: Path) -> None:
    sensor, path = teaching(), tmp_path / "taught.lsr"
    with virtual_port(sensor, to=f"udp://127.0.0.1:{sensor.links['data'].ports[0]}") as port:
        with ls.open(port.path, sensor, record=path) as device:
            assert device.learned == {"table": b"0.5 1 1.5 2"}
            assert device.sensor.options == device.learned
            assert angles(device) == ANGLES
            live = device.latest(TIMEOUT_S)
        assert (live.points.nominal, device.warnings) == (False, [])
        with ls.open(port.path, sensor, start=False) as device:  # which asks for nothing
            assert (dict(device.learned), angles(device)) == ({}, [0.0, 1.0, 2.0, 3.0])
    registry = Registry()
    registry.add(SimpleNamespace(lidarspec_sensors=hookimpl(lambda: [sensor])), name="shapes")
    with use_registry(registry):
        with ls.open(path) as replay:
            assert repr(replay.sensor.options["table"]) == "Learned(11 bytes)"
            again = [
                scan.points.azimuth for scan in replay.scans() if scan.stamp_ns == live.stamp_ns
            ]
        assert np.array_equal(again[0], live.points.azimuth)
        kept = Header(sensor.id, {"table": {"learned": "bm90aGluZw=="}})
        with pytest.raises(UsageError, match="expected data reported by the sensor"):
            kept.known_sensor(tmp_path)


@pytest.mark.parametrize(
    ("said", "learns", "error"),
    [
        (
            b"1 2 3",
            None,
            "the values that the sensor reported are invalid: 3 angles, and there are 4 samples",
        ),
        (
            b"",
            lambda reply: {"table": reply.nothing},
            "the reply could not be interpreted: AttributeError",
        ),
        (
            b"",
            lambda reply: {"table": [1.0]},
            "`learns` must return a number, bytes or a string for table, got list",
        ),
        (b"", lambda reply: {"tables": b""}, "unknown option 'tables'"),
        (b"", lambda reply: {"frame": b"rep103"}, "frame must be one of rep103, vendor"),
    ],
)
def test_an_invalid_reported_value_is_a_command_error(said: bytes, learns: Any, error: str) -> None:
    asked = SENSOR.commands["get_table"]
    commands = {"get_table": dataclasses.replace(asked, learns=learns or asked.learns)}
    simulation = dataclasses.replace(
        SENSOR.simulation, answers={"get_table": [("table", {"angles": said})]}
    )
    sensor = teaching(commands=commands, simulation=simulation)
    with (
        virtual_port(sensor, to=f"udp://127.0.0.1:{sensor.links['data'].ports[0]}") as port,
        pytest.raises(CommandError, match=error),
    ):
        ls.open(port.path, sensor)


def path_alone(sensor: Sensor, *, table: str | Path) -> Sensor:
    raise AssertionError("a path that a stranger wrote is opened")


def of_no_type(sensor: Sensor, *, table) -> Sensor:  # type: ignore[no-untyped-def]  # as some authors write it
    raise AssertionError("a path that a stranger wrote is opened")


@pytest.mark.parametrize("configure", [path_alone, of_no_type])
def test_a_learned_value_is_not_a_path(configure: Any) -> None:
    sensor = teaching(configure=configure)
    refused = pytest.raises(CommandError, match=r"table must be .*, not Learned\(11 bytes\)")
    with (
        virtual_port(sensor, to=f"udp://127.0.0.1:{sensor.links['data'].ports[0]}") as port,
        refused,
    ):
        ls.open(port.path, sensor)


def test_a_learning_command_needs_a_reply_and_an_option() -> None:
    with pytest.raises(SpecError, match="learns requires a reply"):
        dataclasses.replace(SENSOR, configure=None)


def test_a_sensor_that_returns_with_another_table_is_a_warning() -> None:
    said = [b"0.5 1 1.5 2", b"1 2 3 4"]
    answers = {
        "get_table": lambda request: [
            ("table", {"angles": said.pop(0) if len(said) > 1 else said[0]})
        ]
    }
    sensor = dataclasses.replace(
        SENSOR,
        links={"data": Serial(115_200), "control": Tcp(free_port())},
        on_open=("get_table",),
        simulation=dataclasses.replace(SENSOR.simulation, answers=answers),
    )
    with virtual_port(sensor) as port, ls.open(port.path, sensor) as device:
        assert angles(device) == ANGLES
        port.unplug()
        port.plug()
        told = (
            "after reconnecting, the sensor reports another value of table: open the device again"
        )
        read_until(device, lambda: any(told in warning for warning in device.warnings))


def silent(device: ls.Device) -> bool:
    """Return whether an unanswered heartbeat is reported."""
    return any(
        "beat: no ack frame received" in said and "sending the command again" in said
        for said in device.warnings
    )


def test_a_sensor_that_no_longer_answers_its_heartbeat_is_started_again() -> None:
    order = SENSOR.commands["hello"]
    beat = dataclasses.replace(
        order, values={**order.values, "head.code": 9}, every=0.1, timeout=1.0
    )
    commands = {
        **SENSOR.commands,
        "hello": dataclasses.replace(order, starts=True, timeout=1.0),
        "beat": beat,
    }
    sensor = make_linked_sensor(Udp(free_port()), commands=commands, on_open=("hello", "beat"))
    with (
        virtual_port(sensor, to=f"udp://127.0.0.1:{sensor.links['data'].ports[0]}") as port,
        ls.open(port.path, sensor) as device,
    ):
        device.latest(TIMEOUT_S)
        read_until(device, lambda: port.device.commands_received.count("beat") > 2)
        assert not silent(device)
        port.unplug()
        read_until(device, lambda: silent(device))
        heard = len(port.device.commands_received)
        port.plug()
        read_until(
            device, lambda: "hello" in port.device.commands_received[heard:] and not silent(device)
        )
        assert device.latest(TIMEOUT_S).complete
        begun = port.device.commands_received.count("hello")
        beats = port.device.commands_received.count("beat")
        read_until(device, lambda: port.device.commands_received.count("beat") > beats + 3)
        assert port.device.commands_received.count("hello") == begun, "once is enough"


class Loop(Link):
    """A link that a plugin declares."""


class Looped(LiveTransport):
    """The open link; its other end acknowledges every message."""

    def __init__(self) -> None:
        self.label, self._left = "loop", queue.SimpleQueue[bytes]()

    def read(self, timeout: float) -> list[Chunk]:
        with contextlib.suppress(queue.Empty):
            return [Chunk(self._left.get(timeout=timeout))]
        return []

    def write(self, data: bytes) -> None:
        self._left.put(SENSOR.build("ack", head=SENSOR.parse(data, "order").head, result=0))

    def reopen(self) -> None:
        """Do nothing, because this link does not disappear."""

    def close(self) -> None:
        self.closed = True


class Plugin:
    """A plugin that opens this link."""

    opened: Any = None

    @hookimpl
    def lidarspec_link(self, link: Link, host: str | None) -> Any:
        return self.opened if isinstance(link, Loop) else None


def test_a_plugin_opens_a_link_of_its_own_kind() -> None:
    sensor, plugin = make_linked_sensor(Loop()), Plugin()
    source, plugins = f"udp://127.0.0.1:{free_port()}?control=127.0.0.1", Registry()
    with use_registry(plugins):
        for opened, error, said in [
            (None, UsageError, "'control' is a Loop link, which no installed plugin can open"),
            (3, SpecError, "not a int"),
        ]:
            plugin.opened = opened
            with (
                ls.open(source, sensor) as device,
                pytest.raises((CommandError, error), match=said),
            ):
                device.send("hello")
            if opened is None:
                plugins.add(plugin, name="loops")
        plugin.opened = Looped()
        with ls.open(source, sensor) as device:
            assert device.send("hello").confirmed


def test_a_port_in_use_is_replaced_with_a_warning(server: socket.socket) -> None:
    taken = server.getsockname()[1]
    sensor = make_linked_sensor(Tcp(taken))
    with (
        virtual_port(sensor, to=f"udp://127.0.0.1:{sensor.links['data'].ports[0]}") as port,
        ls.open(port.path, sensor) as device,
    ):
        assert port.outlet.controls["control"].port != taken
        assert device.send("hello").confirmed


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as made:
        made.settimeout(TIMEOUT_S)
        yield made


@pytest.mark.skipif(
    sys.platform != "linux", reason="other systems have no broadcast on the loopback"
)
def test_a_sensor_found_by_broadcast_gets_our_address() -> None:
    sensor = make_linked_sensor(Udp(broadcast=free_port()))
    data = sensor.links["data"].ports[0]
    with (
        virtual_port(sensor, to=f"udp://127.0.0.1:{data}") as port,
        ls.open(f"udp://127.0.0.1:{data}?broadcast=127.255.255.255", sensor) as device,
    ):
        assert device.send("hello", timeout=TIMEOUT_S).confirmed
        assert device.send("call", name="anna").confirmed
        port.wait_for_commands(["hello", "call"])


@pytest.mark.skipif(
    sys.platform != "linux", reason="other systems have no broadcast on the loopback"
)
def test_of_several_that_answer_a_broadcast_the_first_is_the_sensor() -> None:
    number = free_port()
    sensor = make_linked_sensor(Udp(broadcast=number))
    orders = list[Any]()

    def answer(stop: threading.Event) -> None:
        with (
            udp("127.255.255.255") as everybody,
            udp("127.0.0.2") as first,
            udp("127.0.0.3") as second,
        ):
            everybody.close()
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
                heard.bind(("127.255.255.255", number))
                heard.settimeout(TIMEOUT_S)
                data, sender = heard.recvfrom(100)
                orders.append(sensor.parse(data, "order"))
                ack = sensor.build("ack", head=orders[0].head, result=0)
                first.sendto(ack, sender)
                second.sendto(ack, sender)
            first.settimeout(TIMEOUT_S)
            data, sender = first.recvfrom(100)  # which is no longer broadcast
            orders.append(sensor.parse(data, "order"))
            first.sendto(sensor.build("ack", head=orders[1].head, result=0), sender)

    data = sensor.links["data"].ports[0]
    with (
        working(answer),
        ls.open(f"udp://127.0.0.1:{data}?broadcast=127.255.255.255", sensor) as device,
    ):
        assert device.send("hello", timeout=TIMEOUT_S).confirmed
        assert device.send("call", name="anna").confirmed
        read_until(device, lambda: device.stats.foreign == 1)
        assert any(
            "127.0.0.2" in said and "127.0.0.3" in said and "ignoring" in said
            for said in device.warnings
        )
        with udp("127.0.0.2") as own, udp("127.0.0.3") as other:
            other.sendto(sensor.example("data"), ("127.0.0.1", data))
            read_until(device, lambda: device.stats.foreign == 2)
            own.sendto(sensor.example("data"), ("127.0.0.1", data))
            read_until(device, lambda: device.stats.frames)
        assert device.stats.frames == {"data": 1}, "the data are those of the sensor that answered"
    assert list(orders[0].host) == [127, 0, 0, 1]


def test_pages_of_a_web_server_are_read_and_written() -> None:
    body = b'{"serial": "007"}'

    def set_mode(request: Any) -> list[Any]:
        return [
            (
                "page",
                {"status": 200 if request["body"] == b"fast" else 400, "body": request["body"]},
            )
        ]

    sensor = with_pages({"status": [("page", {"status": 200, "body": body})], "set_mode": set_mode})
    with (
        virtual_port(sensor, to=f"udp://127.0.0.1:{sensor.links['data'].ports[0]}") as port,
        ls.open(port.path, sensor) as device,
    ):
        reply = device.send("status")
        assert (reply.values.status, reply.values.body) == (200, body)
        assert device.send("set_mode", mode="fast").values.status == 200
        assert device.send("set_mode", mode="slow").values.status == 400
        port.wait_for_commands(["status", "set_mode", "set_mode"])
        asked = http.client.HTTPConnection(
            "127.0.0.1", port.outlet.controls["web"].port, timeout=TIMEOUT_S
        )
        asked.request("GET", "/status")
        assert asked.getresponse().read() == body, "it is a web server like any other"
        asked.close()
        with pytest.raises(UsageError, match="expected an HTTP message as declared by HttpRequest"):
            device.write(b"GET / HTTP/1.1", "web")


@pytest.mark.parametrize(
    ("sent", "link", "said"),
    [
        (
            b"HTTP/1.1 404 Not Found\r\nContent-Length: 4\r\n\r\nnone",
            Http(1),
            "page with status 404 instead of 200",
        ),
        (
            b"HTTP/1.1 302 Found\r\nLocation: /login\r\nContent-Length: 0\r\n\r\n",
            Http(1),
            "/status: status 302; the redirection to /login was ignored",
        ),
        (
            b"HTTP/1.1 200 OK\r\nContent-Length: 99\r\n\r\n" + bytes(99),
            Http(1, largest=98),
            "the reply is longer than 98 bytes",
        ),
        (
            b"HTTP/1.1 200 OK\r\nContent-Length: 99\r\n\r\nshort",
            Http(1),
            "the reply lacks 94 bytes",
        ),
        (b"something else\r\n\r\n", Http(1), "/status: something else"),
        (b"", Http(1, timeout=0.1), "/status: "),
    ],
)
def test_errors_of_a_web_server_are_reported(
    server: socket.socket, sent: bytes, link: Http, said: str
) -> None:
    def answer(stop: threading.Event) -> None:
        with server.accept()[0] as peer:
            peer.recv(1000)
            peer.sendall(sent)
            if not sent:
                stop.wait(TIMEOUT_S)

    sensor = with_pages({}, dataclasses.replace(link, port=server.getsockname()[1]))
    with (
        working(answer),
        ls.open(f"udp://127.0.0.1:{free_port()}?control=127.0.0.1", sensor) as device,
    ):
        with pytest.raises(CommandError, match=said):
            device.send("status", timeout=0.5)
        assert device.state != "closed"


def test_a_missing_web_server_is_reported() -> None:
    sensor = with_pages({})
    said = pytest.raises(
        ReplyTimeout,
        match=(
            r"no page frame received within 0.3 s; http://127.0.0.1:\d+/status: Connection"
            r" refused"
        ),
    )
    with ls.open(f"udp://127.0.0.1:{free_port()}?control=127.0.0.1", sensor) as device, said:
        device.send("status", timeout=0.3)
