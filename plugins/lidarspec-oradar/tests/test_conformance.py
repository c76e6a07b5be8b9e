"""Tests that the ORADAR sensors conform: the rules of `lidarspec check`."""

from __future__ import annotations

import pytest

from tests.installed import assert_installed_conformance, conformance_cases

DISTRIBUTION = "lidarspec-oradar"


@pytest.mark.parametrize("sensor_id", conformance_cases(DISTRIBUTION))
def test_sensor_conforms(sensor_id: str) -> None:
    assert_installed_conformance(DISTRIBUTION, sensor_id)
