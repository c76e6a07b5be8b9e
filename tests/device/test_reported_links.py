"""Tests of commands that contain values of earlier replies, and of links that a reply reports.

The sensors are simulated on real sockets.
"""

from __future__ import annotations

import dataclasses
import socket
import sys
from typing import Any

import pytest

import lidarspec as ls
from lidarspec.device.demo import demonstrate
from lidarspec.device.session import Session
from lidarspec.errors import CommandError, OutOfRange, SourceError, SpecError, UsageError
from lidarspec.spec import Command, Http, Port, Sensor, Simulation, Tcp, Template, Text, Udp
from lidarspec.testing.check import CheckTarget, iter_reports
from lidarspec.testing.fixtures import virtual_port
from tests.lines import TIMEOUT_S, free_port, read_until
from tests.shapes.conversation import HANDLES, REPORTED, SENSOR, make_handle_sensor, page


def on_free_port(sensor: Sensor, **answers: Any) -> Sensor:
    """Return a shape with its web server on a free port, and with other simulated replies."""
    simulation = dataclasses.replace(
        sensor.simulation, answers={**sensor.simulation.answers, **answers}
    )
    links = {**sensor.links, "web": Http(free_port())}
    return dataclasses.replace(sensor, links=links, simulation=simulation)


def test_a_template_contains_arguments_and_values_of_replies() -> None:
    text = Template("/start?handle={handle}&port={own_port}")
    assert text.names == ("handle", "own_port")
    assert text.fill({"handle": "s10", "own_port": 2368}) == b"/start?handle=s10&port=2368"
    assert text.match(b"/start?handle=s10&port=2368") == {"handle": "s10", "own_port": "2368"}
    assert text.match(b"/start?handle=s10&more=1&port=2368") is None
    assert HANDLES.parse(HANDLES.command("set_rate", rate=7.5), "ask").path == b"/rate?hz=7.5"
    assert HANDLES.parse(HANDLES.command("set_rate", rate=10.0), "ask").path == b"/rate?hz=10"
    assert HANDLES.parse(HANDLES.command("start", handle="a"), "ask").path == b"/start?handle=a"
    assert HANDLES.parse(HANDLES.command("start"), "ask").path == b"/start?handle=0"
    with pytest.raises(OutOfRange, match="rate"):
        HANDLES.command("set_rate", rate=30)
    with pytest.raises(UsageError, match="name must consist of letters"):
        HANDLES.command("set_name", name="a&b=c")
    with pytest.raises(UsageError, match="string of up to 8 bytes"):
        HANDLES.command("set_name", name="123456789")


@pytest.mark.parametrize("text", ["/start", "{a}{a}", "{a.b}", "{a:3}", "{", "{}", "é{a}"])
def test_an_invalid_template_is_an_error(text: str) -> None:
    with pytest.raises(SpecError, match="Template"):
        Template(text)


@pytest.mark.parametrize("sensor", [HANDLES, REPORTED], ids=lambda sensor: sensor.model)
def test_a_sensor_that_is_started_with_a_handle_conforms(sensor: Sensor) -> None:
    (report,) = iter_reports(CheckTarget([sensor]), sensor.id, examples=2)
    assert report.findings == []


def test_a_sensor_sends_to_the_address_in_a_request() -> None:
    sensor = on_free_port(HANDLES)
    with virtual_port(sensor, to="udp://127.0.0.1") as port:
        web = port.outlet.controls["web"].port
        assert port.path == f"udp://127.0.0.1?control=127.0.0.1:{web}"
        with ls.open(port.path, sensor) as device:
            assert device.latest(TIMEOUT_S).complete
            host, number = port.device.destination or ("", 0)
            assert (host, number > 1023) == ("127.0.0.1", True)
            assert device.send("set_rate", rate=7.5).values.body == b'{"error": "", "rate": 7.5}'
            assert device.send("set_name", name="anna").confirmed
        port.wait_for_commands(
            [
                "request_handle",
                "start",
                "set_rate",
                "set_name",
                "stop",
            ]
        )


def test_data_comes_from_the_port_that_a_reply_reports() -> None:
    sensor = on_free_port(REPORTED)
    with virtual_port(sensor, to="tcp://127.0.0.1") as port:
        web = port.outlet.controls["web"].port
        assert port.path == f"tcp://127.0.0.1?control=127.0.0.1:{web}"
        with ls.open(port.path, sensor) as device:
            assert device.latest(TIMEOUT_S).complete
            port.unplug()
            read_until(device, lambda: device.stats.disconnects == 1)
            port.plug()
            read_until(device, lambda: port.device.commands_received.count("start") == 2)
            assert device.latest(TIMEOUT_S).complete, "it is started again with a new handle"


@pytest.mark.parametrize(
    ("answers", "name", "error"),
    [
        ({"request_handle": page(error="busy")}, "", "request_handle: the sensor reports 'busy'"),
        ({"request_handle": page(handle="s9")}, "", "the sensor reports 'no such handle'"),
        ({"request_handle": page(handle="s10&a=b")}, "", "handle must consist of letters"),
        (
            {"request_handle": page(handle=[1])},
            "",
            "`provides` must return a number or a string for handle, got list",
        ),
        ({"request_handle": page()}, "", "start: handle is unknown"),
        ({"request_handle": [("page", {"status": 500, "body": b""})]}, "", "status 500"),
        ({"set_name": [("page", {"status": 200, "body": b"[]"})]}, "set_name", "TypeError"),
    ],
)
def test_a_reply_without_the_value_is_a_command_error(
    answers: dict[str, Any], name: str, error: str
) -> None:
    sensor = on_free_port(HANDLES, **answers)
    with virtual_port(sensor, to="udp://127.0.0.1") as port:
        if not name:
            with pytest.raises(CommandError, match=error):
                ls.open(port.path, sensor)
            return
        with ls.open(port.path, sensor) as device, pytest.raises(CommandError, match=error):
            device.send(name, name="anna")


def test_a_command_without_its_value_is_not_sent() -> None:
    session = Session(HANDLES)
    assert "handle is unknown" in str(session.request("start", 0).failure)
    assert session.take_outgoing() == []


def test_a_reported_port_that_refuses_the_connection_is_an_error() -> None:
    sensor = on_free_port(REPORTED, request_handle=page(handle="s10", data_port=free_port()))
    with (
        virtual_port(sensor, to="tcp://127.0.0.1") as port,
        pytest.raises(SourceError, match="refuses connections"),
    ):
        ls.open(port.path, sensor)


@pytest.mark.parametrize("sensor", [HANDLES, REPORTED], ids=lambda sensor: sensor.model)
def test_the_demonstration_starts_the_sensor(sensor: Sensor) -> None:
    result = demonstrate(on_free_port(sensor), scan_count=1)
    assert [reply.command for reply in result.replies] == ["request_handle", "start"]
    assert result.digest == result.recorded_digest


@pytest.mark.skipif(
    sys.platform != "linux", reason="other systems have no broadcast on the loopback"
)
def test_the_demonstration_finds_a_sensor_without_a_broadcast() -> None:
    links = {"data": Udp(free_port()), "control": Udp(broadcast=free_port())}
    sensor = dataclasses.replace(SENSOR, links=links, on_open=("hello",))
    assert [reply.command for reply in demonstrate(sensor, scan_count=1).replies] == ["hello"]


def test_a_simulated_source_needs_no_ports() -> None:
    for sensor in (HANDLES, REPORTED):
        with ls.open("sim:?rate=max", sensor) as device:
            assert device.latest(TIMEOUT_S).complete


def test_a_port_among_the_arguments_redirects_the_data() -> None:
    links = {"data": Udp(free_port()), "control": Udp(free_port())}
    sensor = dataclasses.replace(SENSOR, links=links)
    with (
        virtual_port(sensor, to=f"udp://127.0.0.1:{links['data'].ports[0]}") as port,
        ls.open(port.path, sensor) as device,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        other.bind(("127.0.0.1", 0))
        other.settimeout(TIMEOUT_S)
        device.latest(TIMEOUT_S)
        device.send("send_to", host="0.0.0.0", port=other.getsockname()[1], timeout=TIMEOUT_S)
        sensor.parse(other.recv(2000), "data")
        device.send("send_to", host="127.0.0.1", port=links["data"].ports[0], timeout=TIMEOUT_S)
        device.latest(TIMEOUT_S)


def over_data(link: Udp) -> Sensor:
    """Return the shape with a start command over the data link."""
    order = dataclasses.replace(SENSOR.commands["hello"], link="data", starts=True, timeout=5.0)
    return dataclasses.replace(
        SENSOR,
        links={"data": link},
        commands={"hello": dataclasses.replace(order, values={**order.values, "head.code": 1})},
        on_open=("hello",),
        simulation=Simulation(SENSOR.simulation.sweep, rate=900),
    )


def test_commands_over_the_data_link_go_to_the_sensor_before_it_sends() -> None:
    sensor = over_data(Udp(free_port()))
    data = sensor.links["data"].ports[0]
    with virtual_port(sensor, to=f"udp://127.0.0.1:{data}") as port:
        assert port.path.startswith(f"udp://127.0.0.1:{data}?src=127.0.0.1:")
        with ls.open(port.path, sensor) as device:
            assert device.latest(TIMEOUT_S).complete
        port.wait_for_commands(["hello"])
        # The sensor sends to the port that its commands come from.
        elsewhere = port.path.replace(f":{data}?", f":{free_port()}?")
        with ls.open(elsewhere, sensor) as device:
            assert device.latest(TIMEOUT_S).complete


def test_a_command_without_an_address_is_an_error() -> None:
    sensor = over_data(Udp(free_port()))
    hello = dataclasses.replace(sensor.commands["hello"], reply=None, echoes=(), timeout=0.1)
    sensor = dataclasses.replace(sensor, commands={"hello": hello}, simulation=Simulation())
    source = f"udp://127.0.0.1:{sensor.links['data'].ports[0]}"
    with pytest.raises(CommandError, match=r"hello: .*the address of the sensor is unknown"):
        ls.open(source, sensor)


@pytest.mark.parametrize("option", ["control", "src"])
def test_commands_over_the_data_link_go_to_the_declared_port(option: str) -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as lidar,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other_port,
    ):
        lidar.bind(("127.0.0.1", 0))
        lidar.settimeout(TIMEOUT_S)
        sensor = over_data(Udp(lidar.getsockname()[1]))
        source = f"udp://127.0.0.1:{free_port()}?{option}=127.0.0.1"
        with ls.open(source, sensor, start=False) as device:
            device.write(sensor.command("hello"))
            data, sender = lidar.recvfrom(100)
            assert data == sensor.command("hello")
            assert sender[1] == int(source.partition("?")[0].rpartition(":")[2])
            other_port.sendto(sensor.example("data"), sender)
            read_until(device, lambda: device.stats.frames)
            device.write(sensor.command("hello"))
            assert lidar.recv(100) == sensor.command("hello"), "data may come from another port"


@pytest.mark.skipif(
    sys.platform != "linux", reason="other systems have no broadcast on the loopback"
)
def test_commands_over_the_data_link_are_broadcast_until_the_sensor_sends() -> None:
    number = free_port()
    sensor = over_data(Udp(broadcast=number))
    source = f"udp://127.0.0.1:{free_port()}?broadcast=127.255.255.255"
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as everybody,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as lidar,
    ):
        everybody.bind(("127.255.255.255", number))
        lidar.bind(("127.0.0.1", number))
        for one in (everybody, lidar):
            one.settimeout(TIMEOUT_S)
        with ls.open(source, sensor, start=False) as device:
            device.write(sensor.command("hello"))
            _, sender = everybody.recvfrom(100)
            lidar.sendto(sensor.example("data"), sender)
            read_until(device, lambda: device.stats.frames)
            device.write(sensor.command("hello"))
            assert lidar.recv(100) == sensor.command("hello"), "it is no longer broadcast"


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (Tcp, "Tcp requires a port"),
        (lambda: Tcp(1, reported="port"), "Tcp requires a port"),
        (
            lambda: dataclasses.replace(SENSOR, links={**SENSOR.links, "data": Tcp(reported="a")}),
            "`reported` requires that a command in `on_open` provides the port",
        ),
        (
            lambda: dataclasses.replace(
                HANDLES,
                commands={"start": dataclasses.replace(HANDLES.commands["start"], provides=None)},
            ),
            "no command has a `provides` function",
        ),
        (
            lambda: dataclasses.replace(
                SENSOR,
                commands={"call": Command("order", provides=dict)},
                simulation=Simulation(),
            ),
            "provides requires a reply",
        ),
    ],
)
def test_an_incomplete_declaration_is_an_error(change: Any, error: str) -> None:
    with pytest.raises(SpecError, match=error):
        change()


def test_an_argument_of_a_template_must_be_in_it() -> None:
    command = dataclasses.replace(
        HANDLES.commands["set_rate"], args={"speed": ("path", 1, 2), "rate": ("path", Text(3))}
    )
    sensor = dataclasses.replace(HANDLES, commands={**HANDLES.commands, "set_rate": command})
    with pytest.raises(SpecError, match=r"the argument 'speed' must be named in the text"):
        sensor.command("set_rate", speed=1, rate="a")
    changed = dataclasses.replace(command, args={"rate": ("path", bytes)})
    sensor = dataclasses.replace(HANDLES, commands={**HANDLES.commands, "set_rate": changed})
    with pytest.raises(SpecError, match=r"the argument 'rate' must be named in the text"):
        sensor.command("set_rate", rate=b"1")


def test_a_port_is_a_number() -> None:
    with pytest.raises(OutOfRange):
        SENSOR.command("send_to", host="10.0.0.9", port=65536)
    assert Port() == Port(1, 65535)
    assert make_handle_sensor(Udp()).announces_port
