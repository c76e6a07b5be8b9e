"""Benewake TFmini-S, TFmini Plus and TF-Luna: single-beam rangefinders, which stream over a UART.

The CE30-D, a lidar over UDP, is in the module `ce30d`.

Source: TFmini-S manual A01, sections 5 and 7, table 12; TFmini Plus manual A04, the same sections,
and its data sheet A00; TF-Luna manual A05, section 5, appendices I and II. The original TFmini
sends the same frames with other data in place of the temperature, and has other commands. Distances
are in centimetres by default. Frames do not contain the unit, so use ``configure(unit="mm")`` after
the command `set_unit_mm`. Text formats and formats with a time are not supported. A TF-Luna ignores
the checksum of commands, and its manual prints commands with the checksum 00. The TFmini-S manual
prints the replies to reset, factory settings and save with the checksums of their commands.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import cache
from typing import Any, Literal

from construct import Const, Enum, Int8ul, Int16ul, Int32ul, Struct

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
from lidarspec_benewake.ce30d import CE30D

# A distance is unreliable if the strength is below the first or equal to the second value
# (TFmini-S 5.3, TF-Luna 5.4).
MIN_STRENGTH = 100
SATURATED_STRENGTH = 0xFFFF
METRES_PER_UNIT = {"cm": 0.01, "mm": 0.001}
# message ids
VERSION = 1
RESET = 2
RATE = 3
TRIGGER = 4
FORMAT = 5
BAUD = 6
OUTPUT = 7
FACTORY = 0x10
SAVE = 0x11
IDS = {
    "version": VERSION,
    "reset": RESET,
    "rate": RATE,
    "trigger": TRIGGER,
    "format": FORMAT,
    "baud": BAUD,
    "output": OUTPUT,
    "factory_settings": FACTORY,
    "save": SAVE,
}
HEAD = "header" / Const(b"\x5a") * "the next byte is the length of the frame"


@cache
def make_data_frame(unit: str) -> Frame:
    """Return the data frame with distances in this unit, "cm" or "mm"."""
    step = METRES_PER_UNIT[unit]
    struct = Struct(
        "header" / Const(b"\x59\x59"),
        "distance" / Scaled(Int16ul, step, "m") * "FFFC and above: no distance",
        "strength" / Int16ul * "signal strength; below 100 and at FFFF the distance is unreliable",
        "temperature" / Scaled(Int16ul, 1 / 8, "degC", -256) * "temperature of the chip",
        "checksum" / Int8ul,
    )
    return Frame(
        Checksummed(struct, field="checksum", algorithm=Sum(8)),
        data=True,
        plausible=lambda f: (f.distance <= 20) | (f.distance >= 0xFFFC * step),
        acknowledged={"LS712": "the only beam of the sensor points straight ahead"},
    )


def points(f: Fields) -> Polar:
    """Return one point straight ahead.

    The point is invalid if its strength or distance is unreliable according to the manual.
    """
    unreliable = (
        (f.strength < MIN_STRENGTH) | (f.strength == SATURATED_STRENGTH) | (f.distance > 20)
    )
    return Polar(range=f.distance, azimuth=f.distance * 0, intensity=f.strength, invalid=unreliable)


def make_message(size: int, *fields: Any, out: bool = False) -> Frame:
    """Return the frame of a message of `size` bytes, including its length and sum."""
    struct = Struct(HEAD, "length" / Const(size, Int8ul), *fields, "checksum" / Int8ul)
    return Frame(
        Checksummed(struct, field="checksum", algorithm=Sum(8)),
        direction="out" if out else "in",
        plausible=None if out or size > 5 else is_single_byte_reply,
    )


def is_single_byte_reply(f: Fields) -> Any:
    """Return whether the id is that of a reply with a content of one byte."""
    return (
        (f.id == RESET) | (f.id == FORMAT) | (f.id == OUTPUT) | (f.id == FACTORY) | (f.id == SAVE)
    )


def make_id(number: int) -> Any:
    """Return the field that identifies the kind of a message."""
    return "id" / Const(number, Int8ul)


RATE_FIELD = "rate" / Scaled(Int16ul, 1, "Hz") * "frames per second; 0: one frame for each trigger"
BAUD_FIELD = "baud" / Int32ul
ID = "id" / Enum(Int8ul, **IDS)
FRAMES = {
    "version": make_message(
        7, make_id(VERSION), "revision" / Int8ul, "minor" / Int8ul, "major" / Int8ul
    ),
    "rate": make_message(6, make_id(RATE), RATE_FIELD),
    "baud": make_message(8, make_id(BAUD), BAUD_FIELD),
    "setting": make_message(
        5, ID, "value" / Int8ul * "the setting; in the reply to an action, 0 means success"
    ),
    "request": make_message(4, ID, out=True),
    "set_rate": make_message(6, make_id(RATE), RATE_FIELD, out=True),
    "set_baud": make_message(8, make_id(BAUD), BAUD_FIELD, out=True),
    "set": make_message(5, ID, "value" / Int8ul, out=True),
}


def make_action(number: int) -> Command:
    """Return the command for an action; the reply 0 means success."""
    return Command("request", {"id": number}, reply="setting", matches={"id": number})


def make_setting(number: int, value: int, **more: Any) -> Command:
    """Return the command that sets a value; the reply repeats the id and the value."""
    return Command(
        "set",
        {"id": number, "value": value},
        reply="setting",
        echoes=("id", "value"),
        retries=1,
        **more,
    )


def make_commands(fastest: int) -> dict[str, Command]:
    """Return the commands of a model.

    Settings are lost at power-off unless they are saved.

    Args:
        fastest: the highest frame rate in Hz.
    """
    return {
        "get_version": Command("request", {"id": VERSION}, reply="version", retries=1),
        "output_on": make_setting(OUTPUT, 1, starts=True),
        "output_off": make_setting(OUTPUT, 0, stops=True),
        "set_rate": Command(
            "set_rate",
            args={"rate": ("rate", 0, fastest)},
            reply="rate",
            echoes=("rate",),
            retries=1,
        ),
        "trigger": Command("request", {"id": TRIGGER}, reply="data"),
        "set_unit_cm": make_setting(FORMAT, 1),
        "set_unit_mm": make_setting(FORMAT, 6),
        "set_baud": Command(
            "set_baud", args={"baud": ("baud", 9600, 921_600)}, reply="baud", echoes=("baud",)
        ),
        "save": make_action(SAVE),
        "factory_settings": make_action(FACTORY),
        "reset": make_action(RESET),
    }


def make_answers() -> dict[str, Any]:
    """Return the simulated replies that do not depend on the request."""
    action_replies = {
        name: (("setting", {"id": number, "value": 0}),)
        for name, number in (("save", SAVE), ("factory_settings", FACTORY), ("reset", RESET))
    }
    return {
        "get_version": (("version", {"revision": 1, "minor": 2, "major": 3}),),
        **action_replies,
    }


def configure(sensor: Sensor, *, unit: Literal["cm", "mm"] = "cm") -> Sensor:
    """Return the sensor for distances in centimetres or millimetres.

    Centimetres are the factory setting.
    """
    return dataclasses.replace(sensor, frames={**sensor.frames, "data": make_data_frame(unit)})


#: The models by id: name, range limits in m, highest frame rate in Hz, source.
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


def make_rangefinder(name: str) -> Sensor:
    """Return the sensor of one row of `MODELS`."""
    model, limits, fastest, source = MODELS[name]
    return Sensor(
        name,
        vendor="Benewake",
        model=model,
        frames={"data": make_data_frame("cm"), **FRAMES},
        points=points,
        scan=Every(0.1),
        links={"data": Serial(115_200)},
        commands=make_commands(fastest),
        simulation=Simulation(
            lambda i: {"strength": 1000, "temperature": 21.0}, rate=100, answers=make_answers()
        ),
        configure=configure,
        on_open=("output_on",),
        range_limits=limits,
        relatives={
            other: "both models send the same frames; the label on the housing names the model"
            for other in MODELS
            if other != name
        },
        info={"temperature": "data.temperature"},
        status="vectors",
        source=source,
    )


TFMINI, TFMINI_PLUS, TF_LUNA = [make_rangefinder(name) for name in MODELS]
SENSORS = [TFMINI, TFMINI_PLUS, TF_LUNA, CE30D]


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Benewake sensors."""
    return SENSORS
