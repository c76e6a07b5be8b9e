"""Both engines over one sensor, as functions that fail where they differ: on damaged input, and on values at the edges of their fields."""

from __future__ import annotations

from lidarspec import Sensor
from lidarspec.framing.frame_engine import CompiledCodec, codec
from lidarspec.testing import subject as material
from lidarspec.testing.agreement import assert_backends_agree
from lidarspec.testing.frames import acceptable, free
from lidarspec.testing.subject import Subject


def clean_and_damaged_input_read_alike(sensor: Sensor) -> None:
    """Fail unless a conversation, and six with damaged frames in them, give the same on both engines."""
    subject = Subject(sensor)
    source, frames = subject.source("agree"), subject.conversation()
    assert_backends_agree(sensor, material.delivery(sensor, frames))
    for _ in range(6):
        noisy = [(name, material.mutated(data, source) if source.random() < 0.4 else data) for name, data in frames]
        assert_backends_agree(sensor, material.delivery(sensor, noisy))


def values_at_the_edges_read_alike(sensor: Sensor) -> None:
    """Fail unless frames with values at the edges of their fields' ranges give the same on both engines; long frames are left out."""
    subject = Subject(sensor)
    for name in sensor.incoming:
        fields, source = codec(sensor.frames[name]).schema.fields, subject.source(f"edges {name}")
        if sensor.frames[name].max_length > material.SHORT or not isinstance(codec(sensor.frames[name]), CompiledCodec):
            continue
        edged = []
        for seed in range(8):
            parsed = sensor.parse(subject.example(name, seed=seed), frame=name)
            for holder, key, path in list(material.integers(parsed)):
                if free(fields.get(path)) and source.random() < 0.3:
                    holder[key] = source.choice(fields[path].limits)
            built = acceptable(subject, name, parsed)
            edged += [(name, built)] if built is not None else []
        assert_backends_agree(sensor, material.delivery(sensor, edged))
