"""The tests that every sensor has to pass; derive a class from `SensorConformance`, name the sensor, and let pytest collect it."""

from __future__ import annotations

import contextlib
import itertools
import random
from pathlib import Path

import pytest

from lidarspec.decoder import Decoder, packed
from lidarspec.errors import OutOfRange, WireError
from lidarspec.frames.codecs import codec
from lidarspec.packets import joined
from lidarspec.plugins import sensor as known_sensor
from lidarspec.scans import Scan, scans_of
from lidarspec.spec import STATUSES, Frame, Sensor
from lidarspec.streams import PacketStream
from lidarspec.testing import material
from lidarspec.testing.comparisons import (
    assert_backends_agree,
    assert_command,
    assert_same_packets,
    assert_same_places,
    assert_well_formed,
    cuts,
)

#: sensors with more frame types than this are tried with less of each.
MANY = 8


class SensorConformance:
    """What holds for every sensor.

    Attributes:
        sensor: an id, a `Sensor`, or a file that describes one.
        examples: how many frames of each type are tried.
        mutations: how many damaged frames of each type are parsed.
    """

    sensor: str | Path | Sensor = ""
    examples = 40
    mutations = 150

    def _seeds(self, frame: Frame, number: int) -> range:
        """Fewer for long frames: construct takes its time for each field."""
        return range(number if frame.max_length <= material.SHORT else max(number // 8, 3))

    @pytest.fixture
    def subject(self) -> Sensor:
        """The sensor under test."""
        return self.sensor if isinstance(self.sensor, Sensor) else known_sensor(self.sensor)

    @pytest.fixture
    def source(self, subject: Sensor) -> random.Random:
        """Random numbers of this sensor's own, the same in every run."""
        return random.Random(subject.id)

    def test_declares_what_it_needs(self, subject: Sensor) -> None:
        assert subject.source
        assert subject.vendor
        assert subject.model
        assert subject.status in STATUSES
        assert 0 <= subject.range_limits[0] < subject.range_limits[1]
        assert "data" in subject.links
        assert any(frame.data for frame in subject.frames.values())

    def test_examples_are_valid_and_repeat(self, subject: Sensor) -> None:
        for name, frame in subject.frames.items():
            found = [subject.example(name, seed=seed) for seed in self._seeds(frame, self.examples)]
            assert found[:3] == [subject.example(name, seed=seed) for seed in range(3)]
            assert max(map(len, found)) <= frame.max_length
            fixed = material.seals(subject, name, found[0])
            free = [info for info in codec(frame).schema.fields.values() if info.const is None and info.path not in fixed]
            assert len(set(found)) > 1 or not free

    def test_bytes_survive_parsing_and_building(self, subject: Sensor) -> None:
        for name, frame in subject.frames.items():
            for seed in self._seeds(frame, self.examples):
                data = subject.example(name, seed=seed)
                parsed = subject.parse(data, frame=name)
                assert subject.build(name, parsed) == data
                assert subject.build(name, **parsed) == data

    def test_values_in_units_build_the_same_bytes(self, subject: Sensor) -> None:
        for name, frame in subject.frames.items():
            for seed in self._seeds(frame, self.examples):
                data = subject.example(name, seed=seed)
                values = material.physical(subject, name, data)
                assert values is None or subject.build(name, values, units=True) == data

    def test_values_survive_building_and_parsing(self, subject: Sensor, source: random.Random) -> None:
        for name, frame in subject.frames.items():
            for seed in self._seeds(frame, self.examples):
                found = material.edited(subject, name, subject.example(name, seed=seed), source)
                if found is None:
                    continue
                built, path, wanted, got = found
                assert got == wanted or path in material.seals(subject, name, built), f"{name} {path}"
                assert subject.build(name, subject.parse(built, frame=name)) == built
                if frame.direction == "in":
                    assert_backends_agree(subject, material.delivery(subject, [(name, built)]))

    def test_parse_finds_out_the_type(self, subject: Sensor) -> None:
        for name in subject.frames:
            data = subject.example(name, seed=1)
            assert subject.parse(data) in [subject.parse(data, frame=other) for other in material.fitting(subject, data)]

    def test_a_clean_input_loses_nothing(self, subject: Sensor) -> None:
        frames = material.conversation(subject)
        data = material.delivery(subject, frames)
        assert [(found.frame, found.data) for found in subject.split(data)] == frames
        stats = subject.decode(data).stats
        assert (stats.bytes_skipped, stats.pending, stats.plugin_errors) == (0, 0, 0)
        assert stats.bytes_in == sum(len(part) for _, part in frames)

    def test_compiled_and_interpreted_agree(self, subject: Sensor, source: random.Random) -> None:
        few = len(subject.frames) <= MANY
        frames = material.conversation(subject, rounds=3 if few else 1)
        assert_backends_agree(subject, material.delivery(subject, frames))
        for _ in range(6 if few else 2):
            noisy = [(name, material.mutated(data, source) if source.random() < 0.4 else data) for name, data in frames]
            assert_backends_agree(subject, material.delivery(subject, noisy))

    def test_single_packets_equal_a_batch(self, subject: Sensor) -> None:
        found = subject.split(material.delivery(subject, material.conversation(subject)))
        for name in material.incoming(subject):
            stats = [Decoder(subject, stream=True).stats for _ in range(2)]
            single, batch = (PacketStream(subject, name, each) for each in stats)
            assert_same_packets(joined([single.add([packed([item])]) for item in found]), batch.add([packed(found)]))

    def test_scans_do_not_depend_on_batches(self, subject: Sensor) -> None:
        found = subject.split(material.delivery(subject, material.conversation(subject, rounds=5)))

        def scans(size: int) -> list[Scan]:
            stats = Decoder(subject, stream=True).stats
            stream = PacketStream(subject, subject.data_frame, stats)
            scans = list(scans_of(subject, [stream.add([packed(found[start : start + size])]) for start in range(0, len(found), size)]))
            assert not stats.plugin_errors, stats.tracebacks[0]
            return scans

        whole = scans(len(found))
        assert whole
        for size in (1, 2, 5):
            parts = scans(size)
            assert [(len(scan), scan.complete) for scan in parts] == [(len(scan), scan.complete) for scan in whole]
            for one, other in zip(parts, whole, strict=True):
                assert_well_formed(one.points)
                assert_same_places(one.points, other.points)

    def test_any_split_of_a_stream_gives_the_same(self, subject: Sensor, source: random.Random) -> None:
        if subject.datagrams:
            pytest.skip("this sensor sends datagrams")
        data = material.mutated(material.stream(subject, rounds=1), source) + material.stream(subject, seed=1, rounds=1)
        whole = subject.decoder()
        expected = cuts(whole.feed(data) + whole.finish())
        splits = [[data[:spot], data[spot:]] for spot in material.places(len(data), source)]
        splits += [list(material.pieces(data, source)) for _ in range(20)]
        for split in [*splits, [data[spot : spot + 1] for spot in range(len(data))]]:
            decoder = subject.decoder()
            found = [item for chunk in split for item in decoder.feed(chunk)]
            assert cuts(found + decoder.finish()) == expected
            assert decoder.stats == whole.stats

    def test_a_truncated_frame_is_a_wire_error(self, subject: Sensor, source: random.Random) -> None:
        for name in subject.frames:
            data = subject.example(name, seed=2)
            for end in material.places(len(data), source):
                with pytest.raises(WireError) as error:
                    subject.parse(data[:end], frame=name)
                assert 0 <= error.value.offset <= end

    def test_a_damaged_frame_is_at_worst_a_wire_error(self, subject: Sensor, source: random.Random) -> None:
        for name, frame in subject.frames.items():
            types = (name, None) if len(subject.frames) <= MANY else (name,)
            for seed in self._seeds(frame, self.mutations):
                data = material.mutated(subject.example(name, seed=seed % 8), source)
                for kind, verify in itertools.product(types, (True, False)):
                    with contextlib.suppress(WireError):
                        subject.parse(data, frame=kind, verify=verify)

    def test_commands_build_and_parse_back(self, subject: Sensor) -> None:
        for name, command in subject.commands.items():
            for share in (0.0, 0.37, 1.0):
                assert_command(subject, name, {key: low + share * (high - low) for key, (_, low, high) in command.args.items()})
            for key, (_, low, high) in command.args.items():
                for outside in (low - 1, high + 1):
                    with pytest.raises(OutOfRange):
                        subject.command(name, **{other: lowest for other, (_, lowest, _) in command.args.items()} | {key: outside})
            answers = [codec(subject.frames[name]).schema.fields for name in command.replies]
            for path in (*command.matches, *command.echoes) if answers else ():
                assert any(path in fields for fields in answers)
