"""The state of the sensor, as /diagnostics reports it once a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from lidarspec.cli.read import FIGURES
from lidarspec.device.device import Device
from lidarspec.view.rate_meter import MeterReading

#: The states of a device that sends nothing.
LOST_STATES = ("disconnected", "silent")


def make_status(
    name: str,
    device: Device,
    reading: MeterReading,
    extra_warnings: Sequence[str],
    extra_values: Mapping[str, str],
) -> DiagnosticStatus:
    """Return the state of a device for /diagnostics.

    Args:
        reading: the statistics of the last second.
        extra_warnings: warnings in addition to the warnings of the device.
        extra_values: values in addition to the state and the statistics, by name.
    """
    warnings = [*device.warnings, *extra_warnings]
    figures = {f"{name} [{unit}]": text(reading) for name, unit, _, text in FIGURES}
    values = {
        "state": device.state,
        **figures,
        **extra_values,
        **device.info,
        **{f"warning {n + 1}": text for n, text in enumerate(warnings)},
    }
    level = DiagnosticStatus.OK
    if device.state in LOST_STATES:
        level = DiagnosticStatus.ERROR
    elif warnings:
        level = DiagnosticStatus.WARN
    return DiagnosticStatus(
        level=level,
        name=f"{name}: {device.sensor.id}",
        message=warnings[0] if warnings else device.state,
        hardware_id=device.info.get("serial", str(device.source)),
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )
