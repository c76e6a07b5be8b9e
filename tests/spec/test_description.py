"""Tests of mistakes in a sensor's description: typed errors with the correction."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from construct import Bytes, Const, Int8ub, Struct

import lidarspec as ls
from lidarspec.errors import UnknownFrame
from lidarspec.spec import Clock, Every, Fields, Frame
from lidarspec.testing.findings import RULES
from tests.shapes import SHAPES

SENSOR = SHAPES["shape-count"]
BYTE = Struct("value" / Int8ub)


@pytest.mark.parametrize(
    ("describe", "message"),
    [
        (
            lambda: Clock("time", wraps_at=2**64 / 1e6),
            "clock.wraps_at: 1.845e+13 s is longer than 292 years: leave wraps_at out",
        ),
        (
            lambda: Clock("time", wraps_at=0),
            "clock.wraps_at: expected a positive number of seconds, got 0",
        ),
        (
            lambda: Clock("time", pace=0.01),  # type: ignore[arg-type]
            "clock.pace: the pace must be a function of Fields that returns seconds, such as"
            " lambda f: 0.01, not 0.01",
        ),
        (
            lambda: Frame(BYTE, simulation=None),
            "simulation: expected a Simulation(...), got None",
        ),  # type: ignore[arg-type]
        (
            lambda: Frame(BYTE, sweep=None),
            "Frame has no argument 'sweep'; write Frame(simulation=Simulation(sweep=...))",
        ),
        (
            lambda: ls.Sensor("a-b", sweep=None),
            "Sensor has no argument 'sweep'; write Sensor(simulation=Simulation(sweep=...))",
        ),
        (
            lambda: ls.Sensor("a-b", range_limit=(0, 1)),
            "Sensor has no argument 'range_limit'; did you mean 'range_limits'?",
        ),
    ],
)
def test_invalid_argument_raises_typed_error(describe: Callable[[], Any], message: str) -> None:
    with pytest.raises(ls.SpecError, match=re.escape(message)):
        describe()


def test_unknown_frame_is_also_a_key_error() -> None:
    with pytest.raises(
        UnknownFrame, match=r"^shape-count: unknown frame 'dta'; did you mean 'data'\?$"
    ) as raised:
        SENSOR.frames["dta"]
    assert isinstance(raised.value, KeyError)
    assert SENSOR.frames.get("dta") is None
    assert "dta" not in SENSOR.frames


def test_column_compared_with_bytes_says_that_it_is_numbers() -> None:
    def plausible(f: Fields) -> Any:
        return f.text != b""

    frame = Frame(
        Struct("header" / Const(b"\xa5\x5a"), "text" / Bytes(4)), data=True, plausible=plausible
    )
    sensor = ls.Sensor(
        "a-b",
        vendor="A",
        model="B",
        frames={"data": frame},
        points=lambda f: None,  # type: ignore[arg-type,return-value]
        scan=Every(1.0),
        links={},
        range_limits=(0.1, 1.0),
        status="manual",
        source="none",
    )
    counters = sensor.decode(b"\xa5\x5atext").stats
    assert "a column consists of numbers and cannot be combined with b''" in str(
        counters.failure("a-b")
    )


def test_advice_on_examples_names_an_argument_that_exists() -> None:
    assert "Simulation(sweep=...)" in RULES["LS301"].fix
