"""A test kit for authors: what a sensor's declaration has to keep, as a class for pytest and as `lidarspec check`.

from lidarspec.testing import SensorConformance

class TestMine(SensorConformance):
    sensor = "acme-x1"        # an id, a Sensor value, or a file such as "./acme.py"
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarspec.testing.conformance import SensorConformance

__all__ = ["SensorConformance"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'lidarspec.testing' has no attribute {name!r}")
    try:
        import hypothesis  # noqa: F401
        import pytest
    except ImportError as error:
        raise ImportError("the test kit needs pytest and hypothesis: pip install 'lidarspec[testing]'") from error
    pytest.register_assert_rewrite("lidarspec.testing.agreement")
    from lidarspec.testing.conformance import SensorConformance

    return SensorConformance
