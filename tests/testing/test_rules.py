"""Tests of `lidarspec check` rules with correct declarations that once failed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Const,
    Float32l,
    Int8ul,
    Int16sl,
    Int16ul,
    Int32ul,
    Struct,
    this,
)

import lidarspec as ls
from lidarspec import Sensor
from lidarspec.entry_points import SENSORS, EntryPoint
from lidarspec.plugins import Registry
from lidarspec.spec import (
    Checksummed,
    Clock,
    Command,
    Fields,
    Frame,
    Polar,
    Scaled,
    Serial,
    Simulation,
    Sum,
    Udp,
    Xor,
)
from lidarspec.testing import check
from lidarspec.testing.commands import replies_belong_to_one_command, the_simulated_sensor_answers
from lidarspec.testing.declaration import check_declaration
from lidarspec.testing.findings import list_unacknowledged
from lidarspec.testing.geometry import the_points_turn_as_the_axes_do
from lidarspec.testing.properties import PROPERTIES
from lidarspec.testing.sensor_under_test import SensorUnderTest
from lidarspec.testing.vectors import every_checksum_is_checked, vectors_hold
from tests.broken import interpreted, sound

BROKEN = Path(__file__).resolve().parents[1] / "broken"


def declared_codes(sensor: Sensor) -> set[str]:
    """Return the rules that a declaration alone breaks."""
    return {
        finding.code
        for finding in list_unacknowledged(
            check_declaration(SensorUnderTest(sensor)), sensor, whole=True
        )
    }


def found_by(function: Any, sensor: Sensor) -> set[str]:
    """Return the rules that one property finds broken."""
    (held,) = [one for one in PROPERTIES if one.function is function]
    return {finding.code for finding in held.findings(SensorUnderTest(sensor))}


def with_frame(name: str, frame: Frame, **changes: Any) -> Sensor:
    """Return the sound sensor with a further frame type."""
    return sound.sensor(frames={**sound.sensor().frames, name: frame}, **changes)


def test_a_reply_need_not_be_compiled() -> None:
    answer = Frame(interpreted.ACK, max_length=5)
    asking = {"ask": Command("order", {"code": 2}, reply="answer")}
    assert declared_codes(with_frame("answer", answer)) == {"LS116"}
    assert declared_codes(with_frame("answer", answer, commands=asking)) == set()


def test_a_weak_frame_without_points_may_have_three_bytes_to_be_known_by() -> None:
    def stamp(header: bytes) -> Frame:
        struct = Struct("header" / Const(header), "cs" / Int8ul, "value" / Int16ul)
        return Frame(Checksummed(struct, field="cs", algorithm=Xor()), max_length=5)

    assert declared_codes(with_frame("stamp", stamp(b"\xaa\x66"))) == set()
    assert declared_codes(with_frame("stamp", stamp(b"\xaa"))) >= {"LS206"}


def test_a_checksum_may_begin_behind_the_header() -> None:
    def covering(*names: str) -> set[str]:
        struct = sound.struct()
        checksummed = Checksummed(struct, field="sum", algorithm=Sum(16), over=names)
        return declared_codes(sound.sensor(sound.frame(checksummed)))

    behind = ("time", "tilt", "first", "last", "count", "samples")
    assert covering(*behind) == set()
    assert covering(*behind[:-1]) == {"LS205"}


def test_components_of_a_direction_are_no_angle() -> None:
    def points(f: Fields) -> Polar:
        return Polar(f.samples.distance, np.arctan2(f.samples.y, f.samples.x))

    def codes(component: Any) -> set[str]:
        sample = Struct("distance" / Scaled(Int16ul, 0.001, "m"), "x" / component, "y" / component)
        frame = sound.frame(sound.make_frame(samples=Array(this.count, sample)), max_length=200)
        return declared_codes(sound.sensor(frame, points=points))

    assert codes(Scaled(Int16sl, 1 / 32768, "")) == set()
    assert codes(Float32l) == {"LS201"}


def test_a_flag_with_the_name_of_a_measured_value_needs_no_unit() -> None:
    def codes(bits: int) -> set[str]:
        flags = BitStruct("temperature" / BitsInteger(bits), "unused" / BitsInteger(8 - bits))
        return declared_codes(sound.sensor(sound.frame(sound.struct(flags=flags))))

    assert codes(1) == set()
    assert codes(2) == {"LS201"}


def test_a_checksum_that_is_not_documented_has_a_remark() -> None:
    def frame(check: Any) -> Sensor:
        return sound.sensor(sound.frame(sound.struct(sum=check)))

    assert found_by(every_checksum_is_checked, frame(Int16ul)) == {"LS212"}
    assert found_by(every_checksum_is_checked, frame(Int16ul * "over the samples")) == {"LS212"}
    assert found_by(every_checksum_is_checked, frame(Int16ul * "not checked: unknown")) == set()


def test_answers_that_decide_by_the_arguments_may_keep_silent() -> None:
    def answering(*keys: int) -> Sensor:
        def answer(request: Any) -> Any:
            return [("ack", {"code": 1})] if request["code"] in keys else []

        ask = Command("order", {}, reply="ack", args={"key": ("code", 0, 200)})
        simulation = Simulation(sound.sweep, answers={"ask": answer})
        return sound.sensor(commands={"ask": ask}, simulation=simulation)

    assert found_by(the_simulated_sensor_answers, answering(0)) == set()
    assert found_by(the_simulated_sensor_answers, answering(3)) == set()


def test_vectors_in_two_quadrants_prove_the_sense_of_the_points() -> None:
    subject = SensorUnderTest(sound.sensor(vendor_axes=("forward", "right", "up")))
    (held,) = [one for one in PROPERTIES if one.function is the_points_turn_as_the_axes_do]
    assert [finding.code for finding in held.findings(subject)] == ["LS511"]
    subject.frames_with_two_quadrants.add("data")
    assert held.findings(subject) == []
    assert "data: sense" in subject.picture


def install_module(monkeypatch: pytest.MonkeyPatch, folder: Path, value: str, text: str) -> None:
    """Install a module of a distribution "lidarspec-acme".

    Args:
        value: the value of the entry point of the sensor "acme-x1", such as "acme_lidar:X1".
        text: the content of the module.
    """
    module = value.partition(":")[0]
    (folder / f"{module}.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(folder)
    entry = EntryPoint("acme-x1", value, "lidarspec-acme", "1.0")
    offered = Registry(offered=[entry])
    monkeypatch.setattr(check, "registry", lambda: offered)
    monkeypatch.setattr(check, "entry_points", lambda group: [entry] if group == SENSORS else [])


def test_a_sensor_whose_plugin_does_not_load_is_checked_as_its_distribution(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_module(monkeypatch, tmp_path, "acme_lidar:X1", "X1 = 1 / 0\n")
    (finding,) = check.find_target("acme-x1").findings
    assert (finding.code, finding.line) == ("LS001", 1)
    assert "ZeroDivisionError" in finding.what


def test_an_entry_point_that_names_no_sensor_is_a_finding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_module(monkeypatch, tmp_path, "acme_renamed:DATA", "DATA = {}\n")
    for name in ("acme-x1", "lidarspec-acme"):
        (report,) = check.iter_reports(check.find_target(name), name)
        (finding,) = report.findings
        assert (finding.code, finding.path) == ("LS007", "acme-x1 = acme_renamed:DATA")
        assert finding.what.endswith("acme_renamed:DATA has the type dict")


def test_uncovered_fields_are_found_if_the_covered_field_may_be_empty() -> None:
    struct = Struct(
        "header" / Const(b"\xaa\x55\xc3"),
        "count" / Int8ul,
        "levels" / Array(this.count, Int8ul),
        "flags" / Int16ul,
        "sum" / Int16ul,
    )
    checked = Checksummed(struct, field="sum", algorithm=Sum(16), over=("levels",))
    sensor = Sensor(
        "acme-x1",
        vendor="Acme",
        model="X1",
        frames={"data": Frame(checked, max_length=9)},
        links={"data": Udp(2368)},
        status="manual",
        source="manual",
    )
    subject = SensorUnderTest(sensor)
    assert any(not subject.example("data", seed=seed)[3] for seed in range(3))
    findings = check_declaration(subject)
    assert [(finding.code, finding.path) for finding in findings] == [("LS205", "data.flags")]


def test_a_report_counts_the_checks_that_a_fatal_finding_stops() -> None:
    (report,) = check.iter_reports(
        check.find_target(BROKEN / "no_example.py"), "no_example", examples=4
    )
    assert {finding.code for finding in report.findings} == {"LS301"}
    assert report.held == 0
    assert len(report.skipped) == len(PROPERTIES) - 1
    assert report.skipped["replies_can_match"] == "not tested because of LS301"


@pytest.mark.parametrize("number", [Int16ul, Int16sl])
@pytest.mark.parametrize(
    ("wraps_at", "codes"), [(None, {"LS509"}), (50.0, set()), (65.536, set()), (65.6, {"LS509"})]
)
def test_the_declared_wrap_of_a_clock_fits_its_field(
    wraps_at: float | None, codes: set[str], number: Any
) -> None:
    struct = sound.make_frame(time=Scaled(number, 0.001, "s"))
    sensor = sound.sensor(sound.frame(struct), clock=Clock("time", wraps_at=wraps_at))
    assert declared_codes(sensor) == codes


IMU_CLOCK_WRAP_S = 4294.967296  # 32 bits of microseconds


@pytest.mark.parametrize(
    ("sweep", "wraps_at", "codes"),
    [
        (lambda i: {"time": i / 100 % IMU_CLOCK_WRAP_S}, IMU_CLOCK_WRAP_S, set()),
        (lambda i: {"tim": i / 100}, IMU_CLOCK_WRAP_S, {"LS508"}),
        (lambda i: {"time": 100 - i / 100}, IMU_CLOCK_WRAP_S, {"LS509"}),
        (lambda i: {"time": i / 100 % IMU_CLOCK_WRAP_S}, None, {"LS509"}),
        (lambda i: {"time": i / 100 % IMU_CLOCK_WRAP_S}, 1000 * IMU_CLOCK_WRAP_S, {"LS509"}),
        (lambda i: {"time": i / 100 % IMU_CLOCK_WRAP_S}, IMU_CLOCK_WRAP_S / 1000, {"LS512"}),
        (
            lambda i: {"time": i / 100 % IMU_CLOCK_WRAP_S, "turn": 400.0},
            IMU_CLOCK_WRAP_S,
            {"LS514"},
        ),
    ],
)
def test_periodic_frames_of_a_sensor_without_points_are_checked(
    sweep: Any, wraps_at: float | None, codes: set[str]
) -> None:
    struct = Struct(
        "header" / Const(b"\x1d\xa8\x51"),
        "time" / Scaled(Int32ul, 1e-6, "s"),
        "turn" / Scaled(Int16sl, 0.01, "deg/s"),
        "end" / Const(b"\x33\x34"),
    )
    sensor = Sensor(
        "acme-imu",
        vendor="Acme",
        model="IMU",
        frames={"imu": Frame(struct, simulation=Simulation(sweep, rate=100))},
        links={"data": Serial(115_200)},
        clock=Clock("time", wraps_at=wraps_at),
        status="manual",
        source="invented for the test",
    )
    (report,) = check.iter_reports(check.CheckTarget([sensor]), sensor.id, examples=4)
    assert {finding.code for finding in report.findings} == codes
    assert "declares no `sweep`" not in " ".join(report.skipped.values())


@pytest.mark.parametrize(
    ("start", "stop", "paths"),
    [
        ({}, {}, ["commands.start", "commands.stop"]),
        ({"matches": {"code": 1}}, {}, ["commands.stop"]),
        ({"matches": {"code": 1}}, {"matches": {"code": 2}}, []),
        ({"echoes": ("code",)}, {"echoes": ("code",)}, []),
    ],
)
def test_commands_with_the_same_reply_compare_the_field_that_distinguishes_them(
    start: dict[str, Any], stop: dict[str, Any], paths: list[str]
) -> None:
    commands = {
        "start": Command("order", {"code": 1}, reply="ack", **start),
        "stop": Command("order", {"code": 2}, reply="ack", **stop),
    }
    (held,) = [one for one in PROPERTIES if one.function is replies_belong_to_one_command]
    findings = held.findings(SensorUnderTest(sound.sensor(commands=commands)))
    assert [finding.path for finding in findings] == paths
    assert {finding.code for finding in findings} <= {"LS606"}


def test_a_vector_that_plausible_rejects_has_no_points(tmp_path: Path) -> None:
    data = ls.simulate(sound.sensor(), 1)[0].hex()
    vector = {"frame": "data", "hex": data, "points": {"0": {"range": 1}}, "source": "made"}
    (file := tmp_path / "vectors.json").write_text(json.dumps([vector]), encoding="utf-8")
    sensor = sound.sensor(sound.frame(plausible=lambda f: f.count > sound.LONGEST))
    (held,) = [one for one in PROPERTIES if one.function is vectors_hold]
    (finding,) = held.findings(SensorUnderTest(sensor, vectors=file))
    assert finding.code == "LS708"
    assert finding.what == "the frame has no points, because `plausible` rejects it"
