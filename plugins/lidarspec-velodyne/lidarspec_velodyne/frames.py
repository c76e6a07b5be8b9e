"""The packets of the family: data in three layouts, and position packets.

Data packets are sent to UDP port 2368, and position packets to port 8308. Position packets are the
same for all models.

Source: velodyne_decoder (types.h, telemetry_packet.h) and ros-drivers/velodyne, which cite the
vendor's user manuals; VeloView's position reader (the zeros and the inertial measurements at the
start of position packets).
"""

from __future__ import annotations

import datetime
import re
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    Construct,
    Enum,
    Int8ul,
    Int16sl,
    Int16ub,
    Int16ul,
    Int32ul,
    Struct,
)

from lidarspec.spec import ClockState, ClockStatus, Fields, Frame, Scaled, Simulation

BLOCKS = 12
SLOTS = 32
STRONGEST = 0x37
DUAL = 0x39
# product bytes
VLP32C_PRODUCT = 0x28
VLS128_PRODUCT = 0xA1
CLOCK_WRAP_S = 3600.0
SPEED_LIMITS_HZ = (5.0, 20.0)  # lowest and highest revolutions per second (data sheets)
POSITION_RATE_HZ = 144  # position packets per second, approximately
NMEA_BYTES = 128  # maximum of a sentence (velodyne_decoder)

#: Flags of the blocks of a VLS-128, by the bank of 32 lasers (velodyne_decoder, LaserBankId).
BANKS = np.array([0xFFEE, 0xFFDD, 0xFFCC, 0xFFBB])[:, None]


def make_packet(
    flag: Construct, unit: float, mode: Construct, product: Construct, *, blocks: int = BLOCKS
) -> Struct:
    """Return the struct of a data packet with `blocks` blocks of points.

    Distances are in steps of `unit` metres.
    """
    channel = Struct(
        "distance" / Scaled(Int16ul, unit, "m") * "0: no return",
        "intensity"
        / Int8ul
        * "calibrated reflectivity; 0 to 100: a diffuse target; above 100: a retroreflector",
    )
    block = Struct(
        "flag" / flag,
        "azimuth"
        / Scaled(Int16ul, 0.01, "deg")
        * "clockwise from the forward axis, at the first firing of the block",
        "channels" / Array(SLOTS, channel),
    )
    empty: list[Construct] = ["empty" / Bytes((BLOCKS - blocks) * 100)] if blocks < BLOCKS else []
    return Struct(
        "blocks" / Array(blocks, block),
        *empty,
        "timestamp" / Scaled(Int32ul, 1e-6, "s") * "time of the first firing, since the full hour",
        "return_mode" / mode,
        "product" / product,
    )


MODE_CODES = {"strongest": STRONGEST, "last": 0x38, "dual": DUAL}
MODE = Enum(Int8ul, **MODE_CODES) * "not set by HDL-32E firmware before 2.2.20"
BANK_CODES = {
    "lasers_1_to_32": 0xFFEE,
    "lasers_33_to_64": 0xFFDD,
    "lasers_65_to_96": 0xFFCC,
    "lasers_97_to_128": 0xFFBB,
}
BANK = Enum(Int16ub, **BANK_CODES)
PRODUCT_CODES = {"HDL-32E": 0x21, "VLP-16": 0x22, "Puck Hi-Res": 0x24}
PRODUCT = Enum(Int8ul, **PRODUCT_CODES) * "not reliable: a VLP-16 with old firmware sends 0x21, too"

POSITION = Struct(
    "zeros" / Const(bytes(14)),
    "inertial"
    / Array(
        3,
        Struct(
            "gyro" / Int16ul * "HDL-32E: low 12 bits, signed, in steps of 0.09766 deg/s; VLP-16: 0",
            "temperature"
            / Scaled(Int16ul, 1, "")
            * "HDL-32E: low 12 bits, signed, in steps of 0.1453 degC from 25 degC; VLP-16: 0",
            "accel_x" / Int16ul * "HDL-32E: low 12 bits, signed, in steps of 0.001221 g; VLP-16: 0",
            "accel_y" / Int16ul * "HDL-32E: low 12 bits, signed, in steps of 0.001221 g; VLP-16: 0",
        ),
    ),
    "reserved" / Bytes(149),
    "top_board_temperature"
    / Scaled(Int8ul, 1, "degC")
    * "firmware before 2018 reports only timestamp, pps and nmea",
    "bottom_board_temperature" / Scaled(Int8ul, 1, "degC"),
    "adc_temperature"
    / Scaled(Int8ul, 1, "degC")
    * "temperature at the last calibration of the ADC",
    "adc_temperature_change"
    / Scaled(Int16sl, 1, "degC")
    * "change of the temperature since the last calibration",
    "adc_age" / Scaled(Int32ul, 1, "s") * "time since the last calibration",
    "adc_reason" / Enum(Int8ul, none=0, power_on=1, manual=2, temperature=3, periodic=4),
    "adc_status"
    / BitStruct(
        "reserved" / BitsInteger(5),
        "time_limit_met" / BitsInteger(1),
        "temperature_limit_met" / BitsInteger(1),
        "calibrating" / BitsInteger(1),
    ),
    "timestamp" / Scaled(Int32ul, 1e-6, "s") * "time since the full hour",
    "pps" / Enum(Int8ul, absent=0, synchronizing=1, locked=2, error=3),
    "thermal_status" / Enum(Int8ul, ok=0, shut_down=1),
    "shutdown_temperature" / Scaled(Int8ul, 1, "degC") * "temperature at the last thermal shutdown",
    "power_up_temperature" / Scaled(Int8ul, 1, "degC"),
    "nmea"
    / Bytes(NMEA_BYTES)
    * "GPRMC or GPGGA sentence, padded with zeros; all 0 without a GPS receiver",
    "unused" / Bytes(178),
)


def plausible(f: Fields) -> Any:
    """Return whether azimuths are possible, and the product is not a VLP-32C.

    The distances of a VLP-32C have steps of another size.
    """
    return (f.blocks.azimuth <= 360) & (f.product != VLP32C_PRODUCT)


def is_plausible_vlp32c(f: Fields) -> Any:
    """Return whether azimuths are at most 360 degrees."""
    return f.blocks.azimuth <= 360


def is_plausible_single(f: Fields) -> Any:
    """Return whether a packet can be from a VLS-128 with single return.

    The four banks of 32 lasers are then in consecutive blocks, three times.
    """
    return (
        (f.blocks.azimuth <= 360)
        & (f.blocks.flag == np.tile(BANKS, (3, 1)))
        & (f.return_mode != DUAL)
    )


def is_plausible_dual(f: Fields) -> Any:
    """Return whether a packet can be from a VLS-128 with dual return.

    Each of the four banks of 32 lasers then has two consecutive blocks.
    """
    return (f.blocks.azimuth <= 360) & (f.blocks.flag == np.repeat(BANKS, 2, axis=0))


def is_plausible_position(f: Fields) -> Any:
    """Return whether the PPS state is known and the NMEA sentence is text."""
    return (f.pps <= 3) & ((f.nmea == 0) | ((f.nmea >= 9) & (f.nmea < 127)))


#: Matches the time, the validity and the date of a sentence; position and movement are between
#: them.
_RMC = re.compile(rb"\$G[A-Z]RMC,(\d{6})(?:\.\d*)?,A,(?:[^,]*,){6}(\d{6})[,*]")
PPS_LOCKED = 2
SIMULATED_START_S = 1_704_067_200  # 2024-01-01
#: The state of the clock in position packets (VLP-16 user manual, PPS status). Without a pulse the
#: clock counts from power-up, modulo an hour.
CLOCK_STATUS = ClockStatus(
    "pps",
    {
        0: ClockState("no PPS", False, epoch="boot"),
        1: ClockState("synchronizing to PPS", False, epoch="boot"),
        PPS_LOCKED: ClockState("locked to PPS", True),
        3: ClockState("PPS error", False, epoch="boot"),
    },
    frame="position",
)


def nmea_seconds(f: Fields) -> Any:
    """Return the time in the first valid NMEA sentence of position packets.

    A sentence is valid only if the packet reports that the clock is locked to PPS.

    Returns:
        Seconds since 1970 for the packet with this sentence, nan for all other packets, (n,).
    """
    is_locked = np.asarray(f.pps).reshape(-1) == PPS_LOCKED
    seconds = np.full(len(is_locked), np.nan)
    sentences = np.asarray(f.nmea).astype(np.uint8)
    for row in np.flatnonzero(is_locked).tolist():
        seconds[row] = _parse_nmea(sentences[row].tobytes())
        if seconds[row] > 0:
            break  # the first one is enough
    return seconds


def _parse_nmea(nmea: bytes) -> float:
    sentence = _RMC.match(nmea)
    try:
        if sentence:
            moment = datetime.datetime.strptime(
                (sentence[2] + sentence[1]).decode(), "%d%m%y%H%M%S"
            )
        else:
            moment = None
    except ValueError:
        moment = None
    return moment.replace(tzinfo=datetime.UTC).timestamp() if moment else float("nan")


def make_sentence(seconds: float) -> dict[str, Any]:
    """Return the field `nmea` with a sentence that contains a time, but no position.

    `seconds` is the time in seconds since 1970.
    """
    moment = datetime.datetime.fromtimestamp(int(seconds), datetime.UTC)
    text = moment.strftime("GPRMC,%H%M%S,A,,,,,,,%d%m%y,,,A").encode()
    sentence = b"$%s*%02X\r\n" % (text, np.bitwise_xor.reduce(np.frombuffer(text, np.uint8)))
    return {"nmea": np.frombuffer(sentence.ljust(NMEA_BYTES, b"\0"), np.uint8)}


def sweep_position(i: int) -> dict[str, Any]:
    """Return the values of simulated position packet i."""
    return {
        "timestamp": i / POSITION_RATE_HZ % CLOCK_WRAP_S,
        "pps": PPS_LOCKED,
        **make_sentence(SIMULATED_START_S + i // POSITION_RATE_HZ),
    }


POSITION_FRAME = Frame(
    POSITION,
    plausible=is_plausible_position,
    simulation=Simulation(sweep_position, rate=POSITION_RATE_HZ, date=make_sentence),
)
FLAG = Const(b"\xff\xee")
PUCK_FRAMES = {
    "data": Frame(make_packet(FLAG, 0.002, MODE, PRODUCT), data=True, plausible=plausible),
    "position": POSITION_FRAME,
}
VLP32C_FRAMES = {
    "data": Frame(
        make_packet(FLAG, 0.004, MODE, Const(VLP32C_PRODUCT, Int8ul) * "0x28: VLP-32C"),
        data=True,
        plausible=is_plausible_vlp32c,
    ),
    "position": POSITION_FRAME,
}
