"""Both engines read alike: damaged input, values at the edges of their fields, faults in elements of arrays."""

from __future__ import annotations

import re

import pytest

from lidarspec import Sensor, WireError
from lidarspec.framing.frame_engine import CompiledCodec, codec
from tests.all_sensors import DISTINCT
from tests.broken import sound
from tests.engine.engines import clean_and_damaged_input_read_alike, values_at_the_edges_read_alike
from tests.engine.mutants import Indexless
from tests.shapes import SHAPES

COMPILED = {
    name: sensor for name, sensor in SHAPES.items() if all(isinstance(codec(frame), CompiledCodec) for frame in sensor.frames.values())
}


@pytest.mark.parametrize("sensor", COMPILED.values(), ids=COMPILED)
def test_clean_and_damaged_input_reads_alike(sensor: Sensor) -> None:
    clean_and_damaged_input_read_alike(sensor)


@pytest.mark.parametrize("sensor", DISTINCT.values(), ids=DISTINCT)
def test_values_at_the_edges_read_alike(sensor: Sensor) -> None:
    values_at_the_edges_read_alike(sensor)


def faults_in_arrays(sensor: Sensor, name: str) -> tuple[list[str], list[str]]:
    """The paths of the faults within arrays that a frame cut short has, those with an index and those without."""
    told: tuple[list[str], list[str]] = ([], [])
    schema, data = codec(sensor.frames[name]).schema, sensor.example(name, seed=2)
    for end in range(len(data)):
        with pytest.raises(WireError) as caught:
            sensor.parse(data[:end], frame=name)
        path = re.sub(r"\[\d+\]", "", caught.value.path)
        info = schema.fields.get(path)
        if info is not None and path not in schema.arrays and len(info.axes) > (info.kind == "bytes"):
            told["[" not in caught.value.path].append(caught.value.path)
    return told


@pytest.mark.parametrize("sensor", SHAPES.values(), ids=SHAPES)
def test_a_fault_within_an_array_says_which_element_it_is_in(sensor: Sensor) -> None:
    for name in sensor.frames:
        assert faults_in_arrays(sensor, name)[1] == []


def test_a_fault_without_the_index_of_its_element_is_caught() -> None:
    assert faults_in_arrays(sound.sensor(), "data")[0]
    assert faults_in_arrays(sound.sensor(kind=Indexless), "data")[1]
