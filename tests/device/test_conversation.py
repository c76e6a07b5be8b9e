"""Sensors that are talked to over links of their own: TCP, UDP, a broadcast and HTTP, each a real socket of a simulated sensor."""

from __future__ import annotations

import contextlib
import dataclasses
import http.client
import queue
import socket
import sys
import threading
from collections.abc import Iterator
from typing import Any

import pytest

import lidarspec as ls
from lidarspec.errors import CommandError, ReplyTimeout, SpecError, UsageError
from lidarspec.plugins import Registry, standing_in
from lidarspec.spec import Chunk, Command, Frame, Http, HttpReply, HttpRequest, Link, LiveTransport, Sensor, Tcp, Text, Udp, hookimpl
from lidarspec.testing.fixtures import virtual_port
from tests.lines import SLACK, free_port, udp, until, working
from tests.shapes.conversation import SENSOR

PAGES = {"page": Frame(HttpReply, max_length=4096), "ask": Frame(HttpRequest, direction="out", max_length=4096)}
STATUS = Command(
    "ask", {"method": "GET", "path": b"/status", "body": b""}, reply="page", matches={"status": 200}, link="web", timeout=SLACK
)
SET = Command("ask", {"method": "PUT", "path": b"/mode"}, args={"mode": ("body", Text(40))}, reply="page", link="web", timeout=SLACK)


def linked(control: Link, **more: Any) -> Sensor:
    """The shape with its commands over another link, and free ports."""
    return dataclasses.replace(SENSOR, links={"data": Udp(free_port()), "control": control}, **more)


def with_pages(answers: dict[str, Any], link: Http | None = None) -> Sensor:
    """The shape with a web server."""
    links = {"data": Udp(free_port()), "control": Udp(free_port()), "web": link or Http(free_port())}
    commands = {**SENSOR.commands, "status": STATUS, "set_mode": SET}
    simulation = dataclasses.replace(SENSOR.simulation, answers=answers)
    return dataclasses.replace(SENSOR, frames={**SENSOR.frames, **PAGES}, links=links, commands=commands, simulation=simulation)


@pytest.mark.parametrize("kind", [Udp, Tcp])
def test_a_simulated_sensor_answers_over_a_link_of_its_own(kind: type[Udp | Tcp]) -> None:
    sensor = linked(kind(free_port()))
    data = sensor.links["data"].ports[0]
    with virtual_port(sensor, to=f"udp://127.0.0.1:{data}") as port, ls.open(port.path, sensor) as device:
        assert port.path == f"udp://127.0.0.1:{data}?control=127.0.0.1:{port.outlet.controls['control'].port}"
        assert device.send("call", name="anna").values.head == {"number": 7, "code": 3}
        assert device.send("send_to", host="10.0.0.9", port=2000).values.head == {"number": 8, "code": 2}
        assert device.send("hello").values.head.number == 9
        assert port.device.heard == ["call", "send_to", "hello"]
        assert device.latest(SLACK).complete


class Loop(Link):
    """A link of a plugin's own."""


class Looped(LiveTransport):
    """A line whose other end acknowledges what it is told."""

    def __init__(self) -> None:
        self.label, self._left = "loop", queue.SimpleQueue[bytes]()

    def read(self, timeout: float) -> list[Chunk]:
        with contextlib.suppress(queue.Empty):
            return [Chunk(self._left.get(timeout=timeout))]
        return []

    def write(self, data: bytes) -> None:
        self._left.put(SENSOR.build("ack", head=SENSOR.parse(data, "order").head, result=0))

    def reopen(self) -> None:
        """It does not go away."""

    def close(self) -> None:
        self.closed = True


class Plugin:
    """What opens such a link."""

    opened: Any = None

    @hookimpl
    def lidarspec_link(self, link: Link, host: str | None) -> Any:
        return self.opened if isinstance(link, Loop) else None


def test_a_plugin_opens_a_link_of_its_own_kind() -> None:
    sensor, plugin = linked(Loop()), Plugin()
    source, plugins = f"udp://127.0.0.1:{free_port()}?control=127.0.0.1", Registry()
    with standing_in(plugins):
        for opened, error, said in [(None, UsageError, "no plugin .* opens a Loop link, which control is"), (3, SpecError, "and is a int")]:
            plugin.opened = opened
            with ls.open(source, sensor) as device, pytest.raises((CommandError, error), match=said):
                device.send("hello")
            if opened is None:
                plugins.add(plugin, name="loops")
        plugin.opened = Looped()
        with ls.open(source, sensor) as device:
            assert device.send("hello").confirmed


def test_a_port_that_is_taken_is_replaced_and_said(server: socket.socket) -> None:
    taken = server.getsockname()[1]
    sensor = linked(Tcp(taken))
    with virtual_port(sensor, to=f"udp://127.0.0.1:{sensor.links['data'].ports[0]}") as port, ls.open(port.path, sensor) as device:
        assert port.outlet.controls["control"].port != taken
        assert device.send("hello").confirmed


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as made:
        made.settimeout(SLACK)
        yield made


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no broadcast on the loopback")
def test_a_sensor_is_found_by_a_broadcast_and_told_our_address() -> None:
    sensor = linked(Udp(broadcast=free_port()))
    data = sensor.links["data"].ports[0]
    with (
        virtual_port(sensor, to=f"udp://127.0.0.1:{data}") as port,
        ls.open(f"udp://127.0.0.1:{data}?broadcast=127.255.255.255", sensor) as device,
    ):
        assert device.send("hello", timeout=SLACK).confirmed
        assert device.send("call", name="anna").confirmed
        assert port.device.heard == ["hello", "call"]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no broadcast on the loopback")
def test_of_several_that_answer_a_broadcast_the_first_is_the_sensor() -> None:
    number = free_port()
    sensor = linked(Udp(broadcast=number))
    orders = list[Any]()

    def answer(stop: threading.Event) -> None:
        with udp("127.255.255.255") as everybody, udp("127.0.0.2") as first, udp("127.0.0.3") as second:
            everybody.close()
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
                heard.bind(("127.255.255.255", number))
                heard.settimeout(SLACK)
                data, sender = heard.recvfrom(100)
                orders.append(sensor.parse(data, "order"))
                ack = sensor.build("ack", head=orders[0].head, result=0)
                first.sendto(ack, sender)
                second.sendto(ack, sender)
            first.settimeout(SLACK)
            data, sender = first.recvfrom(100)  # which is no longer broadcast
            orders.append(sensor.parse(data, "order"))
            first.sendto(sensor.build("ack", head=orders[1].head, result=0), sender)

    with working(answer), ls.open(f"udp://127.0.0.1:{free_port()}?broadcast=127.255.255.255", sensor) as device:
        assert device.send("hello", timeout=SLACK).confirmed
        assert device.send("call", name="anna").confirmed
        until(lambda: device.newest(0.01) or device.stats.foreign)
        assert device.stats.foreign == 1
        assert any("127.0.0.2" in said and "127.0.0.3" in said and "left out" in said for said in device.warnings)
    assert list(orders[0].host) == [127, 0, 0, 1]


def test_pages_of_a_web_server_are_read_and_written() -> None:
    body = b'{"serial": "007"}'

    def set_mode(request: Any) -> list[Any]:
        return [("page", {"status": 200 if request["body"] == b"fast" else 400, "body": request["body"]})]

    sensor = with_pages({"status": [("page", {"status": 200, "body": body})], "set_mode": set_mode})
    with virtual_port(sensor, to=f"udp://127.0.0.1:{sensor.links['data'].ports[0]}") as port, ls.open(port.path, sensor) as device:
        reply = device.send("status")
        assert (reply.values.status, reply.values.body) == (200, body)
        assert device.send("set_mode", mode="fast").values.status == 200
        assert device.send("set_mode", mode="slow").values.status == 400
        assert port.device.heard == ["status", "set_mode", "set_mode"]
        asked = http.client.HTTPConnection("127.0.0.1", port.outlet.controls["web"].port, timeout=SLACK)
        asked.request("GET", "/status")
        assert asked.getresponse().read() == body, "it is a web server like any other"
        asked.close()
        with pytest.raises(UsageError, match="over HTTP go messages as HttpRequest describes them"):
            device.write(b"GET / HTTP/1.1", "web")


@pytest.mark.parametrize(
    ("sent", "link", "said"),
    [
        (b"HTTP/1.1 404 Not Found\r\nContent-Length: 4\r\n\r\nnone", Http(1), "page with status 404 instead of 200"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 99\r\n\r\n" + bytes(99), Http(1, largest=98), "the reply is longer than 98 bytes"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 99\r\n\r\nshort", Http(1), "94 bytes too early"),
        (b"something else\r\n\r\n", Http(1), "/status: something else"),
        (b"", Http(1, timeout=0.1), "/status: "),
    ],
)
def test_what_a_web_server_does_wrong_is_said(server: socket.socket, sent: bytes, link: Http, said: str) -> None:
    def answer(stop: threading.Event) -> None:
        with server.accept()[0] as peer:
            peer.recv(1000)
            peer.sendall(sent)
            if not sent:
                stop.wait(SLACK)

    sensor = with_pages({}, dataclasses.replace(link, port=server.getsockname()[1]))
    with working(answer), ls.open(f"udp://127.0.0.1:{free_port()}?control=127.0.0.1", sensor) as device:
        with pytest.raises(CommandError, match=said):
            device.send("status", timeout=0.5)
        assert device.state != "closed"


def test_a_web_server_that_is_not_there_is_said() -> None:
    sensor = with_pages({})
    said = pytest.raises(ReplyTimeout, match=r"no page frame came within 0.3 s; http://127.0.0.1:\d+/status: Connection refused")
    with ls.open(f"udp://127.0.0.1:{free_port()}?control=127.0.0.1", sensor) as device, said:
        device.send("status", timeout=0.3)
