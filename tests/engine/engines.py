"""Compare the compiled and the interpreted engine of a sensor.

The checks are functions of a sensor that fail if the engines differ on damaged input or on values
at the limits of their fields.
"""

from __future__ import annotations

from lidarspec import Sensor
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.framing.plain_frames import PlainCodec
from lidarspec.spec import Frame
from lidarspec.testing import sensor_under_test as material
from lidarspec.testing.frames import build_if_valid, has_free_values
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.agreement import assert_backends_agree

DAMAGED_CONVERSATIONS = 2
EDGE_EXAMPLES = 5


def is_compiled(frame: Frame) -> bool:
    """Return whether a frame type has layouts of its own."""
    return isinstance(get_codec(frame), CompiledCodec)


def interpreted_reason(frame: Frame) -> str:
    """Return why construct parses a frame type one candidate at a time; "" if it does not."""
    engine = get_codec(frame)
    return engine.reason if isinstance(engine, PlainCodec) else ""


def assert_damaged_input_reads_alike(sensor: Sensor, count: int = DAMAGED_CONVERSATIONS) -> None:
    """Fail unless both engines read conversations in the same way.

    There is one undamaged conversation, and `count` conversations with damaged frames.
    """
    subject = SensorUnderTest(sensor)
    source = subject.make_random("agree")
    frames = subject.conversation(rounds=1)
    assert_backends_agree(sensor, material.make_input(sensor, frames))
    for _ in range(count):
        noisy = [
            (name, material.mutate(data, source) if source.random() < 0.4 else data)
            for name, data in frames
        ]
        assert_backends_agree(sensor, material.make_input(sensor, noisy))


def assert_edge_values_read_alike(sensor: Sensor, count: int = EDGE_EXAMPLES) -> None:
    """Fail unless both engines read frames with extreme values in the same way.

    The values of fields are at the limits of their ranges. Long frames are left out, because
    construct needs time for each field.
    """
    subject = SensorUnderTest(sensor)
    for name in sensor.incoming:
        frame = sensor.frames[name]
        if frame.max_length > material.MAX_SHORT_BYTES or not is_compiled(frame):
            continue
        fields = get_codec(frame).schema.fields
        source = subject.make_random(f"edges {name}")
        edged = []
        for seed in range(count):
            parsed = sensor.parse(subject.example(name, seed=seed), frame=name)
            for holder, key, path in list(material.iter_integers(parsed)):
                info = fields.get(path)
                if info is not None and has_free_values(info) and source.random() < 0.3:
                    holder[key] = source.choice(info.limits)
            built = build_if_valid(subject, name, parsed)
            if built is not None:
                edged.append((name, built))
        assert_backends_agree(sensor, material.make_input(sensor, edged))
