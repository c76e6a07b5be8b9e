"""A sensor under test, and functions that make, edit and truncate its examples.

All random values are seeded, so that a failure can be repeated.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidarspec.framing.example_frames import random_frame
from lidarspec.framing.frame_engine import get_codec
from lidarspec.spec import Frame, Sensor
from lidarspec.spec.tree import ChecksummedStruct, FieldInfo, nodes

#: Maximum length in bytes of a short frame, which is cut at every byte.
MAX_SHORT_BYTES = 300
#: Number of random offsets at which a longer frame is cut, besides those near its ends.
CUT_OFFSETS = 50


def make_input(sensor: Sensor, frames: list[tuple[str, bytes]]) -> Any:
    """Return frames as the data link delivers them: a list of datagrams, or bytes."""
    parts = [data for _, data in frames]
    if sensor.datagrams:
        return parts
    return b"".join(parts)


def pick_offsets(length: int, source: random.Random, count: int = CUT_OFFSETS) -> list[int]:
    """Return offsets at which a frame is cut; all offsets if the frame is short."""
    if length <= MAX_SHORT_BYTES * count // CUT_OFFSETS:
        return list(range(length))
    ends = {0, 1, 2, 3, length - 2, length - 1} & set(range(length))
    return sorted({*ends, *source.sample(range(length), min(count, length))})


def mutate(
    data: bytes, source: random.Random, words: Sequence[bytes] = (), offsets: Sequence[int] = ()
) -> bytes:
    """Return a copy of the bytes with a few random changes.

    Args:
        words: byte strings to insert or to write over existing bytes, for example values at the
            edge of a range.
        offsets: offsets for half of the changes, for example the offsets of fields; by default, all
            offsets are random.
    """
    mutated = bytearray(data)
    for _ in range(source.choice((1, 1, 2, 4))):
        if offsets and source.random() < 0.5:
            offset = source.choice(offsets)
        else:
            offset = source.randrange(len(mutated) + 1)
        kind = source.randrange(6 if words else 5)
        if kind == 0:
            mutated[offset : offset + 1] = source.randbytes(1)
        elif kind == 1:
            del mutated[offset : offset + source.randint(1, 3)]
        elif kind == 2:
            mutated[offset:offset] = source.randbytes(source.randint(1, 3))
        elif kind == 3:
            mutated[offset : offset + 1] = source.choice((b"\x00", b"\xff", b"\x7f", b"\x80"))
        elif kind == 4:
            mutated[offset:offset] = mutated[max(offset - 4, 0) : offset]
        else:
            word = source.choice(words)
            mutated[offset : offset + source.choice((0, len(word)))] = word
    return bytes(mutated)


def iter_integers(
    parsed: Any, path: str = "", kinds: tuple[type, ...] = (int,)
) -> Iterator[tuple[Any, Any, str]]:
    """Yield (container, key, field path) for each integer of a parsed frame.

    Args:
        parsed: a dict or list of the frame.
        path: the path of `parsed` in the frame.
        kinds: the Python types that count as integers.
    """
    entries: Iterable[tuple[Any, Any]] = (
        parsed.items() if isinstance(parsed, dict) else enumerate(parsed)
    )
    for key, value in entries:
        if isinstance(parsed, list):
            below = path
        elif path:
            below = f"{path}.{key}"
        else:
            below = key
        if isinstance(value, dict | list):
            yield from iter_integers(value, below, kinds)
        elif type(value) in kinds:
            yield parsed, key, below


def parse_physical(sensor: Sensor, name: str, data: bytes) -> Any:
    """Parse a frame, and convert scaled numbers to their units.

    Returns None if a number is too large for an exact float.
    """
    fields = get_codec(sensor.frames[name]).schema.all_fields
    parsed = sensor.parse(data, frame=name)
    for holder, key, path in list(iter_integers(parsed, kinds=(int, float))):
        info = fields.get(path)
        if info is not None and info.scaled:
            value = info.physical(holder[key])
            if (
                info.kind == "float"
                and info.dtype is not None
                and info.dtype.type(info.raw(value)) != holder[key]
            ):
                return None
            if info.kind == "int" and info.bits > 48:
                return None
            holder[key] = value
    return parsed


def find_checksum_paths(sensor: Sensor, name: str, data: bytes) -> set[str]:
    """Return the paths of all fields in a frame that store a checksum."""
    engine = get_codec(sensor.frames[name])
    layout = getattr(engine, "tree", None)
    if layout is None or engine.schema.has_measured_sizes:
        return {
            path
            for node in nodes(sensor.frames[name].tree)
            if isinstance(node, ChecksummedStruct)
            for path in node.fields
        }
    layout_or_refusal = layout.layout(data)
    return {
        leaf.info.path
        for checksum in getattr(layout_or_refusal, "checksums", ())
        for leaf in checksum.leaves
    }


#: Default number of examples of each frame type for each property. All other numbers of rounds
#: apply to this default.
USUAL_EXAMPLES = 40
#: Default number of rounds of a conversation.
USUAL_ROUNDS = 3
#: Minimum number of rounds of a conversation.
MIN_ROUNDS = 2
EXAMPLES = int(os.environ.get("LIDARSPEC_EXAMPLES", USUAL_EXAMPLES))
#: If a sensor has more frame types than this, fewer examples of each are used.
MANY_FRAME_TYPES = 8
#: Maximum total bytes of the examples of one frame type that a property uses.
MAX_EXAMPLE_BYTES = 300_000
#: After this number of bytes, no further round of a conversation begins.
CONVERSATION_BYTES = 500_000
#: Number of examples whose lengths are measured to find the length of a frame type.
MEASURED_SEEDS = 3
#: Number of values that are drawn from a hypothesis strategy.
POOL_SIZE = 60


@dataclass(eq=False)
class SensorUnderTest:
    """A sensor under test.

    Attributes:
        examples: number of examples of each frame type for each property.
        strategies: "frame.field" -> a hypothesis strategy of its raw value, or a function of
            `random.Random`.
        vectors: the file of golden vectors; None if there is no such file.
        family: the ids of the sensors that share the file of golden vectors.
        tested: related models; frame types that they share with this sensor are not tested again.
        measured: quantity that was measured for frames -> result as text.
        picture: quantity that was measured for points -> result as text.
        traced: data frame -> the result of `geometry.trace_points`.
        frames_with_two_quadrants: names of the data frames whose golden vectors have points in two
            quadrants.
        swept: data frame -> the packets of its `sweep` that have been made so far.
    """

    sensor: Sensor
    examples: int = EXAMPLES
    strategies: Mapping[str, Any] = field(default_factory=dict)
    vectors: Path | None = None
    family: tuple[str, ...] = ()
    tested: Sequence[Sensor] = ()
    measured: dict[str, str] = field(default_factory=dict)
    picture: dict[str, str] = field(default_factory=dict)
    traced: dict[str, Any] = field(default_factory=dict, repr=False)
    frames_with_two_quadrants: set[str] = field(default_factory=set, repr=False)
    swept: dict[str, list[bytes]] = field(default_factory=dict, repr=False)
    _known: dict[tuple[str, int], bytes] = field(default_factory=dict, repr=False)
    _drawers: dict[str, dict[str, Callable[[random.Random], int]]] = field(
        default_factory=dict, repr=False
    )

    @property
    def frames(self) -> dict[str, Frame]:
        """The frame types to test; types shared with a tested related model are omitted."""
        tested = {id(frame) for sensor in self.tested for frame in sensor.frames.values()}
        return {
            name: frame for name, frame in self.sensor.frames.items() if id(frame) not in tested
        }

    @property
    def commands(self) -> list[str]:
        """The commands to test; commands shared with a tested related model are omitted."""
        return [
            name
            for name in self.sensor.commands
            if not any(_has_same_exchange(self.sensor, other, name) for other in self.tested)
        ]

    def fields(self, frame: str) -> Mapping[str, FieldInfo]:
        """Return the fields of a frame type, by path."""
        return get_codec(self.sensor.frames[frame]).schema.all_fields

    def make_random(self, purpose: str = "") -> random.Random:
        """Return a random generator for a purpose; it gives the same numbers in every run."""
        return random.Random(f"{self.sensor.id} {purpose}")

    def seeds(self, name: str, share: float = 1.0) -> range:
        """Return the seeds of the examples with which a property tests a frame type.

        Args:
            share: the number of examples relative to the usual number.
        """
        few = 8 if self.sensor.frames[name].max_length > MAX_SHORT_BYTES else 1
        few *= 2 if len(self.sensor.frames) > MANY_FRAME_TYPES else 1
        return range(self.limit_to_bytes(name, max(int(self.examples * share) // few, 3)))

    def limit_to_bytes(
        self, name: str, number: int, total: int = MAX_EXAMPLE_BYTES, least: int = 1
    ) -> int:
        """Return the number of frames of a type to use, at most `number`.

        Args:
            number: the wanted number of frames.
            total: maximum total bytes of these frames.
            least: minimum number of frames, even if they exceed `total`.
        """
        return min(number, max(total // self.length(name), least))

    def length(self, name: str) -> int:
        """Return the length in bytes of the longest of a few examples of a type."""
        return max(1, *(len(self.example(name, seed=seed)) for seed in range(MEASURED_SEEDS)))

    def scale_rounds(self, rounds: int, least: int = 1) -> int:
        """Return how often a check repeats something, in proportion to `examples`.

        Args:
            rounds: the number of repetitions for the default number of examples.
            least: the minimum of the result.
        """
        return max(rounds * self.examples // USUAL_EXAMPLES, least)

    def example(self, frame: str, *, seed: int = 0) -> bytes:
        """Return the bytes of a valid frame with seeded content."""
        if (frame, seed) not in self._known:
            drawn = self.drawers(frame)
            source = random.Random(f"{self.sensor.id} {frame} {seed}")
            if drawn:
                example = random_frame(self.sensor, frame, source, drawn)
            else:
                example = self.sensor.example(frame, seed=seed)
            self._known[frame, seed] = example
        return self._known[frame, seed]

    def drawers(self, frame: str) -> dict[str, Callable[[random.Random], int]]:
        """Return the functions of the plugin's author that draw raw values, by field path."""
        if frame not in self._drawers:
            own = {
                path.removeprefix(f"{frame}."): how
                for path, how in self.strategies.items()
                if path.partition(".")[0] == frame
            }
            self._drawers[frame] = {
                path: _make_pool(how) if hasattr(how, "example") else how
                for path, how in own.items()
            }
        return self._drawers[frame]

    def conversation(self, *, seed: int = 0, rounds: int | None = None) -> list[tuple[str, bytes]]:
        """Return frames as the sensor could send them: (type, bytes) of each frame.

        Args:
            seed: selects the content of the frames.
            rounds: maximum number of rounds, which contain all incoming types; None to derive it
                from `examples`.
        """
        frames: list[tuple[str, bytes]] = []
        size = 0
        for turn in range(
            self.scale_rounds(USUAL_ROUNDS, MIN_ROUNDS) if rounds is None else rounds
        ):
            if size > CONVERSATION_BYTES:
                break
            for name in self.sensor.incoming:
                frame = self.sensor.frames[name]
                if frame.data or frame.confirm > 1:
                    number = frame.confirm + 2
                else:
                    number = 1
                # Other properties have already made the examples of the lowest seeds.
                first = seed * 1000 + turn * number
                if frame.after is not None:
                    frames.append((frame.after, self.example(frame.after, seed=first)))
                frames += [
                    (name, self.example(name, seed=first + index)) for index in range(number)
                ]
            size = sum(len(data) for _, data in frames)
        return frames

    def stream(self, *, seed: int = 0, rounds: int | None = None) -> bytes:
        """Return the bytes of the frames of `conversation`, joined."""
        return b"".join(data for _, data in self.conversation(seed=seed, rounds=rounds))


def _has_same_exchange(sensor: Sensor, other: Sensor, name: str) -> bool:
    """Return whether a command and its reply are equal in two sensors."""
    command = sensor.commands[name]
    if other.commands.get(name) != command:
        return False
    types = [command.frame, *command.replies] if command.frame else command.replies
    return (
        all(sensor.frames[kind] is other.frames.get(kind) for kind in types)
        and sensor.simulation.answers.get(name) == other.simulation.answers.get(name)
        and sensor.links.get(command.link) == other.links.get(command.link)
        and sensor.datagrams == other.datagrams
    )


def _make_pool(strategy: Any) -> Callable[[random.Random], int]:
    """Return a function that chooses from values of a hypothesis strategy."""
    from hypothesis import HealthCheck, Phase, given, settings

    pool: list[int] = []
    quiet: dict[str, Any] = {
        "database": None,
        "deadline": None,
        "suppress_health_check": list(HealthCheck),
    }

    @settings(max_examples=POOL_SIZE, derandomize=True, phases=[Phase.generate], **quiet)
    @given(strategy)
    def collect(value: int) -> None:
        pool.append(value)

    collect()
    return lambda source: source.choice(pool)
