"""A test kit for authors of plugins: a class for pytest, and `lidarspec check`.

    from lidarspec.testing import SensorConformance

    class TestMine(SensorConformance):
        sensor = "acme-x1"        # an id, a Sensor value, or a file such as "./acme.py"

The input is a sensor. The result is passed tests, or findings with location, reason and remedy.
Modules in reading order:

* `properties`: the table of properties that every sensor must have.
* `conformance`: one test for pytest that does all checks of `lidarspec check`.
* `findings`: the rules, and the exception that reports a violated property.
* `sensor_under_test`: a sensor under test, with its examples.
* `declaration`: checks of the declaration alone.
* `frames`: checks of single frames, valid and damaged.
* `consistency`: checks that angles, clock and times of points agree.
* `geometry`: checks of the directions and positions of points.
* `commands`: checks of commands, their replies, and the replies of the simulated sensor.
* `streams`: checks that decoding a stream loses no frame and gives the same result every time.
* `cloud_assertions`: assertions about point clouds.
* `vectors`: golden frames from a manual or capture.
* `strategies`: Hypothesis strategies for authors.
* `value_ranges`: finds values of fields that together make a valid frame.
* `check`: does all checks without pytest, for a sensor, file, distribution or folder.
* `pytest_plugin`, `fixtures`: fixtures for pytest; simulated sensors on real ports.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from lidarspec.optional_libraries import import_library

if TYPE_CHECKING:
    from lidarspec.testing.conformance import SensorConformance, assert_conformance

__all__ = ["SensorConformance", "assert_conformance"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'lidarspec.testing' has no attribute {name!r}")
    import_library("hypothesis", "testing")
    pytest = import_library("pytest", "testing")
    # pytest warns if the module is imported already
    if "lidarspec.testing.cloud_assertions" not in sys.modules:
        pytest.register_assert_rewrite("lidarspec.testing.cloud_assertions")
    from lidarspec.testing import conformance

    return getattr(conformance, name)
