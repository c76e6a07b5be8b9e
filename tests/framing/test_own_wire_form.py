"""Tests of an author's own wire form with only the three documented operations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from construct import Array, Int8ub, Int16ub, Struct, this

import lidarspec as ls
from lidarspec import Sensor, SpecError
from lidarspec.detect import identification
from lidarspec.detect.sample_bytes import SampleBytes
from lidarspec.errors import PluginError, WireError
from lidarspec.simulation.simulator import simulate
from lidarspec.spec import Decoded, Frame, NumberRun, Problem, Serial, TextRun, WireForm
from lidarspec.testing.check import CheckTarget, iter_reports
from tests.shapes import SHAPES


@dataclass(frozen=True)
class HexLines(WireForm):
    """A colon, two digits for each byte, and a line end."""

    def find_end(self, data: bytes) -> int:
        if data[:1] not in (b"", b":"):
            return -1
        return data.find(b"\n") + 1

    def decode(self, data: bytes, next_runs: object) -> Decoded:
        digits = data[1:-1]
        if len(digits) % 2 or digits.strip(b"0123456789abcdef"):
            return Decoded(b"", [], 1, Problem(1, "a byte has no two digits"))
        offsets = np.arange(1, len(data) - 1, 2)
        sizes = np.ones(len(offsets), int)
        return Decoded(bytes.fromhex(digits.decode()), [(offsets, sizes)], len(data) - 1)

    def encode(self, struct: bytes, runs: Sequence[TextRun | NumberRun]) -> bytes:
        return b":" + struct.hex().encode() + b"\n"


STATE = Frame(Struct("id" / Int8ub, "value" / Int16ub), max_length=20, wire=HexLines())
SENSOR = Sensor(
    "acme-hex",
    vendor="Acme",
    model="Hex",
    frames={"state": STATE},
    links={"data": Serial(9600)},
    status="manual",
    source="invented",
)


def test_frames_are_found_whatever_the_split() -> None:
    struct = Struct("count" / Int8ub, "ranges" / Array(this.count, Int16ub))
    frame = Frame(struct, data=True, max_length=600, wire=HexLines())
    sensor = replace(SHAPES["shape-text"], frames={"data": frame})
    data = sensor.build("data", ranges=[291, 278])
    assert data == b":0201230116\n"
    stream = b"noise :" + data + b":zz\n" + data
    for size in (1, 5, len(stream)):
        decoder = sensor.decoder()
        found = [
            item
            for start in range(0, len(stream), size)
            for item in decoder.feed(stream[start : start + size])
        ]
        found += decoder.finish()
        assert [(item.offset, item.data) for item in found] == [(7, data), (23, data)]
        assert not decoder.stats.plugin_errors


def test_it_is_checked_like_a_shipped_one() -> None:
    assert SENSOR.parse(b":010002\n").value == 2
    (report,) = iter_reports(CheckTarget([SENSOR]), SENSOR.id, examples=4)
    assert not report.findings


def test_a_missing_method_is_named_at_declaration() -> None:
    class Unencodable(WireForm):
        find_end = HexLines.find_end
        decode = HexLines.decode

    class Underived:
        find_end = HexLines.find_end
        decode = HexLines.decode
        encode = HexLines.encode

    for form, names in ((Unencodable, "encode"), (Underived, "is_text, begins, largest")):
        with pytest.raises(SpecError, match=f"wire: {form.__name__} does not define {names}"):
            Frame(Struct("id" / Int8ub), max_length=20, wire=form())  # type: ignore[abstract]


def raise_wire_error(self: object, data: bytes) -> int:
    raise WireError("no end")


BROKEN: dict[str, dict[str, Any]] = {
    "begins": {"begins": lambda self, texts: None},
    "find_end": {"find_end": lambda self, data: data.index(b"?")},
    "find_end with a WireError": {"find_end": raise_wire_error},
    "find_end beyond the data": {"find_end": lambda self, data: len(data) + 1},
    "decode": {"decode": lambda self, data, next_runs: None},
    "encode": {"encode": lambda self, struct, runs: None},
}


def make_broken_sensor(fault: str) -> Sensor:
    """Return a sensor with a wire form with one method that has a fault."""
    form = type("Broken", (HexLines,), BROKEN[fault])()
    frame = Frame(Struct("id" / Int8ub, "value" / Int16ub), max_length=20, wire=form)
    return replace(SENSOR, frames={"state": frame})


@pytest.mark.parametrize("fault", BROKEN)
def test_a_failing_method_is_named_with_its_file(fault: str) -> None:
    sensor = make_broken_sensor(fault)
    with pytest.raises(PluginError, match=r"wire form, .*test_own_wire_form.py:"):
        sensor.build("state", id=1, value=2)


@pytest.mark.parametrize("fault", [fault for fault in BROKEN if fault != "encode"])
def test_a_broken_wire_form_does_not_stop_other_sensors(
    fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = {
        "acme-hex": make_broken_sensor(fault),
        "ldrobot-ld06": ls.sensor("ldrobot-ld06"),
    }
    monkeypatch.setattr(identification, "sensors", lambda: installed)
    frames = simulate(installed["ldrobot-ld06"], 20)
    sample = SampleBytes("test", (b":010002\n", *frames), datagrams=False)
    with pytest.warns(UserWarning, match=r"acme-hex.*wire form, .*test_own_wire_form.py:"):
        verdict = identification.identify_sample(sample)
    assert verdict.sensor is installed["ldrobot-ld06"]
    (fitting,) = identification.find_fitting_sensors(frames[:1], datagrams=False)
    assert fitting is installed["ldrobot-ld06"]
    nearest = identification.find_nearest_fault(frames[0][:-1] + b"?")
    assert nearest is not None
    assert nearest.sensor == "ldrobot-ld06"


@dataclass(frozen=True)
class Marked(WireForm):
    """Two marks, the number of further bytes, and the struct, in which marks may be doubled."""

    is_stuffed: bool

    def begins(self, texts: object) -> bytes:
        return b"\xa5\x5a"

    def find_end(self, data: bytes) -> int:
        if not b"\xa5\x5a".startswith(data[:2]):
            return -1
        if len(data) < 3 or len(data) < 3 + data[2]:
            return 0
        return 3 + data[2]

    def decode(self, data: bytes, next_runs: object) -> Decoded:
        if b"\xa5\x5a" in data[3:].replace(b"\xa5\xa5", b""):
            return Decoded(b"", [], 3, Problem(3, "a frame begins within this frame"))
        offsets = [3]
        while offsets[-1] < len(data) - 1:
            is_doubled = data[offsets[-1]] == 0xA5 and self.is_stuffed
            offsets.append(offsets[-1] + 1 + is_doubled)
        offsets = [offset for offset in offsets if offset < len(data)]
        struct = bytes(data[offset] for offset in offsets)
        return Decoded(struct, [(np.array(offsets), np.ones(len(offsets), int))], len(data))

    def encode(self, struct: bytes, runs: Sequence[TextRun | NumberRun]) -> bytes:
        body = struct.replace(b"\xa5", b"\xa5\xa5") if self.is_stuffed else struct
        return b"\xa5\x5a" + bytes([len(body)]) + body


@pytest.mark.parametrize("is_stuffed", [True, False])
def test_check_sends_the_start_of_a_frame_as_content(is_stuffed: bool) -> None:
    frame = Frame(Struct("id" / Int8ub, "value" / Int16ub), max_length=20, wire=Marked(is_stuffed))
    (report,) = iter_reports(
        CheckTarget([replace(SENSOR, frames={"state": frame})]), SENSOR.id, examples=4
    )
    expected = [] if is_stuffed else ["LS313"]
    assert [finding.code for finding in report.findings] == expected
