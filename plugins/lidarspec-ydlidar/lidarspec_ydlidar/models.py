"""The models and their differences.

Source: YDLIDAR SDK, "Dataset" (baud rates, sample rates, ranges and speeds),
core/common/DriverInterface.h (numbers of models); data sheets.
"""

from __future__ import annotations

from dataclasses import dataclass

from lidarspec_ydlidar import samples
from lidarspec_ydlidar.samples import SampleFormat


@dataclass(frozen=True)
class Model:
    """One row of the table of models.

    Attributes:
        rate: samples per second.
        range_limits: the shortest and the longest range, metres.
        turn: the lowest and the highest number of scans per second.
        number: the model number in the device information; 0 if it is not documented.
        is_send_only: whether the model only sends and cannot receive.
        has_state: whether all packets except the first packet of a revolution contain the state of
            the device, in the bits of the scan frequency.
    """

    sample_format: SampleFormat
    baud: int
    rate: float
    range_limits: tuple[float, float]
    turn: tuple[float, float]
    number: int = 0
    is_send_only: bool = False
    has_state: bool = False
    status: str = "manual"


MODELS = {
    "F4": Model(samples.TRIANGLE, 115_200, 4000, (0.12, 12), (5, 12), 1),
    "X2": Model(
        samples.TRIANGLE, 115_200, 3000, (0.1, 8), (4, 8), is_send_only=True, status="vectors"
    ),
    "X3": Model(
        samples.TRIANGLE, 115_200, 3000, (0.1, 8), (4, 8), is_send_only=True, status="vectors"
    ),
    "X4": Model(samples.TRIANGLE, 128_000, 5000, (0.12, 10), (5, 12), 6, status="vectors"),
    "X4 Pro": Model(
        samples.TRIANGLE_FLAGGED,
        128_000,
        5000,
        (0.12, 10),
        (5, 12),
        is_send_only=True,
        has_state=True,
    ),
    "S2": Model(
        samples.TRIANGLE, 115_200, 3000, (0.1, 8), (4, 8), is_send_only=True, status="vectors"
    ),
    "S4": Model(samples.TRIANGLE, 115_200, 4000, (0.1, 8), (5, 12), 4, status="vectors"),
    "S4B": Model(samples.TRIANGLE_8, 153_600, 4000, (0.1, 8), (5, 12), 11),
    "G1": Model(samples.TRIANGLE, 230_400, 9000, (0.28, 16), (5, 12), 19, status="vectors"),
    "G2": Model(samples.TRIANGLE_8, 230_400, 5000, (0.28, 16), (5, 12), 15),
    "G2A": Model(samples.TRIANGLE, 230_400, 5000, (0.12, 12), (5, 12), 14),
    "G2C": Model(samples.TRIANGLE, 115_200, 4000, (0.1, 12), (5, 12), 16),
    "G4": Model(samples.TRIANGLE, 230_400, 9000, (0.1, 16), (5, 12), 5, status="vectors"),
    "G4B": Model(samples.TRIANGLE_10, 512_000, 10_000, (0.12, 16), (5, 12), 17, status="vectors"),
    "G4C": Model(samples.TRIANGLE, 115_200, 4000, (0.1, 12), (5, 12), 18),
    "G4 Pro": Model(samples.TRIANGLE, 230_400, 9000, (0.1, 16), (5, 12), 7),
    "G5": Model(samples.TRIANGLE, 230_400, 9000, (0.1, 16), (5, 12), 20),
    "G6": Model(samples.HALF, 512_000, 18_000, (0.1, 25), (5, 12), 13),
    "G7": Model(samples.HALF, 512_000, 18_000, (0.1, 25), (5, 12), 21),
    "TX8": Model(samples.TOF, 115_200, 4000, (0.1, 8), (4, 8), is_send_only=True),
    "TX20": Model(samples.TOF, 115_200, 4000, (0.1, 20), (4, 8), is_send_only=True),
    "TG15": Model(samples.TOF, 512_000, 20_000, (0.05, 30), (3, 15.7), 100, status="vectors"),
    "TG30": Model(samples.TOF, 512_000, 20_000, (0.05, 30), (3, 15.7), 101),
    "TG50": Model(samples.TOF, 512_000, 20_000, (0.05, 50), (3, 15.7), 102),
    "T-mini": Model(samples.TOF_8, 230_400, 4000, (0.02, 12), (6, 12), 140, has_state=True),
    "T-mini Pro": Model(
        samples.TOF_8, 230_400, 4000, (0.02, 12), (6, 12), 150, has_state=True, status="capture"
    ),
    "T-mini Plus": Model(samples.TOF_8, 230_400, 4000, (0.05, 12), (6, 12), 151, has_state=True),
    "T-mini Plus SH": Model(
        samples.TOF_16, 230_400, 4000, (0.05, 12), (6, 12), 152, has_state=True
    ),
}
