"""Tests that hostile input raises only documented exceptions (P3).

The shapes and representatives get 20,000 mutated inputs in total. Parsing one frame raises only
`WireError`; decoding never raises. `tests.fuzz` does the same with millions of inputs.
"""

from __future__ import annotations

import contextlib

import pytest

from lidarspec import WireError
from lidarspec.testing import sensor_under_test as material
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.representatives import REPRESENTATIVES, each_sensor, each_shape, load_sensor
from tests.shapes import SHAPES

#: Mutated inputs of each sensor; long frames take their time.
SHAPE_FRAMES = 60
REPRESENTATIVE_FRAMES = 20
DECODED_FRAMES = 340
SEEDS = 2


@each_shape
@pytest.mark.parametrize("times", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_mutated_frame_is_parsed_or_is_a_wire_error(name: str, times: int) -> None:
    sensor = load_sensor(name)
    subject = SensorUnderTest(sensor)
    source = subject.make_random(f"hostile frames {times}")
    examples = [
        (frame, subject.example(frame, seed=seed))
        for frame in sensor.frames
        for seed in range(SEEDS)
    ]
    for _ in range(times * (SHAPE_FRAMES if name in SHAPES else REPRESENTATIVE_FRAMES)):
        frame, data = source.choice(examples)
        mutated = material.mutate(data, source)
        with contextlib.suppress(WireError):
            sensor.parse(mutated, frame=frame, verify=source.random() < 0.7)


@each_sensor
def test_decoding_mutated_frames_raises_nothing(name: str) -> None:
    sensor = load_sensor(name)
    subject = SensorUnderTest(sensor)
    source = subject.make_random("hostile streams")
    frames = subject.conversation(rounds=1)
    mutated = [
        (frame, material.mutate(data, source))
        for frame, data in source.choices(frames, k=DECODED_FRAMES)
    ]
    mutated += frames
    packets = sensor.decode(material.make_input(sensor, mutated))
    packets.points()
    assert packets.stats.plugin_errors == 0
    assert packets.stats.bytes_in == sum(len(data) for _, data in mutated)


def test_twenty_thousand_inputs_are_tried() -> None:
    of_shapes = len(SHAPES) * (SHAPE_FRAMES + DECODED_FRAMES)
    of_representatives = len(REPRESENTATIVES) * DECODED_FRAMES
    assert of_shapes + of_representatives >= 20_000
