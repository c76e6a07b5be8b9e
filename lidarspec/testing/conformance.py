"""A pytest test that a sensor conforms, with all checks of `lidarspec check`.

Derive a class from `SensorConformance` and name the sensor, or call `assert_conformance` in your
own test. A failure lists all findings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import pytest

from lidarspec.sensor_operations import Sensor
from lidarspec.testing.check import CheckTarget, Report, find_target, iter_reports
from lidarspec.testing.sensor_under_test import EXAMPLES

#: The rule about an id that another installed plugin uses.
ID_TAKEN = "LS005"


def assert_conformance(
    sensor: str | Path | Sensor,
    *,
    examples: int = EXAMPLES,
    strategies: Mapping[str, Any] | None = None,
    vectors: str | Path | None = None,
    tested: Sequence[Sensor] = (),
) -> list[Report]:
    """Fail with all findings of `lidarspec check`, if there are any; return the reports.

    Findings of rule LS005 are ignored, because another installed plugin causes them.

    Args:
        sensor: an id, a `Sensor`, or a file that describes one.
        examples: number of examples of each frame type for each property.
        strategies: "frame.field" -> a hypothesis strategy of its raw value, or a function of
            `random.Random`. It is needed for fields whose valid values cannot be derived.
        vectors: a file of golden vectors; by default the file that `check` finds.
        tested: related models; frames and functions that they share with the sensor are not tested
            again.
    """
    __tracebackhide__ = True
    if isinstance(sensor, Sensor):
        check_target = CheckTarget([sensor])
    else:
        check_target = find_target(sensor)
    made = list(
        iter_reports(
            check_target,
            str(sensor),
            examples=examples,
            strategies=strategies,
            vectors=Path(vectors) if vectors else None,
            tested=tested,
        )
    )
    findings = [
        finding for report in made for finding in report.findings if finding.code != ID_TAKEN
    ]
    if findings:
        pytest.fail("\n\n".join(map(str, findings)), pytrace=False)
    return made


class SensorConformance:
    """Base class of a test that a sensor passes all checks.

    Attributes:
        sensor: an id, a `Sensor`, or a file that describes one.
        examples: number of examples of each frame type for each property; the default is 40, or
            LIDARSPEC_EXAMPLES.
        strategies: "frame.field" -> a hypothesis strategy of its raw value, or a function of
            `random.Random`. It is needed for fields whose valid values cannot be derived.
        vectors: a file of golden vectors, relative to the file of the test; by default the file
            that `lidarspec check` finds.
    """

    sensor: ClassVar[str | Path | Sensor] = ""
    examples: ClassVar[int] = EXAMPLES
    strategies: ClassVar[Mapping[str, Any]] = {}
    vectors: ClassVar[str | Path | None] = None

    def test_conformance(
        self, request: pytest.FixtureRequest, record_property: Callable[[str, object], None]
    ) -> None:
        """Check that the declaration is valid and that every property holds."""
        __tracebackhide__ = True
        if self.vectors:
            vectors = request.path.parent / self.vectors
        else:
            vectors = None
        for report in assert_conformance(
            self.sensor, examples=self.examples, strategies=self.strategies, vectors=vectors
        ):
            for name, value in (report.measured | report.picture).items():
                record_property(name, value)
