"""Simulated replies of each model: information, scan modes, and the descriptor of each mode.

Source: replies of a live A1, for its information and its mode Sensitivity. Everything else is
assumed. The assumed times and ranges of the other modes are the values that the vendor's SDK prints
for similar models.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lidarspec_slamtec import answers

NODE = 0x81
EXPRESS = 0x82
ULTRA = 0x84
DENSE = 0x85
DESCRIPTORS = {
    NODE: "scan_descriptor",
    EXPRESS: "express_descriptor",
    ULTRA: "ultra_descriptor",
    DENSE: "dense_descriptor",
}
#: Commands that request configuration values of the sensor, and of a scan mode.
SENSOR_REQUESTS = ("get_config", "get_mode_count", "get_typical_mode")
MODE_REQUESTS = (
    "get_mode_config",
    "get_us_per_sample",
    "get_max_distance",
    "get_answer_type",
    "get_mode_name",
)


@dataclass(frozen=True)
class Mode:
    """A scan mode.

    Attributes:
        us_per_sample: microseconds from point to point.
        max_range: the longest range in metres.
        kind: the type of its descriptor.
    """

    name: str
    us_per_sample: float
    max_range: float
    kind: int


@dataclass(frozen=True)
class SimulatedUnit:
    """Values of a simulated unit.

    Attributes:
        model: the model number in the reply with information.
        modes: its scan modes; the typical mode is the last.
    """

    model: int
    modes: tuple[Mode, ...]

    def answers(self) -> dict[str, Any]:
        """Return the replies that do not depend on the request, by command."""
        information = {
            "model": self.model,
            "firmware_minor": 29,
            "firmware_major": 1,
            "hardware": 7,
            "serial": bytes(range(1, 17)),
        }
        times = {
            "standard": round(self.modes[0].us_per_sample),
            "express": round(self.modes[-1].us_per_sample),
        }
        return {
            "get_info": (("info", information),),
            "get_samplerate": (("sample_rate", times),),
            "get_accessory": (("accessory", {"flags.pwm": 1}),),
            "express_scan": self.reply_descriptor,
            **dict.fromkeys((*SENSOR_REQUESTS, *MODE_REQUESTS), self.reply_config),
        }

    def reply_config(self, request: Mapping[str, Any]) -> tuple[tuple[str, Mapping[str, Any]], ...]:
        """Return the reply with a configuration value; empty for an unknown key or mode."""
        key = request["key"]
        number = request.get("mode", 0)
        if number >= len(self.modes):
            return ()
        mode = self.modes[number]
        values = {
            answers.MODE_COUNT: len(self.modes),
            answers.TYPICAL_MODE: len(self.modes) - 1,
            answers.US_PER_SAMPLE: mode.us_per_sample,
            answers.MAX_DISTANCE: mode.max_range,
            answers.ANSWER_TYPE: mode.kind,
            answers.MODE_NAME: mode.name.encode() + b"\0",
        }
        return (answers.make_config(key, values[key]),) if key in values else ()

    def reply_descriptor(self, request: Mapping[str, Any]) -> tuple[str, ...]:
        """Return the descriptor of the requested scan mode; empty for an unknown mode."""
        number = request["mode"]
        if number >= len(self.modes):
            return ()
        return (DESCRIPTORS[self.modes[number].kind if number else EXPRESS],)


A1 = SimulatedUnit(
    0x18,
    (
        Mode("Standard", 508, 12, NODE),
        Mode("Express", 254, 12, EXPRESS),
        Mode("Boost", 127, 12, ULTRA),
        Mode("Sensitivity", 127, 12, ULTRA),
    ),
)
A2 = SimulatedUnit(
    0x28,
    (
        Mode("Standard", 500, 12, NODE),
        Mode("Express", 250, 12, EXPRESS),
        Mode("Boost", 125, 12, ULTRA),
        Mode("Sensitivity", 125, 12, ULTRA),
    ),
)
A3 = SimulatedUnit(
    0x31,
    (
        Mode("Standard", 250, 16, NODE),
        Mode("Express", 125, 16, EXPRESS),
        Mode("Boost", 63, 25, ULTRA),
        Mode("Sensitivity", 63, 25, ULTRA),
    ),
)
S1 = SimulatedUnit(0x61, (Mode("Standard", 217, 40, NODE), Mode("Express", 109, 40, EXPRESS)))
S2 = SimulatedUnit(0x71, (Mode("Standard", 125, 30, NODE), Mode("DenseBoost", 31, 30, DENSE)))
S3 = SimulatedUnit(0x81, (Mode("Standard", 125, 40, NODE), Mode("DenseBoost", 31, 40, DENSE)))
T1 = SimulatedUnit(0x91, (Mode("Standard", 125, 40, NODE), Mode("Sensitivity", 31, 40, ULTRA)))
C1 = SimulatedUnit(0x41, (Mode("Standard", 200, 12, NODE), Mode("DenseBoost", 200, 12, DENSE)))
