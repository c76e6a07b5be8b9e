"""Benewake TFmini-S, TFmini Plus and TF-Luna: rangefinders with one beam over a UART, which send by
themselves.

Source: TFmini-S manual A01, sections 5 and 7, table 12; TFmini Plus manual A04, the same sections,
and its data sheet A00; TF-Luna manual A05, section 5, appendices I and II. The first TFmini sends
the same frames with other numbers in place of the temperature, and has other commands. Frames do
not say whether their distances are centimetres, as they come, or millimetres:
``configure(unit="mm")`` reads what `set_unit_mm` asks for. The formats of text and those with a
time are not here. A TF-Luna's manual has commands with a sum of 00, which it does not look at; the
others do. The answers that the TFmini-S manual prints to a reset, factory settings and a save have
the sums of their commands; here they are those of their own bytes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import cache
from typing import Any, Literal

from construct import Const, Int8ul, Int16ul, Int32ul, Struct

from lidarspec.spec import (
    Checksummed,
    Command,
    Every,
    Fields,
    Frame,
    Polar,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    Sum,
    hookimpl,
)

# signals below and at which the distance is not to be relied on (TFmini-S 5.3, TF-Luna 5.4)
WEAK = 100
BLINDED = 0xFFFF
UNITS = {"cm": 0.01, "mm": 0.001}
VERSION = 1
RESET = 2
RATE = 3
TRIGGER = 4
FORMAT = 5
BAUD = 6
OUTPUT = 7
FACTORY = 0x10
SAVE = 0x11
HEAD = "header" / Const(b"\x5a") * "then the length of the frame"


@cache
def data(unit: str) -> Frame:
    """Return the frame with a distance in this unit."""
    step = UNITS[unit]
    struct = Struct(
        "header" / Const(b"\x59\x59"),
        "distance" / Scaled(Int16ul, step, "m") * "FFFC and above: none can be told",
        "strength" / Int16ul * "of the signal; below 100 and at FFFF the distance is unreliable",
        "temperature" / Scaled(Int16ul, 1 / 8, "degC", -256) * "of the chip",
        "checksum" / Int8ul,
    )
    return Frame(
        Checksummed(struct, field="checksum", algorithm=Sum(8)),
        data=True,
        plausible=lambda f: (f.distance <= 20) | (f.distance >= 0xFFFC * step),
        acknowledged={"LS712": "its one beam has all points straight ahead"},
    )


def points(f: Fields) -> Polar:
    """One point straight ahead; one that the manual calls unreliable is invalid."""
    unreliable = (f.strength < WEAK) | (f.strength == BLINDED) | (f.distance > 20)
    return Polar(range=f.distance, azimuth=f.distance * 0, intensity=f.strength, invalid=unreliable)


def make_message(size: int, *fields: Any, out: bool = False) -> Frame:
    """Return a message of so many bytes, its length and sum among them."""
    struct = Struct(HEAD, "length" / Const(size, Int8ul), *fields, "checksum" / Int8ul)
    return Frame(
        Checksummed(struct, field="checksum", algorithm=Sum(8)),
        direction="out" if out else "in",
        plausible=None if out or size > 5 else is_known_reply,
    )


def is_known_reply(f: Fields) -> Any:
    """What is answered with one byte: a reset, the format, the output, factory settings, and that
    settings are saved.
    """
    return (
        (f.id == RESET) | (f.id == FORMAT) | (f.id == OUTPUT) | (f.id == FACTORY) | (f.id == SAVE)
    )


def of(number: int) -> Any:
    """Return the field that says what a message is about."""
    return "id" / Const(number, Int8ul)


RATE_FIELD = "rate" / Scaled(Int16ul, 1, "Hz") * "of frames; 0: one for each trigger"
BAUD_FIELD = "baud" / Int32ul
FRAMES = {
    "version": make_message(
        7, of(VERSION), "revision" / Int8ul, "minor" / Int8ul, "major" / Int8ul
    ),
    "rate": make_message(6, of(RATE), RATE_FIELD),
    "baud": make_message(8, of(BAUD), BAUD_FIELD),
    "setting": make_message(
        5, "id" / Int8ul, "value" / Int8ul * "what is set; of an action, 0: it succeeded"
    ),
    "request": make_message(4, "id" / Int8ul, out=True),
    "set_rate": make_message(6, of(RATE), RATE_FIELD, out=True),
    "set_baud": make_message(8, of(BAUD), BAUD_FIELD, out=True),
    "set": make_message(5, "id" / Int8ul, "value" / Int8ul, out=True),
}


def action(number: int) -> Command:
    """What is done once, and answered with 0 where it succeeded."""
    return Command("request", {"id": number}, reply="setting", matches={"id": number})


def setting(number: int, value: int, **more: Any) -> Command:
    """What is set to a value, and answered with the same."""
    return Command(
        "set",
        {"id": number, "value": value},
        reply="setting",
        echoes=("id", "value"),
        retries=1,
        **more,
    )


def commands(fastest: int) -> dict[str, Command]:
    """The commands of a model that sends so many frames a second at most; what is set is lost with
    the power unless it is saved.
    """
    return {
        "get_version": Command("request", {"id": VERSION}, reply="version", retries=1),
        "output_on": setting(OUTPUT, 1, starts=True),
        "output_off": setting(OUTPUT, 0, stops=True),
        "set_rate": Command(
            "set_rate",
            args={"rate": ("rate", 0, fastest)},
            reply="rate",
            echoes=("rate",),
            retries=1,
        ),
        "trigger": Command("request", {"id": TRIGGER}, reply="data"),
        "set_unit_cm": setting(FORMAT, 1),
        "set_unit_mm": setting(FORMAT, 6),
        "set_baud": Command(
            "set_baud", args={"baud": ("baud", 9600, 921_600)}, reply="baud", echoes=("baud",)
        ),
        "save": action(SAVE),
        "factory_settings": action(FACTORY),
        "reset": action(RESET),
    }


def answers() -> dict[str, Any]:
    """What a simulated one answers, where that is more than the reply as it stands."""
    done = {
        name: (("setting", {"id": number, "value": 0}),)
        for name, number in (("save", SAVE), ("factory_settings", FACTORY), ("reset", RESET))
    }
    return {"get_version": (("version", {"revision": 1, "minor": 2, "major": 3}),), **done}


def configure(sensor: Sensor, *, unit: Literal["cm", "mm"] = "cm") -> Sensor:
    """Return the sensor for distances in centimetres, the factory setting, or millimetres."""
    return dataclasses.replace(sensor, frames={**sensor.frames, "data": data(unit)})


#: id -> model, shortest and longest range, most frames a second, source.
MODELS: dict[str, tuple[str, tuple[float, float], int, str]] = {
    "benewake-tfmini": (
        "TFmini-S",
        (0.1, 12.0),
        1000,
        "TFmini-S manual A01, 5.3 and table 12",
    ),
    "benewake-tfmini-plus": (
        "TFmini Plus",
        (0.1, 12.0),
        1000,
        "TFmini Plus manual A04, 5.3 and 7; data sheet A00",
    ),
    "benewake-tfluna": (
        "TF-Luna",
        (0.2, 8.0),
        250,
        "TF-Luna manual A05, 5 and appendix II",
    ),
}


def rangefinder(name: str) -> Sensor:
    """One row of the table as a sensor."""
    model, limits, fastest, source = MODELS[name]
    return Sensor(
        name,
        vendor="Benewake",
        model=model,
        frames={"data": data("cm"), **FRAMES},
        points=points,
        scan=Every(0.1),
        links={"data": Serial(115_200)},
        commands=commands(fastest),
        simulation=Simulation(
            lambda i: {"strength": 1000, "temperature": 21.0}, rate=100, answers=answers()
        ),
        configure=configure,
        on_open=("output_on",),
        range_limits=limits,
        relatives={
            other: "nothing in its frames: the label on the housing"
            for other in MODELS
            if other != name
        },
        info={"temperature": "data.temperature"},
        status="vectors",
        source=source,
    )


TFMINI, TFMINI_PLUS, TF_LUNA = SENSORS = [rangefinder(name) for name in MODELS]


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The Benewake rangefinders."""
    return SENSORS
