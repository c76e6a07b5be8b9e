"""`SensorConformance`: the table of properties as a class of tests for pytest.

Derive a class from it, name the sensor, and let pytest collect it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, ClassVar

import pytest

from lidarspec.plugins import sensor as named_sensor
from lidarspec.spec.sensor import Sensor
from lidarspec.testing.declared import declared
from lidarspec.testing.findings import left_over
from lidarspec.testing.properties import PROPERTIES, Property
from lidarspec.testing.subject import EXAMPLES, Subject

_SUBJECTS: dict[type, Subject] = {}


class SensorConformance:
    """What holds for every sensor: a test for each property in `lidarspec.testing.properties`.

    Attributes:
        sensor: an id, a `Sensor`, or a file that describes one.
        examples: how many examples of each frame type a property tries; LIDARSPEC_EXAMPLES says it for all classes.
        strategies: "frame.field" -> a hypothesis strategy of its raw value, or a function of `random.Random`, for what cannot be derived.
        vectors: a file of golden vectors, beside the test's own file where it is no absolute path.
        elsewhere: frame types that the class of a relative tries, which has the same ones.
    """

    sensor: ClassVar[str | Path | Sensor] = ""
    examples: ClassVar[int] = EXAMPLES
    strategies: ClassVar[Mapping[str, Any]] = {}
    vectors: ClassVar[str | Path | None] = None
    elsewhere: ClassVar[Collection[str]] = ()

    @pytest.fixture
    def subject(self, request: pytest.FixtureRequest) -> Subject:
        """The sensor under test, with its examples; one for all tests of the class."""
        kind = type(self)
        if kind not in _SUBJECTS:
            sensor = self.sensor if isinstance(self.sensor, Sensor) else named_sensor(self.sensor)
            vectors = Path(request.path).parent / self.vectors if self.vectors else None
            _SUBJECTS[kind] = Subject(sensor, self.examples, self.strategies, vectors, elsewhere=self.elsewhere)
        return _SUBJECTS[kind]

    def test_the_declaration_is_sound(self, subject: Subject) -> None:
        """Units, sources, lengths, sync patterns, coverage and plausibility, as `lidarspec check` reads them off."""
        _hold(left_over(declared(subject), subject.sensor, whole=False))


def _test(one: Property) -> Callable[..., None]:
    def test(self: SensorConformance, subject: Subject, record_property: Callable[[str, object], None]) -> None:
        reason = one.lacks(subject)
        if reason:
            pytest.skip(reason)
        found = one.findings(subject)
        for name, value in (subject.measured | subject.picture).items():
            record_property(name, value)
        _hold(left_over(found, subject.sensor, whole=False))

    test.__name__, test.__doc__ = f"test_{one.name}", one.function.__doc__
    return test


def _hold(findings: list[Any]) -> None:
    """Fail with every finding in words."""
    __tracebackhide__ = True
    if findings:
        pytest.fail("\n".join(map(str, findings)), pytrace=False)


for _one in PROPERTIES:
    setattr(SensorConformance, f"test_{_one.name}", _test(_one))
