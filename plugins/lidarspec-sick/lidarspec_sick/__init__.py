"""SICK scanners: multiScan, picoScan, microScan3, and models that send LMDscandata telegrams."""

from __future__ import annotations

from collections.abc import Iterable

from lidarspec.spec import Sensor, hookimpl
from lidarspec_sick.compact import COMPACT
from lidarspec_sick.safety import MICROSCAN3 as MICROSCAN3
from lidarspec_sick.scanners import SCANNERS

TIM551, TIM561, TIM571, TIM781, TIM781S, TIM871S, LMS111, LMS151, LMS511, MRS1104 = SCANNERS
MULTISCAN136, PICOSCAN150 = COMPACT


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the SICK scanners."""
    return [*SCANNERS, *COMPACT, MICROSCAN3]
