"""Tests that both engines give the same results.

They use damaged input, values at the limits of their fields, and faults in elements of arrays.
"""

from __future__ import annotations

import re

import pytest

from lidarspec import Sensor, WireError
from lidarspec.framing.frame_engine import get_codec
from tests.broken import sound
from tests.engine.engines import (
    assert_damaged_input_reads_alike,
    assert_edge_values_read_alike,
    is_compiled,
)
from tests.engine.mutants import Indexless
from tests.representatives import REPRESENTATIVES, load_sensor
from tests.shapes import SHAPES

COMPILED_SHAPES = [
    name for name, sensor in SHAPES.items() if all(map(is_compiled, sensor.frames.values()))
]


@pytest.mark.parametrize("name", COMPILED_SHAPES)
def test_engines_agree_on_damaged_input(name: str) -> None:
    assert_damaged_input_reads_alike(SHAPES[name])


@pytest.mark.parametrize("name", SHAPES)
def test_engines_agree_on_extreme_values(name: str) -> None:
    assert_edge_values_read_alike(SHAPES[name])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [*(pytest.param(name, marks=pytest.mark.soak) for name in COMPILED_SHAPES), *REPRESENTATIVES],
)
def test_engines_agree_on_heavily_damaged_input(name: str) -> None:
    assert_damaged_input_reads_alike(load_sensor(name), count=2)
    assert_edge_values_read_alike(load_sensor(name), count=3)


#: Places at which a frame is cut.
MAX_CUTS = 20


def fault_paths_in_arrays(sensor: Sensor, name: str) -> tuple[list[str], list[str]]:
    """Return the paths of faults in arrays, for a truncated frame.

    The first list has the paths with an index, the second those without.
    """
    indexed, unindexed = list[str](), list[str]()
    schema = get_codec(sensor.frames[name]).schema
    data = sensor.example(name, seed=2)
    step = max(len(data) // MAX_CUTS, 1)
    for end in range(0, len(data), step):
        with pytest.raises(WireError) as caught:
            sensor.parse(data[:end], frame=name)
        path = re.sub(r"\[\d+\]", "", caught.value.path)
        info = schema.fields.get(path)
        if info is None or path in schema.arrays or len(info.axes) <= (info.kind == "bytes"):
            continue
        paths = indexed if "[" in caught.value.path else unindexed
        paths.append(caught.value.path)
    return indexed, unindexed


@pytest.mark.parametrize("name", SHAPES)
def test_a_fault_within_an_array_has_the_index_of_its_element(name: str) -> None:
    sensor = SHAPES[name]
    for frame in sensor.frames:
        _, unindexed = fault_paths_in_arrays(sensor, frame)
        assert unindexed == []


def test_a_fault_without_the_index_of_its_element_is_caught() -> None:
    indexed, _ = fault_paths_in_arrays(sound.sensor(), "data")
    _, unindexed = fault_paths_in_arrays(sound.sensor(kind=Indexless), "data")
    assert indexed
    assert unindexed
