"""Tests of commands from the page: forms, bytes, replies and permissions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import lidarspec as ls
from lidarspec.explaining.assignments import parse_arguments
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.transports.destinations import make_simulated_outlet
from lidarspec.transports.serving import ServedSensor
from tests.installed import sensor_modules, sensors_in

from .pages import FLAT, Page, Station, write_recording

STREAM, TEXT = "slamtec-rplidar-a1", "hokuyo-urg04lx"
SPINNING, ANSWERING = "ldrobot-ld14p", "benewake-tfmini-plus"


def forms(page: Page) -> dict[str, Any]:
    return {command["name"]: command for command in page.until("hello")["commands"]}


def test_the_commands_of_the_spec_are_forms(tmp_path: Path) -> None:
    with Station(f"sim:{SPINNING}", tmp_path) as station, station.page() as page:
        hello = page.until("hello")
        assert (hello["control"], hello["why_no_control"]) == (True, "")
        named = {command["name"]: command for command in hello["commands"]}
        assert list(named) == list(ls.sensor(SPINNING).commands)
        (speed,) = named["set_speed"]["arguments"]
        low, high = ls.sensor(SPINNING).commands["set_speed"].args["speed"][1:]
        assert (speed["name"], speed["low"], speed["high"]) == ("speed", low, high)
        assert speed["unit"]
        assert "starts the data" in named["start"]["text"]


@pytest.mark.slow
def test_other_arguments_show_their_accepted_values(tmp_path: Path) -> None:
    with Station(f"sim:{TEXT}", tmp_path) as station, station.page() as page:
        (value,) = forms(page)["set_baud"]["arguments"]
        assert (value["low"], value["high"]) == (None, None)
        assert "a string" in value["text"]


def test_the_bytes_are_seen_before_they_are_sent(tmp_path: Path) -> None:
    sensor = ls.sensor(SPINNING)
    with Station(f"sim:{SPINNING}", tmp_path) as station, station.page() as page:
        composed = page.request("compose", command="set_speed", arguments={"speed": "6 Hz"})
        given = parse_arguments(sensor, "set_speed", ["speed=6 Hz"])
        assert composed["hex"] == sensor.command("set_speed", **given).hex()
        assert composed["explanation"]["fault"] is None
        assert station.broadcast.device.stats.frames.get("reply", 0) == 0  # nothing was sent


WRONG_ARGUMENTS: list[tuple[str, dict[str, str]]] = [
    ("set_speed", {"speed": "1e6"}),
    ("set_speed", {}),
    ("set_speed", {"sped": "6"}),
    ("dance", {}),
]


def test_invalid_arguments_are_refused(tmp_path: Path) -> None:
    with Station(f"sim:{SPINNING}", tmp_path) as station, station.page() as page:
        for command, words in WRONG_ARGUMENTS:
            for word in ("compose", "send"):
                refused = page.request(word, command=command, arguments=words)
                assert (refused["is"], refused["of"], refused["command"]) == (
                    "refused",
                    word,
                    command,
                )
                assert command in refused["text"]


def test_a_reply_is_shown_while_scans_continue(tmp_path: Path) -> None:
    with Station(f"sim:{ANSWERING}", tmp_path) as station, station.page() as page:
        first, _ = page.scan()
        replied = page.request("send", command="get_version", arguments={})
        assert (replied["is"], replied["command"]) == ("replied", "get_version")
        assert bytes.fromhex(replied["hex"])
        assert replied["text"].startswith("replied with ")
        assert page.scan()[0]["scan"] > first["scan"]


@pytest.mark.slow
def test_a_command_without_an_answer_is_sent(tmp_path: Path) -> None:
    """The rotor stops, and the data with it."""
    with Station(f"sim:{STREAM}", tmp_path) as station, station.page() as page:
        page.scan()
        assert "unknown" in page.request("send", command="stop", arguments={})["text"]
        page.state(lambda state: state["state"] == "silent")
        page.request("send", command="scan", arguments={})
        page.scan()


@pytest.mark.slow
def test_a_real_device_takes_commands_only_with_control(tmp_path: Path) -> None:
    sensor = ls.sensor(ANSWERING)
    with ServedSensor(
        SimulatedDevice(sensor), make_simulated_outlet(sensor, "tcp://127.0.0.1:0"), patient=True
    ) as served:
        with Station(served.path, tmp_path, ANSWERING) as station, station.page() as page:
            hello = page.until("hello")
            assert not hello["control"]
            assert "--control" in hello["why_no_control"]
            assert "--control" in page.request("send", command="get_version", arguments={})["text"]
            assert page.request("compose", command="get_version", arguments={})["is"] == "composed"
        with (
            Station(served.path, tmp_path, ANSWERING, control=True) as station,
            station.page() as page,
        ):
            assert page.until("hello")["control"]
            assert page.request("send", command="get_version", arguments={})["is"] == "replied"


@pytest.mark.parametrize("sensor", [FLAT, pytest.param(STREAM, marks=pytest.mark.slow)])
def test_a_file_takes_no_commands(tmp_path: Path, sensor: str) -> None:
    with (
        Station(write_recording(tmp_path, sensor), tmp_path, control=True) as station,
        station.page() as page,
    ):
        hello = page.until("hello")
        assert not hello["control"]
        assert hello["why_no_control"]
        for name in ls.sensor(sensor).commands:
            assert page.request("send", command=name, arguments={})["is"] == "refused"


KEYS_OF_AN_ARGUMENT = {"name", "text", "unit", "low", "high", "choices", "default"}


@pytest.mark.slow
@pytest.mark.parametrize("module", sensor_modules())
def test_every_command_of_every_sensor_has_a_form(module: str) -> None:
    from lidarspec_web.command_forms import make_form

    for sensor in sensors_in(module):
        for name in sensor.commands:
            described = make_form(sensor, name)
            assert described["name"] == name, sensor.id
            assert all(
                argument.keys() == KEYS_OF_AN_ARGUMENT for argument in described["arguments"]
            ), sensor.id
