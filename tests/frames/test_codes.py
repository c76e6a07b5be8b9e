"""Tests of codes: a field with construct's Enum is a number with a name."""

from __future__ import annotations

import copy
import dataclasses
import json
import pickle
import shutil
import subprocess
from pathlib import Path

import pytest
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Const,
    Enum,
    GreedyBytes,
    Int8ul,
    Int16ul,
    NullTerminated,
    Struct,
    Switch,
    this,
)

import lidarspec as ls
from lidarspec import Sensor, SpecError, UsageError
from lidarspec.device.session import Session
from lidarspec.explaining.assignments import parse_arguments, parse_values
from lidarspec.explaining.explanation import explain
from lidarspec.explaining.formatting import describe_argument
from lidarspec.exports import export
from lidarspec.frames.schema import make_schema
from lidarspec.framing.results import Found
from lidarspec.simulation.frame_maker import FrameMaker
from lidarspec.spec import Choice, Command, EnumValue, Frame, Serial

MODE = Enum(Int8ul, idle=1, strongest=0x37, **{"last and strongest": 0x39})
HEAD = (
    "sync" / Const(b"\xa5"),
    "mode" / MODE,
    "flags" / BitStruct("level" / Enum(BitsInteger(6), low=0, high=1), "on_air" / BitsInteger(2)),
    "modes" / Array(2, MODE),
    "model" / Enum(Int16ul, **{"ACME X1": 0x18, "ACME X2": 0x1F}),
)
FRAMES = {
    "report": Frame(Struct(*HEAD)),
    "text": Frame(
        Struct(
            "sync" / Const(b"\x5a"),
            "mode" / MODE,
            "text" / Array(1, NullTerminated(GreedyBytes)),
        ),
        max_length=20,
    ),
    "set": Frame(Struct("sync" / Const(b"\xc3"), "mode" / MODE), direction="out"),
}
DATA = bytes.fromhex("a5 37 06 39 63 18 00")


def make_sensor(**more: object) -> Sensor:
    return Sensor(
        "acme-codes",
        vendor="ACME",
        model="ACME X1",
        frames=FRAMES,
        links={"data": Serial(9600)},
        commands={
            "set_mode": Command("set", args={"mode": ("mode", 0, 0x37)}, reply="report"),
            "choose": Command("set", args={"mode": ("mode", 1, 1)}),
            "idle": Command("set", {"mode": "idle"}, reply="report", matches={"mode": "idle"}),
        },
        info={"model": "report.model"},
        status="manual",
        source="invented",
        **more,
    )


SENSOR = make_sensor()
#: without the frame that only construct can read.
COMPILED = dataclasses.replace(
    SENSOR, frames={name: frame for name, frame in FRAMES.items() if name != "text"}
)


def test_a_code_is_its_number_with_a_name() -> None:
    for value in (SENSOR.parse(DATA).mode, SENSOR.parse(b"\x5a\x37ab\0").mode):
        assert isinstance(value, EnumValue)
        assert value == 0x37 == int(value)
        assert hash(value) == hash(0x37)
        assert {0x37: "found"}[value] == "found"
        assert (value.name, str(value), f"{value}", f"{value:#04x}") == (
            "strongest",
            "strongest (0x37)",
            "strongest (0x37)",
            "0x37",
        )
        assert json.dumps([value]) == "[55]"
        for again in (copy.deepcopy(value), pickle.loads(pickle.dumps(value))):
            assert (again, again.name) == (0x37, "strongest")


def test_names_of_bits_arrays_and_unknown_codes() -> None:
    parsed = SENSOR.parse(DATA)
    assert (str(parsed.flags.level), parsed.flags.on_air) == ("high (1)", 2)
    assert [value.name for value in parsed.modes] == ["last and strongest", ""]
    assert str(parsed.modes[1]) == "99"
    assert SENSOR.parse(b"\x5a\x63\0").mode.name == ""


@pytest.mark.parametrize("data", [DATA, b"\x5a\x37ab\0", b"\x5a\x63\0"])
def test_parsed_codes_rebuild_the_bytes(data: bytes) -> None:
    parsed = SENSOR.parse(data)
    frame = "report" if data == DATA else "text"
    assert SENSOR.build(frame, parsed) == data
    assert SENSOR.build(frame, dict(parsed, mode="strongest"))[1] == 0x37


def test_columns_stay_integers() -> None:
    packets = SENSOR.decode(DATA * 3, frame="report")
    assert packets.raw["mode"].dtype == "u1"
    assert packets["mode"].tolist() == [55] * 3


def test_explanations_show_names_and_unknown_codes() -> None:
    fields = explain(DATA, SENSOR).fields
    assert str(fields["mode"]) == "strongest (0x37)"
    assert str(fields["flags.level"]) == "high (1)"
    assert str(fields["modes[1]"]) == "unknown code (0x63)"
    assert fields["modes[1]"].to_dict()["unknown"] is True
    assert fields["flags.on_air"].has_meaning is False


def test_build_on_the_command_line_takes_a_name_or_a_number() -> None:
    schema = make_schema(FRAMES["report"].tree)
    for text in ("mode=last and strongest", "mode=0x39", "mode=57"):
        assert parse_values(schema, [text], "x") == {"mode": 0x39}


def test_build_on_the_command_line_lists_the_names() -> None:
    schema = make_schema(FRAMES["report"].tree)
    with pytest.raises(UsageError, match="expected idle or strongest or last and strongest or a"):
        parse_values(schema, ["mode=strongst"], "x")


def test_a_simulated_device_takes_names() -> None:
    made = FrameMaker(SENSOR, "report").frame({"mode": "strongest", "flags.level": "high"})
    assert (made[1], made[2]) == (0x37, 0b100)
    with ls.open("sim:", SENSOR) as device:
        assert device.send("idle").values.mode.name == "idle"


def test_arguments_take_names_within_their_range() -> None:
    assert SENSOR.command("set_mode", mode="strongest") == b"\xc3\x37"
    assert SENSOR.command("set_mode", mode=0x37) == b"\xc3\x37"
    assert SENSOR.command("set_mode", mode=EnumValue(1, "idle")) == b"\xc3\x01"
    for name in ("last and strongest", "fastest"):  # one is beyond the range, one is no name
        with pytest.raises(UsageError, match="idle or strongest"):
            SENSOR.command("set_mode", mode=name)
    assert parse_arguments(SENSOR, "set_mode", ["mode=idle"]) == {"mode": "idle"}
    assert parse_arguments(SENSOR, "set_mode", ["mode=0x37"]) == {"mode": 0x37}
    assert describe_argument(SENSOR, "choose", "mode") == "idle"
    assert describe_argument(SENSOR, "set_mode", "mode") == "idle|strongest|0..55"


def test_a_command_has_names_of_its_own_for_a_shared_field() -> None:
    shared = Frame(Struct("sync" / Const(b"\xd2"), "number" / Int8ul), direction="out")
    fan = Choice(off=0, on=1)
    commands = {
        "set_fan": Command("set", args={"fan": ("number", fan)}, retries=0),
        "set_returns": Command("set", args={"returns": ("number", Choice(first=4, dual=6))}),
    }
    sensor = dataclasses.replace(COMPILED, frames={"report": FRAMES["report"], "set": shared})
    sensor = dataclasses.replace(sensor, commands=commands)
    assert sensor.command("set_fan", fan="on") == sensor.command("set_fan", fan=1) == b"\xd2\1"
    assert sensor.command("set_returns", returns="dual") == b"\xd2\6"
    with pytest.raises(UsageError, match="must be off or on"):
        sensor.command("set_fan", fan="dual")
    for wrong in (5, 7, 4.5):
        with pytest.raises(UsageError, match=r"one of first \(4\), dual \(6\)"):
            sensor.command("set_returns", returns=wrong)
    assert describe_argument(sensor, "set_fan", "fan") == "off|on"
    assert describe_argument(sensor, "set_returns", "returns") == "first|dual"
    assert parse_arguments(sensor, "set_fan", ["fan=on"]) == {"fan": "on"}
    exported = json.loads(export(sensor, "json"))["commands"]["set_fan"]["args"]["fan"]
    assert exported["names"] == {"off": 0, "on": 1}
    for wrong in ({}, {"on": 1.5}, {"on": True}, {"off": 0, "on": 0}):
        with pytest.raises(SpecError):
            Choice(**wrong)
    wide = Command("set", args={"fan": ("number", Choice(off=-1, on=300))})
    beyond = dataclasses.replace(sensor, commands={"set_fan": wide})
    with pytest.raises(SpecError, match="can contain all numbers of the Choice"):
        beyond.command("set_fan", fan="on")


def test_a_reply_must_have_the_code_that_is_named() -> None:
    session = Session(SENSOR)
    request = session.request("idle", 0)
    session.tick(0)
    session.receive([Found("report", 0, DATA)], 1)
    assert not request.done
    session.receive([Found("report", 0, b"\xa5\x01" + DATA[2:])], 2)
    assert request.done


def test_info_gives_names(tmp_path: Path) -> None:
    path = tmp_path / "some.bin"
    path.write_bytes(DATA * 70)
    with ls.open(path, SENSOR) as device:
        list(device.packets("report"))
        assert device.info == {"model": "ACME X1"}
        assert not device.warnings


def test_info_reports_an_unknown_code(tmp_path: Path) -> None:
    path = tmp_path / "some.bin"
    path.write_bytes(DATA[:-2] + b"\x63\0")
    with ls.open(path, SENSOR) as device:
        list(device.packets("report"))
        assert device.info == {"model": "unknown code (0x63)"}


@pytest.mark.skipif(not shutil.which("gcc"), reason="gcc is not installed")
def test_c_has_a_function_for_the_names_of_a_code(tmp_path: Path) -> None:
    (tmp_path / "codes.h").write_text(ls.export(COMPILED, "c"))
    program = """
        #include <stdio.h>
        #include "codes.h"
        int main(void) {
            puts(acme_codes_report_model_name(ACME_CODES_REPORT_MODEL_ACME_X2));
            puts(acme_codes_report_mode_name(0x39));
            return acme_codes_report_mode_name(99) != NULL;
        }
    """
    (tmp_path / "main.c").write_text(program)
    command = ["gcc", "-std=c11", "-Wall", "-Wextra", "-Werror", "main.c", "-o", "main"]
    subprocess.run(command, cwd=tmp_path, check=True)
    done = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["ACME X2", "last and strongest"]


def test_other_exports_have_the_names() -> None:
    assert "1: idle" in ls.export(COMPILED, "ksy")
    assert "id: last_and_strongest" in ls.export(COMPILED, "ksy")
    assert '"24": "ACME X1"' in ls.export(COMPILED, "json")
    assert '[24] = "ACME X1"' in ls.export(COMPILED, "wireshark")
    assert "ACME X1 (0x18), ACME X2 (0x1f)" in ls.export(COMPILED, "md")
    stub = ls.export(COMPILED, "pyi")
    assert "model: EnumValue" in stub
    assert "mode: float | Literal['idle', 'strongest']" in stub


def test_unknown_codes_are_a_warning_once(tmp_path: Path) -> None:
    path = tmp_path / "some.bin"
    path.write_bytes(b"\xa5\x00" + DATA[2:] + (b"\xa5\x63" + DATA[2:]) * 70)
    with ls.open(path, SENSOR) as device:
        list(device.packets("report"))
        assert len(device.warnings) == 1
        assert "report.mode is 99, an unknown code" in device.warnings[0]


def test_codes_build_a_struct_that_construct_handles() -> None:
    """Constants and branches compare the names of codes."""
    element = Struct(
        "mode" / Const("idle", MODE), "kind" / MODE, "more" / Switch(this.kind, {"idle": Int8ul})
    )
    struct = Struct("count" / Int8ul, "elements" / Array(lambda c: int(c.count) % 3, element))
    frames = {"plain": Frame(struct, max_length=20)}
    sensor = dataclasses.replace(SENSOR, frames=frames, commands={}, info={})
    data = bytes.fromhex("02 01 01 07 01 37")
    parsed = sensor.parse(data)
    assert parsed.elements[0].kind == 1
    assert sensor.build("plain", parsed) == data
