"""The packets of the family: data on UDP port 2368, in three forms, and position on port 8308, the
same from all models.

Source: velodyne_decoder (types.h, telemetry_packet.h) and ros-drivers/velodyne, which cite the
vendor's user manuals; the leading zeros and inertial readings of position packets: VeloView's
position reader.
"""

from __future__ import annotations

import datetime
import re
from typing import Any

import numpy as np
from construct import (
    Array,
    Bytes,
    Const,
    Construct,
    Int8ul,
    Int16sl,
    Int16ub,
    Int16ul,
    Int32ul,
    Struct,
)

from lidarspec.spec import Fields, Frame, Scaled, Simulation

BLOCKS = 12
SLOTS = 32
STRONGEST = 0x37
DUAL = 0x39
VLP32C_PRODUCT = 0x28
VLS128_PRODUCT = 0xA1  # product bytes
HOUR = 3600.0  # seconds after which the clock starts again
TURN = (5.0, 20.0)  # turns a second, slowest and fastest (data sheets)
POSITIONS = 144  # position packets a second, about
NMEA = 128  # bytes that a sentence may have (velodyne_decoder)

#: flags of the blocks of a VLS-128, by the bank of 32 lasers (velodyne_decoder, LaserBankId).
BANKS = np.array([0xFFEE, 0xFFDD, 0xFFCC, 0xFFBB])[:, None]


def packet(
    flag: Construct, unit: float, mode: Construct, product: Construct, *, blocks: int = BLOCKS
) -> Struct:
    """Return the struct of a data packet with `blocks` blocks of points.

    Distances are in steps of `unit` metres.
    """
    channel = Struct(
        "distance" / Scaled(Int16ul, unit, "m") * "0: no return",
        "intensity" / Int8ul * "calibrated reflectivity: up to 100 diffuse, above retroreflective",
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


MODE = Int8ul * "0x37 strongest, 0x38 last, 0x39 dual; not set by HDL-32E firmware before 2.2.20"
BANK = Int16ub * "0xFFEE lasers 1 to 32, 0xFFDD 33 to 64, 0xFFCC 65 to 96, 0xFFBB 97 to 128"
PRODUCT = Int8ul * (
    "0x21 HDL-32E, 0x22 VLP-16, 0x24 Puck Hi-Res; unreliable: VLP-16 with old firmware sends 0x21"
)

POSITION = Struct(
    "zeros" / Const(bytes(14)),
    "inertial"
    / Array(
        3,
        Struct(
            "gyro"
            / Int16ul
            * "HDL-32E: signed, in the low 12 bits; 0.09766 deg/s; the VLP-16 sends 0",
            "temperature" / Scaled(Int16ul, 1, "") * "as gyro; 0.1453 degC, from 25 degC",
            "accel_x" / Int16ul * "as gyro; 0.001221 g",
            "accel_y" / Int16ul * "as gyro; 0.001221 g",
        ),
    ),
    "reserved" / Bytes(149),
    "top_board_temperature"
    / Scaled(Int8ul, 1, "degC")
    * "all readings except time, PPS and NMEA require firmware since 2018",
    "bottom_board_temperature" / Scaled(Int8ul, 1, "degC"),
    "adc_temperature" / Scaled(Int8ul, 1, "degC") * "at the last calibration of the ADC",
    "adc_temperature_change" / Scaled(Int16sl, 1, "degC") * "change since the last calibration",
    "adc_age" / Scaled(Int32ul, 1, "s") * "time since the last calibration",
    "adc_reason" / Int8ul * "0 none, 1 power-on, 2 manual, 3 temperature, 4 periodic",
    "adc_status" / Int8ul * "bit 0 calibrating, 1 temperature limit met, 2 time limit met",
    "timestamp" / Scaled(Int32ul, 1e-6, "s") * "time since the full hour",
    "pps" / Int8ul * "0 absent, 1 synchronizing, 2 locked, 3 error",
    "thermal_status" / Int8ul * "0 ok, 1 shut down",
    "shutdown_temperature" / Scaled(Int8ul, 1, "degC") * "at the last thermal shutdown",
    "power_up_temperature" / Scaled(Int8ul, 1, "degC"),
    "nmea"
    / Bytes(NMEA)
    * "GPRMC or GPGGA sentence, padded with zeros; all 0 without a GPS receiver",
    "unused" / Bytes(178),
)


def plausible(f: Fields) -> Any:
    """Azimuths of at most a whole turn (documented to 359.99 degrees; old firmware sends 360.00),
    and none of a VLP-32C's packets.
    """
    return (f.blocks.azimuth <= 360) & (f.product != VLP32C_PRODUCT)


def plausible_turn(f: Fields) -> Any:
    """Azimuths of at most a whole turn."""
    return f.blocks.azimuth <= 360


def plausible_single(f: Fields) -> Any:
    """Four banks in a row, three times, and no dual return."""
    return (
        (f.blocks.azimuth <= 360)
        & (f.blocks.flag == np.tile(BANKS, (3, 1)))
        & (f.return_mode != DUAL)
    )


def plausible_dual(f: Fields) -> Any:
    """Return each of the four banks twice."""
    return (f.blocks.azimuth <= 360) & (f.blocks.flag == np.repeat(BANKS, 2, axis=0))


def plausible_position(f: Fields) -> Any:
    """Known states of the PPS, and text where the NMEA sentence stands: a stretch of a data packet
    has flags there.
    """
    return (f.pps <= 3) & ((f.nmea == 0) | ((f.nmea >= 9) & (f.nmea < 127)))


#: time, that it is valid, and date of a sentence; what stands in between is the position and the
#: movement.
_RMC = re.compile(rb"\$G[A-Z]RMC,(\d{6})(?:\.\d*)?,A,(?:[^,]*,){6}(\d{6})[,*]")
LOCKED = 2  # state of the PPS


def nmea_seconds(f: Fields) -> Any:
    """Seconds since 1970 of each NMEA sentence; nan of one that is not valid, or while no PPS holds
    the clock to it.
    """
    locked = np.asarray(f.pps).reshape(-1) == LOCKED
    found = np.full(len(locked), np.nan)
    sentences = np.asarray(f.nmea).astype(np.uint8)
    for row in np.flatnonzero(locked).tolist():
        found[row] = _seconds(sentences[row].tobytes())
        if found[row] > 0:
            break  # the first one is enough
    return found


def _seconds(nmea: bytes) -> float:
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


def sweep_position(i: int) -> dict[str, Any]:
    """Position packet i of a sensor that was switched on at the beginning of 2024, with a GPS
    receiver that knows the time alone.
    """
    moment = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC) + datetime.timedelta(
        seconds=i // POSITIONS
    )
    text = moment.strftime("GPRMC,%H%M%S,A,,,,,,,%d%m%y,,,A").encode()
    sentence = b"$%s*%02X\r\n" % (text, np.bitwise_xor.reduce(np.frombuffer(text, np.uint8)))
    return {
        "timestamp": i / POSITIONS % HOUR,
        "pps": LOCKED,
        "nmea": np.frombuffer(sentence.ljust(NMEA, b"\0"), np.uint8),
    }


POSITION_FRAME = Frame(
    POSITION,
    plausible=plausible_position,
    simulation=Simulation(sweep_position, rate=POSITIONS),
)
FLAG = Const(b"\xff\xee")
PUCK_FRAMES = {
    "data": Frame(packet(FLAG, 0.002, MODE, PRODUCT), data=True, plausible=plausible),
    "position": POSITION_FRAME,
}
VLP32C_FRAMES = {
    "data": Frame(
        packet(FLAG, 0.004, MODE, Const(VLP32C_PRODUCT, Int8ul) * "0x28 VLP-32C"),
        data=True,
        plausible=plausible_turn,
    ),
    "position": POSITION_FRAME,
}
