"""A sensor under test, and what it is fed: conversations out of its own examples, their edits, cuts
and noise.

A `Subject` has the sensor, its examples (drawn by the author's own strategies where there are some)
and what was measured along the way. Everything that is drawn is seeded, so that what fails once
fails again.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidarspec.framing.examples import random_frame
from lidarspec.framing.frame_engine import codec
from lidarspec.spec import Frame, Sensor
from lidarspec.spec.tree import FieldInfo, Sealed, nodes

#: Bytes up to which a frame is cut at every byte.
SHORT = 300
#: Random places at which a longer frame is cut, beside both ends.
SPOTS = 50


def delivery(sensor: Sensor, frames: list[tuple[str, bytes]]) -> Any:
    """Frames as the data link delivers them: datagrams, or one run of bytes."""
    parts = [data for _, data in frames]
    if sensor.datagrams:
        return parts
    return b"".join(parts)


def places(length: int, source: random.Random, spots: int = SPOTS) -> list[int]:
    """Where to cut so many bytes: everywhere if they are few, else at the ends and at random."""
    if length <= SHORT * spots // SPOTS:
        return list(range(length))
    ends = {0, 1, 2, 3, length - 2, length - 1} & set(range(length))
    return sorted({*ends, *source.sample(range(length), min(spots, length))})


#: Bytes of the chunks that a stream is cut into, and their mean.
CHUNKS = (0, 1, 1, 2, 3, 7, 20, 100, 1000)
MEAN_CHUNK = sum(CHUNKS) / len(CHUNKS)


def pieces(data: bytes, source: random.Random, scale: int = 1) -> Iterator[bytes]:
    """Yield the bytes in chunks of random sizes, empty ones among them.

    Args:
        scale: by which the sizes are multiplied.
    """
    start = 0
    while start < len(data):
        size = source.choice(CHUNKS) * scale
        yield data[start : start + size]
        start += size


def mutate(
    data: bytes, source: random.Random, words: Sequence[bytes] = (), spots: Sequence[int] = ()
) -> bytes:
    """The bytes with a few of them changed, dropped, doubled or put in, or cut short.

    Args:
        words: what is put in or written over as a whole, such as values at the edge of a range, or
            pieces of other inputs.
        spots: where half of the changes are made, such as the offsets of fields; without them
            anywhere.
    """
    found = bytearray(data)
    for _ in range(source.choice((1, 1, 2, 4))):
        if spots and source.random() < 0.5:
            spot = source.choice(spots)
        else:
            spot = source.randrange(len(found) + 1)
        kind = source.randrange(6 if words else 5)
        if kind == 0:
            found[spot : spot + 1] = source.randbytes(1)
        elif kind == 1:
            del found[spot : spot + source.randint(1, 3)]
        elif kind == 2:
            found[spot:spot] = source.randbytes(source.randint(1, 3))
        elif kind == 3:
            found[spot : spot + 1] = source.choice((b"\x00", b"\xff", b"\x7f", b"\x80"))
        elif kind == 4:
            found[spot:spot] = found[max(spot - 4, 0) : spot]
        else:
            word = source.choice(words)
            found[spot : spot + source.choice((0, len(word)))] = word
    return bytes(found)


def integers(
    parsed: Any, path: str = "", kinds: tuple[type, ...] = (int,)
) -> Iterator[tuple[Any, Any, str]]:
    """The integers, or the values of other types, of a parsed frame: (container, key in it, field
    path).
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
            yield from integers(value, below, kinds)
        elif type(value) in kinds:
            yield parsed, key, below


def physical(sensor: Sensor, name: str, data: bytes) -> Any:
    """A parsed frame with its scaled numbers in units; None where one is too wide for a float to
    hold exactly.
    """
    fields = codec(sensor.frames[name]).schema.all_fields
    parsed = sensor.parse(data, frame=name)
    for holder, key, path in list(integers(parsed, kinds=(int, float))):
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


def seals(sensor: Sensor, name: str, data: bytes) -> set[str]:
    """The fields of a frame that hold a checksum, and so are not the caller's."""
    engine = codec(sensor.frames[name])
    layout = getattr(engine, "tree", None)
    if layout is None or engine.schema.parts:
        return {
            path
            for node in nodes(sensor.frames[name].tree)
            if isinstance(node, Sealed)
            for path in node.fields
        }
    found = layout.layout(data)
    return {leaf.info.path for seal in getattr(found, "seals", ()) for leaf in seal.leaves}


#: examples of each frame type that a property tries, and those for which numbers of rounds are
#: stated.
USUAL_EXAMPLES = 40
#: Rounds of a conversation with the usual number of examples.
USUAL_ROUNDS = 3
#: Rounds of a conversation, at least.
LEAST_ROUNDS = 2
EXAMPLES = int(os.environ.get("LIDARSPEC_EXAMPLES", USUAL_EXAMPLES))
#: sensors with more frame types than this are tried with less of each.
MANY = 8
#: bytes of the examples of one frame type that a property tries: of long frames fewer are tried.
EXAMPLE_BYTES = 300_000
#: bytes after which no further round of a conversation begins.
CONVERSATION_BYTES = 500_000
#: seeds of the examples that tell how long frames are.
MEASURED_SEEDS = 3
#: values that are drawn from a hypothesis strategy.
POOL = 60


@dataclass(eq=False)
class Subject:
    """A sensor under test.

    Attributes:
        sensor: it.
        examples: how many examples of each frame type a property tries.
        strategies: "frame.field" -> how its raw value is drawn: a hypothesis strategy, or a
            function of `random.Random`.
        vectors: the file of golden vectors, None where there is none.
        family: the ids of the sensors that share that file; none where it is this sensor's alone.
        tested: related models that are tested too; frame types that they share are not tested one
            by one again.
        measured: what was measured of frames, in words, by what it is of.
        picture: what was measured of points, likewise: to be held against the manual.
        traced: what `points` returns for traced columns of each data frame, as far as it could be
            traced.
        placed: data frames of which golden vectors place points in two quadrants.
        swept: packets along the `sweep` of each data frame, as far as a property needed them.
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
    placed: set[str] = field(default_factory=set, repr=False)
    swept: dict[str, list[bytes]] = field(default_factory=dict, repr=False)
    _known: dict[tuple[str, int], bytes] = field(default_factory=dict, repr=False)
    _drawers: dict[str, dict[str, Callable[[random.Random], int]]] = field(
        default_factory=dict, repr=False
    )

    @property
    def frames(self) -> dict[str, Frame]:
        """The frame types that are tested one by one."""
        tested = {id(frame) for sensor in self.tested for frame in sensor.frames.values()}
        return {
            name: frame for name, frame in self.sensor.frames.items() if id(frame) not in tested
        }

    @property
    def commands(self) -> list[str]:
        """The commands that are tested one by one.

        A related model that is tested too may have the same command with the same frames, links
        and answers.
        """
        return [
            name
            for name in self.sensor.commands
            if not any(_has_same_exchange(self.sensor, other, name) for other in self.tested)
        ]

    def fields(self, frame: str) -> Mapping[str, FieldInfo]:
        """The fields of a frame type, by path."""
        return codec(self.sensor.frames[frame]).schema.all_fields

    def source(self, purpose: str = "") -> random.Random:
        """Random numbers of this sensor's own for one purpose, the same in every run."""
        return random.Random(f"{self.sensor.id} {purpose}")

    def seeds(self, name: str, share: float = 1.0) -> range:
        """Return the seeds of the examples of a frame type that are tried.

        They are fewer for long frames, since each field takes its time, and if the sensor has many
        frame types.
        """
        few = 8 if self.sensor.frames[name].max_length > SHORT else 1
        few *= 2 if len(self.sensor.frames) > MANY else 1
        return range(self.limit_to_bytes(name, max(int(self.examples * share) // few, 3)))

    def limit_to_bytes(
        self, name: str, number: int, total: int = EXAMPLE_BYTES, least: int = 1
    ) -> int:
        """Return how many of `number` frames of a type are tried, so that they have at most `total`
        bytes, or are the `least`.
        """
        return min(number, max(total // self.length(name), least))

    def length(self, name: str) -> int:
        """Return how long frames of a type are: the longest of a few examples, in bytes."""
        return max(1, *(len(self.example(name, seed=seed)) for seed in range(MEASURED_SEEDS)))

    def scale_rounds(self, rounds: int, least: int = 1) -> int:
        """Return a number of rounds that is meant for the usual number of examples, scaled to
        `examples`.
        """
        return max(rounds * self.examples // USUAL_EXAMPLES, least)

    def example(self, frame: str, *, seed: int = 0) -> bytes:
        """The bytes of a valid frame with seeded content, drawn by the author's strategies where
        there are some.
        """
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
        """How raw values of fields of this frame are drawn, by path, where the author says so."""
        if frame not in self._drawers:
            mine = {
                path.removeprefix(f"{frame}."): how
                for path, how in self.strategies.items()
                if path.partition(".")[0] == frame
            }
            self._drawers[frame] = {
                path: _make_pool(how) if hasattr(how, "example") else how
                for path, how in mine.items()
            }
        return self._drawers[frame]

    def conversation(self, *, seed: int = 0, rounds: int | None = None) -> list[tuple[str, bytes]]:
        """Frames of all incoming types as the sensor could send them: (type, bytes), each where it
        is looked for and believed.
        """
        frames: list[tuple[str, bytes]] = []
        size = 0
        for turn in range(
            self.scale_rounds(USUAL_ROUNDS, LEAST_ROUNDS) if rounds is None else rounds
        ):
            if size > CONVERSATION_BYTES:
                break
            for name in self.sensor.incoming:
                frame = self.sensor.frames[name]
                if frame.data or frame.confirm > 1:
                    number = frame.confirm + 2
                else:
                    number = 1
                first = (
                    seed * 1000 + turn * number
                )  # the lowest seeds, whose examples other properties use as well
                if frame.after is not None:
                    frames.append((frame.after, self.example(frame.after, seed=first)))
                frames += [
                    (name, self.example(name, seed=first + index)) for index in range(number)
                ]
            size = sum(len(data) for _, data in frames)
        return frames

    def stream(self, *, seed: int = 0, rounds: int | None = None) -> bytes:
        """The bytes of a conversation."""
        return b"".join(data for _, data in self.conversation(seed=seed, rounds=rounds))


def _has_same_exchange(one: Sensor, other: Sensor, name: str) -> bool:
    """Return whether a command of one sensor and its reply are those of another sensor too."""
    command = one.commands[name]
    if other.commands.get(name) != command:
        return False
    types = [command.frame, *command.replies] if command.frame else command.replies
    return (
        all(one.frames[kind] is other.frames.get(kind) for kind in types)
        and one.simulation.answers.get(name) == other.simulation.answers.get(name)
        and one.links.get(command.link) == other.links.get(command.link)
        and one.datagrams == other.datagrams
    )


def _make_pool(strategy: Any) -> Callable[[random.Random], int]:
    """Values of a hypothesis strategy, the same in every run."""
    from hypothesis import HealthCheck, Phase, given, settings

    pool: list[int] = []
    quiet: dict[str, Any] = {
        "database": None,
        "deadline": None,
        "suppress_health_check": list(HealthCheck),
    }

    @settings(max_examples=POOL, derandomize=True, phases=[Phase.generate], **quiet)
    @given(strategy)
    def collect(value: int) -> None:
        pool.append(value)

    collect()
    return lambda source: source.choice(pool)
