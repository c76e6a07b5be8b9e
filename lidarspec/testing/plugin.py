"""The pytest plugin: fixtures for tests of sensors. It imports nothing of the engine before one of
them is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from lidarspec.plugins import Registry
    from lidarspec.sensor_operations import Sensor
    from lidarspec.transports.serving import Served


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known."""
    config.addinivalue_line(
        "markers",
        "lidarspec(sensor): the sensor that the `sensor` fixture gives: an id, a Sensor or a file",
    )


@pytest.fixture
def sensor(request: pytest.FixtureRequest) -> Sensor:
    """Return the sensor under test.

    It is the sensor of ``@pytest.mark.lidarspec("acme-x1")``, or of the test class.
    """
    from lidarspec.plugins import sensor as named
    from lidarspec.sensor_operations import Sensor

    marker = request.node.get_closest_marker("lidarspec")
    if marker:
        wanted = marker.args[0]
    else:
        wanted = getattr(request.cls, "sensor", None)
    if not wanted:
        raise pytest.UsageError(
            'which sensor? mark the test with @pytest.mark.lidarspec("acme-x1"), or give its class'
            " a `sensor`"
        )
    if isinstance(wanted, Sensor):
        return wanted
    return named(wanted)


@pytest.fixture
def virtual_port(request: pytest.FixtureRequest) -> Iterator[Callable[..., Served]]:
    """A function that puts a simulated sensor on a real port until the test ends:
    `lidarspec.testing.fixtures.virtual_port`.

    Its first argument is an id or a Sensor; without one it is the test's own `sensor`. What comes
    back has a `path` to open.
    """
    from lidarspec.testing import fixtures as ports

    with ExitStack() as stack:

        def serve_sensor(wanted: Any = None, **more: Any) -> Served:
            return stack.enter_context(
                ports.virtual_port(wanted or request.getfixturevalue("sensor"), **more)
            )

        yield serve_sensor


@pytest.fixture
def bare_registry() -> Iterator[Registry]:
    """An empty registry in the place of that of this environment: no installed plugin is seen, and
    `add` adds one.
    """
    from lidarspec.plugins import Registry, standing_in

    with standing_in(Registry()) as registry:
        yield registry
