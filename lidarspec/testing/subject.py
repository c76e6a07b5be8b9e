"""A sensor under test: its examples, with the author's own strategies in them, and what was measured along the way."""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidarspec.examples import examples
from lidarspec.plugins import sensor as named_sensor
from lidarspec.spec import Frame, Sensor
from lidarspec.testing import material

#: examples of each frame type that a property tries.
EXAMPLES = int(os.environ.get("LIDARSPEC_EXAMPLES", "40"))
#: sensors with more frame types than this are tried with less of each.
MANY = 8
#: values that are drawn from a hypothesis strategy.
POOL = 60


@dataclass(eq=False)
class Subject:
    """A sensor under test.

    Attributes:
        sensor: it.
        examples: how many examples of each frame type a property tries.
        strategies: "frame.field" -> how its raw value is drawn: a hypothesis strategy, or a function of `random.Random`.
        vectors: the file of golden vectors, None where there is none.
        measured: what was measured, in words, by what it is of.
    """

    sensor: Sensor
    examples: int = EXAMPLES
    strategies: Mapping[str, Any] = field(default_factory=dict)
    vectors: Path | None = None
    measured: dict[str, str] = field(default_factory=dict)
    _known: dict[tuple[str, int], bytes] = field(default_factory=dict, repr=False)
    _drawers: dict[str, dict[str, Callable[[random.Random], int]]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, sensor: str | Path | Sensor, **more: Any) -> Subject:
        """The sensor of an id, a file, or itself."""
        return cls(sensor if isinstance(sensor, Sensor) else named_sensor(sensor), **more)

    def source(self, purpose: str = "") -> random.Random:
        """Random numbers of this sensor's own for one purpose, the same in every run."""
        return random.Random(f"{self.sensor.id} {purpose}")

    def seeds(self, frame: Frame, share: float = 1.0) -> range:
        """Seeds of examples: fewer for long frames, since construct takes its time for each field, and where there are many types."""
        few = 8 if frame.max_length > material.SHORT else 1
        few *= 2 if len(self.sensor.frames) > MANY else 1
        return range(max(int(self.examples * share) // few, 3))

    def example(self, frame: str, *, seed: int = 0) -> bytes:
        """The bytes of a valid frame with seeded content, drawn by the author's strategies where there are some."""
        if (frame, seed) not in self._known:
            drawn = self.drawers(frame)
            source = random.Random(f"{self.sensor.id} {frame} {seed}")
            made = examples(self.sensor, frame, source, drawn)[0] if drawn else self.sensor.example(frame, seed=seed)
            self._known[frame, seed] = made
        return self._known[frame, seed]

    def drawers(self, frame: str) -> dict[str, Callable[[random.Random], int]]:
        """How raw values of fields of this frame are drawn, by path, where the author says so."""
        if frame not in self._drawers:
            mine = {path.partition(".")[2]: how for path, how in self.strategies.items() if path.partition(".")[0] == frame}
            self._drawers[frame] = {path: how if _is_function(how) else _pooled(how) for path, how in mine.items()}
        return self._drawers[frame]

    def conversation(self, *, seed: int = 0, rounds: int = 3) -> list[tuple[str, bytes]]:
        """Frames of all incoming types as the sensor could send them: (type, bytes), each where it is looked for and believed."""
        return material.conversation(self.sensor, seed=seed, rounds=rounds, example=self.example)

    def stream(self, *, seed: int = 0, rounds: int = 3) -> bytes:
        """The bytes of a conversation."""
        return b"".join(data for _, data in self.conversation(seed=seed, rounds=rounds))


def _is_function(how: Any) -> bool:
    return callable(how) and not hasattr(how, "example")


def _pooled(strategy: Any) -> Callable[[random.Random], int]:
    """Values of a hypothesis strategy, the same in every run."""
    from hypothesis import HealthCheck, Phase, given, settings

    pool: list[int] = []

    @settings(
        max_examples=POOL, derandomize=True, database=None, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck)
    )
    @given(strategy)
    def collect(value: int) -> None:
        pool.append(value)

    collect()
    return lambda source: source.choice(pool)
