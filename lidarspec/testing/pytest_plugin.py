"""The pytest plugin: fixtures for tests of sensors.

The engine is imported only when a fixture is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from lidarspec.plugins import Registry
    from lidarspec.sensor_operations import Sensor
    from lidarspec.transports.serving import ServedSensor


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker `lidarspec`."""
    config.addinivalue_line(
        "markers",
        "lidarspec(sensor): the sensor of the `sensor` fixture: an id, a Sensor or a file",
    )


@pytest.fixture
def sensor(request: pytest.FixtureRequest) -> Sensor:
    """Return the sensor of the marker ``lidarspec("acme-x1")`` or of the test class."""
    from lidarspec.plugins import sensor as named
    from lidarspec.sensor_operations import Sensor

    marker = request.node.get_closest_marker("lidarspec")
    if marker:
        wanted = marker.args[0]
    else:
        wanted = getattr(request.cls, "sensor", None)
    if not wanted:
        raise pytest.UsageError(
            'sensor missing: mark the test with @pytest.mark.lidarspec("acme-x1"), or set'
            " `sensor` in its class"
        )
    if isinstance(wanted, Sensor):
        return wanted
    return named(wanted)


@pytest.fixture
def virtual_port(request: pytest.FixtureRequest) -> Iterator[Callable[..., ServedSensor]]:
    """Put a simulated sensor on a real port until the test ends.

    The fixture is a function like `lidarspec.testing.fixtures.virtual_port`. Its first argument is
    an id or a Sensor, by default the test's own `sensor`. Its result has a `path` to open.
    """
    from lidarspec.testing import fixtures as ports

    with ExitStack() as stack:

        def serve_sensor(wanted: Any = None, **more: Any) -> ServedSensor:
            return stack.enter_context(
                ports.virtual_port(wanted or request.getfixturevalue("sensor"), **more)
            )

        yield serve_sensor


@pytest.fixture
def bare_registry() -> Iterator[Registry]:
    """Replace the registry by an empty registry until the test ends."""
    from lidarspec.plugins import Registry, use_registry

    with use_registry(Registry()) as registry:
        yield registry
