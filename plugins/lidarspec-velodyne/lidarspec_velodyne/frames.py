"""The packets that the VLP-16 and the HDL-32E have in common: data on UDP port 2368, position on port 8308.

Source: velodyne_decoder (types.h, telemetry_packet.h) and ros-drivers/velodyne, which cite the vendor's user manuals;
the leading zeros and inertial readings of position packets: VeloView's position reader.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Int8ul, Int16sl, Int16ul, Int32ul, Struct

from lidarspec.spec import Fields, Frame, Scaled, Simulation

BLOCKS, SLOTS = 12, 32
STRONGEST, DUAL = 0x37, 0x39
HOUR = 3600.0  # seconds after which the clock starts again
TURN = (5.0, 20.0)  # turns a second, slowest and fastest (data sheets)
POSITIONS = 144  # position packets a second, about
NMEA = 128  # bytes that a sentence may have (velodyne_decoder)

DATA = Struct(
    "blocks"
    / Array(
        BLOCKS,
        Struct(
            "flag" / Const(b"\xff\xee"),
            "azimuth" / Scaled(Int16ul, 0.01, "deg") * "clockwise from the forward axis, at the first firing of the block",
            "channels"
            / Array(
                SLOTS,
                Struct(
                    "distance" / Scaled(Int16ul, 0.002, "m") * "0: no return",
                    "intensity" / Int8ul * "calibrated reflectivity: to 100 diffuse, above retroreflecting",
                ),
            ),
        ),
    ),
    "timestamp" / Scaled(Int32ul, 1e-6, "s") * "of the first firing, since the top of the hour",
    "return_mode" / Int8ul * "0x37 strongest, 0x38 last, 0x39 dual; not set by HDL-32E firmware before 2.2.20",
    "product" / Int8ul * "0x21 HDL-32E, 0x22 VLP-16; not to be trusted: VLP-16 with old firmware sends 0x21",
)

POSITION = Struct(
    "zeros" / Const(bytes(14)),
    "inertial"
    / Array(
        3,
        Struct(
            "gyro" / Int16ul * "HDL-32E: signed, in the low 12 bits; 0.09766 deg/s; the VLP-16 sends 0",
            "temperature" / Int16ul * "likewise; 0.1453 degC, from 25 degC",
            "accel_x" / Int16ul * "likewise; 0.001221 g",
            "accel_y" / Int16ul * "likewise; 0.001221 g",
        ),
    ),
    "reserved" / Bytes(149),
    "top_board_temperature" / Scaled(Int8ul, 1, "degC") * "this and the other readings but time, PPS and NMEA: firmware since 2018",
    "bottom_board_temperature" / Scaled(Int8ul, 1, "degC"),
    "adc_temperature" / Scaled(Int8ul, 1, "degC") * "when the ADC was calibrated last",
    "adc_temperature_change" / Scaled(Int16sl, 1, "degC") * "since then",
    "adc_age" / Scaled(Int32ul, 1, "s") * "since then",
    "adc_reason" / Int8ul * "0 none, 1 power-on, 2 manual, 3 temperature, 4 periodic",
    "adc_status" / Int8ul * "bit 0 calibrating, 1 temperature limit met, 2 time limit met",
    "timestamp" / Scaled(Int32ul, 1e-6, "s") * "since the top of the hour",
    "pps" / Int8ul * "0 absent, 1 synchronizing, 2 locked, 3 error",
    "thermal_status" / Int8ul * "0 ok, 1 shut down",
    "shutdown_temperature" / Scaled(Int8ul, 1, "degC") * "at the last thermal shutdown",
    "power_up_temperature" / Scaled(Int8ul, 1, "degC"),
    "nmea" / Bytes(NMEA) * "a GPRMC or GPGGA sentence, filled up with zeros; all 0 without a GPS receiver",
    "unused" / Bytes(178),
)


def plausible(f: Fields) -> Any:
    """Azimuths of at most a whole turn: documented to 359.99 degrees, and a VLP-16 with old firmware sends 360.00."""
    return f.blocks.azimuth <= 360


def plausible_position(f: Fields) -> Any:
    """Known states of the PPS, and text where the NMEA sentence stands: a stretch of a data packet has flags there."""
    return (f.pps <= 3) & ((f.nmea == 0) | ((f.nmea >= 9) & (f.nmea < 127)))


def sweep_position(i: int) -> dict[str, Any]:
    """Position packet i of a sensor without a GPS receiver."""
    return {"timestamp": i / POSITIONS % HOUR, "pps": 0, "nmea": np.zeros(NMEA)}


FRAMES = {
    "data": Frame(DATA, data=True, plausible=plausible),
    "position": Frame(
        POSITION,
        plausible=plausible_position,
        simulation=Simulation(sweep_position, rate=POSITIONS),
        acknowledged={"LS201 inertial.temperature": "signed in the low 12 bits from an HDL-32E, and no number at all from a VLP-16"},
    ),
}
