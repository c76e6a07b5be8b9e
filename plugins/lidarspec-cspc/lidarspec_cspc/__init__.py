"""CSPC M1C1_Mini (two versions), COIN-D4, COIN-D4A and COIN-D6: 360 degree lidars.

The host starts the lidars over a UART. The lidars measure by triangulation or by time of flight.

Source: CSPC M1C1_Mini development manual, sections 1 and 2. Facts that the manual lacks come from
the vendor's SDK (ros_cspc_lidar_coin_d4a, sdk/lidar_information.h), the manual's edition v1.1
(2020-01-22), or captures of a COIN-D4 and a COIN-D6.

Known errors of the manual: The printed sum of the device information, 0x0402, should be 0x0403, as
in v1.1. In the angle example, the corrections 10.9442 and 11.8653 degrees should be 10.9445 and
11.8674 (at 1000 and 8000 mm), and 71.1718 should be 71.171875.

Known gaps of the manual: The manual does not say how the bytes of a packet are grouped into the
words of the checksum; the grouping in this module fits every captured packet. The baud rate is
missing. There is no rule for packets that cross 360 degrees or have one sample. A COIN-D4 sends the
fillers FE, FF and FA FA, which no manual mentions.

The facts about the COIN-D4A come from the vendor's driver, and the facts about the COIN-D6 from
published captures. Both models are assumed to report their names. The M1C1_Mini of the manual's
edition v1.1 is a separate sensor. The M1CT_Coin_Plus, which sends Camsense's packets, is left out.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Literal

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    ByteSwapped,
    Computed,
    Const,
    Construct,
    Enum,
    Int8ul,
    Int16ul,
    Struct,
    this,
)

from lidarspec.spec import (
    Checksummed,
    Command,
    Fields,
    Frame,
    OnFlag,
    Polar,
    Relative,
    Reported,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    Sum,
    WordXor,
    Xor,
    hookimpl,
    last,
    spread,
)

#: 360 degrees divided by 0.9473 degrees, the step of the manual's angle example.
POINTS_PER_TURN = 380
SAMPLES_PER_PACKET = 25  # of a full packet (the manual's angle example)
CUSTOMER_FIRMWARE = 4  # simulated number; the manual gives no example
CLOCKWISE = 0  # value of `direction` (manual 2.2.2, byte 15)
SPEED_SETTLING_S = 1.0  # the manual has "less than 3" (1b)
LOW_EXPOSURE = 2  # value of `exposure` (manual 2.2.3, Exp_M)
HIGH_EXPOSURE = 1
LOW_SPEED_HZ = 5.5  # the two speeds (manual 1c)
HIGH_SPEED_HZ = 7.0
# The exposure changes after three revolutions below 6 or above 6.5 Hz (manual 2.2.3)
LOW_EXPOSURE_BELOW_HZ = 6.0
HIGH_EXPOSURE_ABOVE_HZ = 6.5
TURNS_BEFORE_EXPOSURE = 3

#: Codes of commands (manual 2.1.3); FC is from the SDK.
MODES = {"start": 0xF0, "low_exposure": 0xF1, "high_exposure": 0xF2, "stop": 0xF5, "version": 0xFC}
EXPOSURES = {"high": HIGH_EXPOSURE, "low": LOW_EXPOSURE}

COMMAND = Checksummed(
    Struct(
        "header" / Const(b"\xaa\x55"),
        "mode" / Enum(Int8ul, **MODES),
        "checksum" / Int8ul,
    ),
    field="checksum",
    algorithm=Xor(),
)


def make_ack(header: bytes) -> Checksummed:
    """Return the struct of the reply that acknowledges a command."""
    return Checksummed(
        Struct(
            "header" / Const(header),
            "mode"
            / Enum(Int8ul, **{name: mode ^ 0xA0 for name, mode in MODES.items()})
            * "mode of the command, XORed with A0",
            "length" / Const(7, Int8ul) * "number of bytes in `firmware` and `reserved`",
            "firmware"
            / Int8ul
            * "firmware version in the reply to the command start; 3 means V3.0",
            "reserved" / Bytes(6),
            "checksum" / Int8ul,
        ),
        field="checksum",
        algorithm=Xor(),
    )


INFO = Checksummed(
    Struct(
        "header" / Const(b"\xa5\x5a"),
        "length" / Const(20, Int16ul) * "number of data bytes after the type",
        "sum" / Int16ul,
        "type" / Const(0x01, Int8ul) * "device information",
        "model" / Bytes(12) * "ASCII, terminated by 00",
        "zero_angle"
        / Scaled(Int16ul, 1, "deg")
        * "clockwise angle from the mark on the housing to the zero direction of the data",
        "direction" / Enum(Int8ul, clockwise=0),
        "correction" / Int8ul * "1: the host must correct the angles",
        "reserved" / Bytes(3),
        "revision" / Int8ul * "software revision",
    ),
    field="sum",
    algorithm=Sum(16),
)

SCAN_START = Checksummed(
    Struct(
        "header" / Const(b"\xa5\x5a"),
        "length" / Const(0, Int16ul) * "0: point packets follow until the command stop",
        "sum" / Int16ul,
        "type" / Const(0x81, Int8ul) * "start of scan data",
    ),
    field="sum",
    algorithm=Sum(16),
)


AUXILIARY = Checksummed(
    Struct(
        "header" / Const(b"\xa5\x5a\x04\x00\xfe"),
        "checksum" / Int8ul,
        "type" / Const(0x06, Int8ul),
        "value" / Int8ul * "values 38 to 3F observed; meaning unknown",
        "reserved" / Const(bytes(3)),
    ),
    field="checksum",
    algorithm=Xor(),
)


def make_angle() -> Construct:
    """Return the struct of the first or the last angle of a packet (FSA or LSA).

    Source: manual 2.2.3.
    """
    return ByteSwapped(
        BitStruct(
            "angle" / Scaled(BitsInteger(15), 1 / 64, "deg"), "check" / Const(1, BitsInteger(1))
        )
    )


START = "start" / BitsInteger(1) * "1: start packet, a revolution begins"


def make_data(
    first: tuple[Construct, ...], sample: Construct, groups: tuple[int, ...]
) -> Checksummed:
    """Return the struct of a point packet.

    Args:
        first: the fields of the first byte, M&T.
        groups: the sizes in bytes of the words into which the checksum divides a sample.
    """
    return Checksummed(
        Struct(
            "header" / Const(b"\xaa\x55"),
            *first,
            "lsn" / Int8ul * "number of samples",
            "fsa" / make_angle() * "angle of the first sample",
            "lsa" / make_angle() * "angle of the last sample",
            "cs" / Int16ul,
            "samples" / Array(this.lsn, sample),
        ),
        field="cs",
        algorithm=WordXor(head=8, groups=groups),
    )


DISTANCE = "distance" / Scaled(BitsInteger(14), 0.001, "m") * "0: no return"
M_AND_T: tuple[Construct, ...] = (
    "mt"
    / BitStruct(
        "m"
        / BitsInteger(7)
        * "in a start packet: scan rate in 0.1 Hz; in the next packet: customer firmware; else 0",
        START,
    ),
    "frequency" / Computed(this.mt.m * this.mt.start / 10) * "scans per second; 0 if unknown",
)
DATA = make_data(
    M_AND_T,
    ByteSwapped(
        BitStruct(
            DISTANCE, "intensity" / BitsInteger(8), "exposure" / Enum(BitsInteger(2), **EXPOSURES)
        )
    ),
    (1, 2),
)
OLDER_DATA = make_data(
    ("mt" / BitStruct("reserved" / BitsInteger(7), START),),
    ByteSwapped(BitStruct(DISTANCE, "flags" / BitsInteger(2) * "meaning unknown")),
    (2,),
)


def is_ack_plausible(f: Fields) -> Any:
    """Return whether the mode is that of a reply: 50 to 5F.

    Source: manual 2.1.3 and SDK.
    """
    return (f.mode >= 0x50) & (f.mode <= 0x5F)


def plausible(f: Fields) -> Any:
    """Return whether angles are below 360 degrees and the sample count fits.

    Source: manual 2.2.3, M&T.
    """
    return (
        (f.fsa.angle < 360)
        & (f.lsa.angle < 360)
        & (f.lsn >= 1)
        & ((f.mt.start == 0) | (f.lsn == 1))
    )


def correction(distance: Any) -> Any:
    """Return the angle correction in degrees; 0 if there is no return.

    `distance` is in metres. Source: manual 2.2.3, AngCorrect.
    """
    mm = np.maximum(distance * 1000, 1)
    return np.where(distance > 0, np.rad2deg(np.arctan(19.16 * (mm - 90.15) / (90.15 * mm))), 0)


def directions(f: Fields, zero: str) -> tuple[Any, Any]:
    """Return the angles of the samples in degrees, uncorrected and corrected.

    Corrected angles are relative to the direction that `zero` selects (manual 2.2.3).
    """
    raw = spread(f.fsa.angle, f.lsa.angle, f.lsn, full=360.0)  # degrees, (n, LSN)
    corrected = raw - np.where(f.state.info.correction == 1, correction(f.samples.distance), 0)
    clockwise = np.where(f.state.info.direction == CLOCKWISE, corrected, -corrected)
    return raw, clockwise + f.state.info.zero_angle if zero == "housing" else clockwise


def points(f: Fields, zero: str = "data", has_exposure: bool = False) -> Polar:
    """Return the points of a packet.

    Args:
        has_exposure: whether to add the column `exposure`.
    """
    raw, clockwise = directions(f, zero)
    rate_hz = last(f.mt.m / 10, where=(f.mt.start == 1) & (f.mt.m > 0))
    return Polar(
        range=f.samples.distance,
        azimuth=-np.deg2rad(clockwise),  # clockwise (manual, section 1a)
        intensity=f.samples.intensity,
        time=np.nan_to_num((raw - f.fsa.angle) / (rate_hz * 360)),
        extra={"exposure": f.samples.exposure} if has_exposure else {},
    )


def older_points(f: Fields, zero: str = "data") -> Polar:
    """Return the points of a packet of the M1C1_Mini v1.1, all at the packet's time."""
    return Polar(range=f.samples.distance, azimuth=-np.deg2rad(directions(f, zero)[1]))


def configure(
    points: Callable[..., Polar],
    sensor: Sensor,
    /,
    *,
    zero: Literal["data", "housing"] = "data",
) -> Sensor:
    """Return a sensor with angles from the zero direction of the data or the housing.

    On an M1C1_Mini, the zero direction of the data is 12 degrees clockwise from the mark on the
    housing (manual 2.2.2, bytes 13 and 14; edition v1.1, page 4).
    """
    return dataclasses.replace(sensor, points=partial(points, zero=zero))


@dataclasses.dataclass(frozen=True)
class RotationSweep:
    """The simulated values of each packet, while the sensor turns at one speed.

    Attributes:
        hertz: revolutions per second.
        steps: points per revolution.
        previous_values: the values of the packets that complete the previous revolution, which has
            another speed.
        exposure_follows_speed: whether the exposure follows the speed, as on an M1C1_Mini.
    """

    hertz: float = LOW_SPEED_HZ
    steps: int = POINTS_PER_TURN
    exposure: int = HIGH_EXPOSURE  # after power-on (manual 2.2.3, Exp_M)
    previous_values: tuple[dict[str, float], ...] = ()
    firmware: int = 0
    exposure_follows_speed: bool = True

    @property
    def packets(self) -> int:
        """The number of packets in a revolution."""
        return 1 + -(-(self.steps - 1) // SAMPLES_PER_PACKET)

    def __call__(self, i: int) -> dict[str, float]:
        """Return the values of packet i."""
        if i < len(self.previous_values):
            return self.previous_values[i]
        packet = (i - len(self.previous_values)) % self.packets
        first = 0 if packet == 0 else 1 + (packet - 1) * SAMPLES_PER_PACKET
        samples = 1 if packet == 0 else min(SAMPLES_PER_PACKET, self.steps - first)
        state = {0: round(self.hertz * 10), 1: self.firmware}
        return {
            "mt.m": state.get(packet, 0),
            "mt.start": int(packet == 0),
            "lsn": samples,
            "fsa.angle": first * 360 / self.steps,
            "lsa.angle": (first + samples - 1) * 360 / self.steps,
            "samples.exposure": self.find_exposure(i),
        }

    def find_exposure(self, i: int) -> int:
        """Return the exposure of packet i."""
        turns = (i - len(self.previous_values)) // self.packets
        if turns < TURNS_BEFORE_EXPOSURE or not self.exposure_follows_speed:
            return self.exposure
        if self.hertz < LOW_EXPOSURE_BELOW_HZ:
            return LOW_EXPOSURE
        if self.hertz > HIGH_EXPOSURE_ABOVE_HZ:
            return HIGH_EXPOSURE
        return self.exposure


def change_speed(sweep: RotationSweep, i: int, hertz: float) -> RotationSweep:
    """Return a sweep that has a new speed from the next start packet on.

    Args:
        hertz: the new revolutions per second. The points per second do not change.
    """
    values = map(sweep, itertools.count(i))
    previous_values = tuple(itertools.takewhile(lambda packet: not packet["mt.start"], values))
    return dataclasses.replace(
        sweep,
        hertz=hertz,
        steps=round(sweep.hertz * sweep.steps / hertz),
        exposure=sweep.find_exposure(i),
        previous_values=previous_values,
    )


def older_sweep(i: int) -> dict[str, float]:
    """Return the simulated values of packet i of the M1C1_Mini v1.1."""
    return {
        name: value
        for name, value in RotationSweep()(i).items()
        if name not in ("mt.m", "samples.exposure")
    }


def make_request(mode: str, **more: Any) -> Command:
    """Return a command that sets a mode, and waits for the acknowledgement of this mode.

    The byte of the mode in the acknowledgement is the byte in the command, XORed with A0. Both
    bytes are decoded to the same name.
    """
    return Command(
        "command", {"mode": mode}, reply="ack", matches={"mode": mode}, retries=1, **more
    )


def make_start_packets(
    firmware: int, model: bytes, revision: int, *noise: bytes
) -> tuple[Any, ...]:
    """Return the simulated replies to the start command.

    Source: manual 1b, 2.1.3 and 2.2.
    """
    return (
        ("ack", {"firmware": firmware}),
        SPEED_SETTLING_S,
        *noise,
        ("info", {"model": model, "revision": revision}),
        "scan_start",
    )


def has_customer_firmware(f: Fields) -> Any:
    """Return whether `mt.m` of a packet can be the customer firmware.

    It cannot if it is 0, or if the packet is a start packet: `mt.m` is then the scan rate. Source:
    manual 2.2.3, M&T.
    """
    return (f.mt.start == 0) & (f.mt.m > 0)


def contradicts_firmware(f: Fields) -> Any:
    """Return whether a CSPC sensor cannot have sent the value `mt.m` of a packet.

    `mt.m` is the scan rate in a start packet, the customer firmware or 0 in the packet directly
    after a start packet, and 0 in every other packet. The result for the first packet is False,
    because the packet before it is unknown.
    """
    begins = np.asarray(f.mt.start == 1)
    values = np.asarray(f.mt.m)
    follows_start = np.concatenate([np.zeros_like(begins[:1]), begins[:-1]])
    firmware = values[follows_start][:1].sum()  # 0 if no packet follows a start packet
    is_firmware = follows_start & (values == firmware)
    is_known = np.arange(len(values)) > 0
    return np.asarray(has_customer_firmware(f)) & is_known & ~is_firmware


def reports_firmware(f: Fields) -> Any:
    """Return whether an acknowledgement contains the firmware.

    Source: manual 2.1.3; SDK for 5C.
    """
    return ((f.mode == 0x50) | (f.mode == 0x5C)) & (f.firmware > 0)


# YDLIDAR sends the same packet with other meanings of the sample bits (YDLIDAR SDK, communication
# protocol)
TMINI_RELATIVE = Relative(
    "bits 1 to 7 of the third byte contain values other than the firmware number",
    contradicts_firmware,
)
YDLIDAR_RELATIVES: dict[str, str | Relative] = {
    **dict.fromkeys(
        ("ydlidar-g2", "ydlidar-g4b", "ydlidar-s4b"), "the models reply differently to requests"
    ),
    **dict.fromkeys(("ydlidar-tmini", "ydlidar-tmini-pro", "ydlidar-tmini-plus"), TMINI_RELATIVE),
}

COINS = ("cspc-coin-d4", "cspc-coin-d4a", "cspc-coin-d6")
VERSION = (("ack", {"firmware": 3}),)

#: The version of the acknowledgement, 3 for V3.0, and the revision of the device information, 4 for
#: Rev 4 (manual 2.1.3 and 2.2.2).
INFO_FACTS: dict[str, str | Reported] = {
    "model": "info.model",
    "firmware": Reported("ack.firmware", where=reports_firmware, text="V{}.0".format),
    "revision": Reported("info.revision", text="Rev {}".format),
}

M1C1_MINI = Sensor(
    "cspc-m1c1-mini",
    vendor="CSPC",
    model="M1C1_Mini",
    frames={
        "ack": Frame(make_ack(b"\xa5\x5a"), plausible=is_ack_plausible),
        "info": Frame(INFO),
        "scan_start": Frame(SCAN_START),
        "data": Frame(DATA, data=True, max_length=10 + 3 * 255, plausible=plausible),
        "command": Frame(COMMAND, direction="out"),
    },
    points=partial(points, has_exposure=True),
    scan=OnFlag("mt.start"),
    # 150 000 for this 3-byte format and DTR low: the SDK; 115 200: v1.1, for the 2-byte format
    links={"data": Serial(150_000, 115_200, dtr=False)},
    commands={
        "start": make_request("start", starts=True),
        "stop": make_request("stop", stops=True),
        "low_exposure": Command("command", {"mode": "low_exposure"}),
        "high_exposure": Command("command", {"mode": "high_exposure"}),
        "get_version": make_request("version"),
    },
    fillers=b"\xfe\xff",
    # the device information printed in the manual, 2.2.2
    state={"info": {"correction": 1, "zero_angle": 12, "direction": CLOCKWISE}},
    # The commands of the exposure probably set the speed, which the exposure follows: the SDK gives
    # both pairs of names to the same bytes
    simulation=Simulation(
        RotationSweep(firmware=CUSTOMER_FIRMWARE),
        answers={"start": make_start_packets(3, b"M1C1_Mini", 4), "get_version": VERSION},
        effects={
            "low_exposure": partial(change_speed, hertz=LOW_SPEED_HZ),
            "high_exposure": partial(change_speed, hertz=HIGH_SPEED_HZ),
        },
    ),
    configure=partial(configure, partial(points, has_exposure=True)),
    on_open=("start",),
    on_close=("stop",),
    range_limits=(0.001, 16.383),  # the limits of the field; the manual gives none
    vendor_axes=("forward", "right", "up"),
    turn=(LOW_SPEED_HZ, HIGH_SPEED_HZ),  # manual 1c
    relatives={**dict.fromkeys(COINS, "info.model"), **YDLIDAR_RELATIVES},
    info={
        **INFO_FACTS,
        "customer_firmware": Reported("data.mt.m", where=has_customer_firmware),
    },
    status="vectors",
    source=(
        "CSPC M1C1_Mini development manual (3-byte samples), sections 1 and 2; vendor's SDK (baud"
        " rate, command FC)"
    ),
)


# YDLIDAR models with two bytes a sample, as in v1.1. An M1C1_Mini sends its model after the start
# command, and never sends its speed.
TWO_BYTE_MODELS = (
    "f4 g1 g2a g2c g4 g4-pro g4c g5 g6 g7 s2 s4 tg15 tg30 tg50 tx20 tx8 x2 x3 x4 x4-pro"
)
SPEED_RELATIVE = Relative(
    "start packets contain the speed",
    lambda f: np.asarray((f.mt.start == 1) & (f.mt.reserved > 0)).any(),
)
M1C1_MINI_V11 = Sensor(
    "cspc-m1c1-mini-v11",
    vendor="CSPC",
    model="M1C1_Mini",
    frames={
        "ack": Frame(make_ack(b"\xaa\x55"), plausible=is_ack_plausible),
        "info": M1C1_MINI.frames["info"],
        "scan_start": M1C1_MINI.frames["scan_start"],
        "data": Frame(OLDER_DATA, data=True, max_length=10 + 2 * 255, plausible=plausible),
        "command": M1C1_MINI.frames["command"],
    },
    points=older_points,
    scan=OnFlag("mt.start"),
    links={"data": Serial(115_200, dtr=False)},
    commands={name: M1C1_MINI.commands[name] for name in ("start", "stop")},
    fillers=M1C1_MINI.fillers,
    state=M1C1_MINI.state,
    simulation=Simulation(older_sweep, answers={"start": make_start_packets(0, b"M1C1_Mini", 4)}),
    configure=partial(configure, older_points),
    on_open=("start",),
    on_close=("stop",),
    range_limits=M1C1_MINI.range_limits,
    vendor_axes=M1C1_MINI.vendor_axes,
    relatives={f"ydlidar-{name}": SPEED_RELATIVE for name in TWO_BYTE_MODELS.split()},
    info=INFO_FACTS,
    status="vectors",
    source=(
        "CSPC M1C1_Mini development manual v1.1 (2020-01-22), sections 1 and 2; baud rate and DTR"
        " from the vendor's SDK"
    ),
)


def make_coin(model: str, **facts: Any) -> Sensor:
    """Return a sensor of the COIN series, which measures by time of flight.

    `facts` are the arguments of `Sensor` that this model changes.
    """
    name = f"cspc-{model.lower()}"
    return dataclasses.replace(
        M1C1_MINI,
        id=name,
        model=model,
        points=points,
        configure=partial(configure, points),
        links={"data": Serial(230_400, dtr=False)},
        # the device information of a live COIN-D4
        state={"info": {"correction": 0, "zero_angle": 0, "direction": CLOCKWISE}},
        relatives={
            **dict.fromkeys({"cspc-m1c1-mini", *COINS} - {name}, "info.model"),
            **YDLIDAR_RELATIVES,
        },
        # turn: the manual's two speeds apply to the M1C1_Mini only
        **{"turn": None, "simulation": make_coin_simulation(model), **facts},
    )


def make_coin_simulation(model: str, **turns: Any) -> Simulation:
    """Return a simulated COIN, which sends its model after the start command.

    `turns` are arguments of `RotationSweep`.
    """
    answers = {
        "start": make_start_packets(1, model.encode(), 1, b"\xfa\xfa"),
        "get_version": VERSION,
    }
    sweep = RotationSweep(exposure=LOW_EXPOSURE, exposure_follows_speed=False, **turns)
    return Simulation(sweep, answers=answers)


COIN_D4 = make_coin(
    "COIN-D4",
    status="capture",
    source=("M1C1_Mini manual; baud rate from the vendor's SDK; captured start-up of a COIN-D4"),
)
COIN_D4A = make_coin(
    "COIN-D4A",
    range_limits=(0.001, 12.0),
    status="manual",
    source="vendor's driver, ros_cspc_lidar_coin_d4a: baud rate, 12 m",
)
COIN_D6 = make_coin(
    "COIN-D6",
    frames={
        **M1C1_MINI.frames,
        "auxiliary": Frame(
            AUXILIARY, simulation=Simulation(lambda i: {"value": 0x38 + i % 8}, rate=1 / 3)
        ),
    },
    simulation=make_coin_simulation("COIN-D6", steps=400, hertz=10.0),
    status="manual",
    source=(
        "vendor's SDK (baud rate); published observations of a COIN-D6 (speed, points,"
        " auxiliary frame)"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the CSPC sensors."""
    return [M1C1_MINI, M1C1_MINI_V11, COIN_D4, COIN_D4A, COIN_D6]
