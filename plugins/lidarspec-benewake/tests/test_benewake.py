"""Tests of Benewake TFmini and TF-Luna: the manuals' frames, commands and units."""

from __future__ import annotations

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.errors import OutOfRange
from lidarspec.testing.fixtures import virtual_port
from tests.evidence import decode, vector_bytes, vectors

FILE = "vectors_serial2d.json"
TFMINI = ls.sensor("benewake-tfmini")
COMMANDS = {
    "tfmini_set_rate_1000": ("set_rate", {"rate": 1000}),
    "tfmini_get_version": ("get_version", {}),
    "tfmini_save": ("save", {}),
    "tfmini_output_on": ("output_on", {}),
}


def frame(distance: int, strength: int = 1000) -> bytes:
    return TFMINI.build("data", distance=distance, strength=strength, temperature=2216)


def test_every_vector_of_the_family_is_used() -> None:
    assert {name for name in vectors(FILE) if name.startswith("tfmini_")} == {
        "tfmini_frame_synth",
        *COMMANDS,
    }


def test_the_published_frame() -> None:
    data, expected = (
        vector_bytes(FILE, "tfmini_frame_synth"),
        vectors(FILE)["tfmini_frame_synth"]["expected"],
    )
    packets = decode(TFMINI, data)
    assert packets["distance"].tolist() == [expected["dist_cm"] / 100]
    assert packets["strength"].tolist() == [expected["strength"]]
    assert packets["temperature"].tolist() == [expected["temp_c"]]
    assert packets.points().xyz.tolist() == [[3.0, 0.0, 0.0]]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_the_manuals(name: str) -> None:
    command, arguments = COMMANDS[name]
    assert TFMINI.command(command, **arguments) == vector_bytes(FILE, name)


def test_unreliable_measurements_are_not_points() -> None:
    cloud = decode(
        TFMINI, frame(300) + frame(300, 99) + frame(300, 0xFFFF) + frame(0xFFFF) + frame(0)
    ).points()
    assert cloud.valid.tolist() == [True, False, False, False, False]
    assert np.isnan(cloud.range[1:4]).all()
    assert decode(TFMINI, frame(4000)).stats.frames == {}


def test_the_millimetre_option_is_applied() -> None:
    assert TFMINI.configure(unit="mm").decode(frame(300)).points().range.tolist() == [
        pytest.approx(0.3)
    ]
    assert TFMINI.configure(unit="cm").decode(frame(300)).points().range.tolist() == [3.0]
    with pytest.raises(ls.UsageError, match="'cm' or 'mm'"):
        TFMINI.configure(unit="m")


def test_a_simulated_one_answers() -> None:
    with (
        virtual_port("benewake-tfluna") as made,
        ls.open(made.path, sensor="benewake-tfluna") as device,
    ):
        assert device.send("get_version")["major"] == 3
        assert device.send("set_rate", rate=250)["rate"] == 250
        assert (device.send("save")["value"], device.send("factory_settings")["id"]) == (0, 0x10)
        with pytest.raises(OutOfRange):
            device.send("set_rate", rate=500)
        assert device.latest(timeout=30).points.x.size
