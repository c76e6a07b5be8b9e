"""A test kit for authors of sensors: a class for pytest, and `lidarspec check`.

    from lidarspec.testing import SensorConformance

    class TestMine(SensorConformance):
        sensor = "acme-x1"        # an id, a Sensor value, or a file such as "./acme.py"

In: a sensor. Out: passed tests, or findings with location, reason and remedy. Modules in reading
order:

* `properties`: the table of properties that every sensor must have.
* `conformance`: everything that `check` checks, as one test for pytest.
* `findings`: the rules, and the exception of a property that does not hold.
* `sensor_under_test`: a sensor under test, with its examples.
* `declaration`: checks of the declaration alone.
* `frames`: checks of single frames, valid and damaged.
* `consistency`: agreement of angles, clock and times of points.
* `geometry`: directions and positions of points.
* `commands`: requests, replies, and the replies of the simulated sensor.
* `streams`: streams of frames, decoded twice and in batches.
* `cloud_assertions`: assertions about point clouds.
* `vectors`: golden frames from a manual or capture.
* `strategies`: Hypothesis strategies for authors.
* `value_ranges`: the values that are valid together in one layout.
* `check`: all checks without pytest, for a name, file, distribution or folder.
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
