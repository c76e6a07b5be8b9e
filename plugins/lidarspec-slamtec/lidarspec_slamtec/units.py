"""What a simulated unit of each model says of itself: information, scan modes, and the descriptor
that announces each mode.

Source: the information and the mode Sensitivity of the A1 are a live A1's answers. The rest is
assumed: the times and reaches of the other modes are those that the vendor's SDK prints for such
models, and only the kinds of capsules of a model are told apart.
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
DESCRIPTOR = {
    NODE: "scan_descriptor",
    EXPRESS: "express_descriptor",
    ULTRA: "ultra_descriptor",
    DENSE: "dense_descriptor",
}
#: what asks for configuration values, of the sensor and of one of its scan modes.
OF_SENSOR = ("get_config", "get_mode_count", "get_typical_mode")
OF_MODE = (
    "get_mode_config",
    "get_us_per_sample",
    "get_max_distance",
    "get_answer_type",
    "get_mode_name",
)


@dataclass(frozen=True)
class Mode:
    """A scan mode: its name, microseconds from point to point, reach in metres, and the type of its
    descriptor.
    """

    name: str
    us_per_sample: float
    reach: float
    kind: int


@dataclass(frozen=True)
class Unit:
    """What a unit says of itself; `model` as in its information, the typical mode is the last."""

    model: int
    modes: tuple[Mode, ...]

    def answers(self) -> dict[str, Any]:
        """What this unit answers, by command, where that is more than the reply as it stands."""
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
            "get_accessory": (("accessory", {"flags": 1}),),
            "express_scan": self.descriptor,
            **dict.fromkeys((*OF_SENSOR, *OF_MODE), self.config),
        }

    def config(self, request: Mapping[str, Any]) -> tuple[tuple[str, Mapping[str, Any]], ...]:
        """The answer to a request for a configuration value; none for a key or mode that it does
        not have.
        """
        key = request["key"]
        number = request.get("mode", 0)
        if number >= len(self.modes):
            return ()
        mode = self.modes[number]
        values = {
            answers.MODE_COUNT: len(self.modes),
            answers.TYPICAL_MODE: len(self.modes) - 1,
            answers.US_PER_SAMPLE: mode.us_per_sample,
            answers.MAX_DISTANCE: mode.reach,
            answers.ANSWER_TYPE: mode.kind,
            answers.MODE_NAME: mode.name.encode() + b"\0",
        }
        return (answers.config(key, values[key]),) if key in values else ()

    def descriptor(self, request: Mapping[str, Any]) -> tuple[str, ...]:
        """The descriptor of the scan mode that is asked for; mode 0 of an express request is the
        plain express scan.
        """
        number = request["mode"]
        if number >= len(self.modes):
            return ()
        return (DESCRIPTOR[self.modes[number].kind if number else EXPRESS],)


A1 = Unit(
    0x18,
    (
        Mode("Standard", 508, 12, NODE),
        Mode("Express", 254, 12, EXPRESS),
        Mode("Boost", 127, 12, ULTRA),
        Mode("Sensitivity", 127, 12, ULTRA),
    ),
)
A2 = Unit(
    0x28,
    (
        Mode("Standard", 500, 12, NODE),
        Mode("Express", 250, 12, EXPRESS),
        Mode("Boost", 125, 12, ULTRA),
        Mode("Sensitivity", 125, 12, ULTRA),
    ),
)
A3 = Unit(
    0x31,
    (
        Mode("Standard", 250, 16, NODE),
        Mode("Express", 125, 16, EXPRESS),
        Mode("Boost", 63, 25, ULTRA),
        Mode("Sensitivity", 63, 25, ULTRA),
    ),
)
S1 = Unit(0x61, (Mode("Standard", 217, 40, NODE), Mode("Express", 109, 40, EXPRESS)))
S2 = Unit(0x71, (Mode("Standard", 125, 30, NODE), Mode("DenseBoost", 31, 30, DENSE)))
S3 = Unit(0x81, (Mode("Standard", 125, 40, NODE), Mode("DenseBoost", 31, 40, DENSE)))
T1 = Unit(0x91, (Mode("Standard", 125, 40, NODE), Mode("Sensitivity", 31, 40, ULTRA)))
C1 = Unit(0x41, (Mode("Standard", 200, 12, NODE), Mode("DenseBoost", 200, 12, DENSE)))
