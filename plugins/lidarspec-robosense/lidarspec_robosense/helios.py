"""RoboSense RS-Helios: rotating lidars of 16 and of 32 lasers over UDP.

The angles of a sensor are in its device information (DIFOP).

Source: RS-Helios-16P user manual: 5.4.2 (return modes), 6.2 and Table 9 (MSOP), 6.3 and Table 11
(DIFOP), appendix B.3 to B.13 (registers). From the vendor's rs_driver (decoder_RSHELIOS.hpp,
decoder_RSHELIOS_16P.hpp): coordinates, optical centre, temperature, offset of the horizontal
angles, the times of 32 lasers. From nebula's former decoder: the firing times of the 16P, which
reproduce the azimuths in nebula's published point clouds to the last digit. The manual of another
model, the Helios-1610, was compared with these sources.

The manual has errors. The distance in its example, 320 steps of 0.25 cm, is 0.8 m and not 8 m. In
its examples of angles, the vertical angle 00 05 d6 is 14.94 degrees and not 14.95, and the formula
for the horizontal angle 01 01 96, which is -4.06 degrees, lacks brackets.

The sources disagree in four places. The second part of a time is in microseconds in Table 9 and in
nebula's capture; in appendix B.13 it is in nanoseconds. The type is at byte 30 in rs_driver and in
the capture; in the manual of the Helios-1610 it is at byte 31. The second firing of a 16P is
55.56 us after the first according to the azimuths in the manual; in rs_driver it is 27.68 us. The
firing times of 32 lasers are 1.73 us apart in rs_driver; nebula has other times, up to 48 us. Each
time, this module follows the source that is named first.

Nebula's capture has the name of the 16P, but was recorded with a Helios-5515: its packets have type
6, and its DIFOP has 32 different angles and a return mode that means single return.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from construct import Bytes, Const, Construct, Enum, Int8ub, Int16ub, Int32ub, Struct

from lidarspec.spec import Fields, Frame, PacketCounter, Polar, Relative, Scaled, Sensor, Simulation
from lidarspec_robosense.rotor import (
    COMMON,
    DIFOP_HEAD,
    DIFOP_TAIL,
    DIFOP_TIME,
    DIFOP_UNIT,
    DIFOP_VERSIONS,
    FACTORY_SPEED_HZ,
    SPEED_LIMITS_HZ,
    TEMPERATURE,
    TIME,
    WAVE_MODES,
    RotorModel,
    laser_angles,
    make_angles,
    make_blocks,
    make_clock_status,
    points_of_firings,
    points_of_groups,
    rotation_values,
    sweep_difop,
)

BLOCKS = 12
LASERS = 32
# return modes (manual 5.4.2)
DUAL = WAVE_MODES["dual"]
STRONGEST = WAVE_MODES["strongest"]
FIRING_PERIOD_S = 55.56e-6  # from one firing of all lasers to the next (rs_driver, nebula)
TYPE_5515 = 6
TYPE_1615 = 7  # and 16P
LIDAR_TYPES = {"Helios-5515": TYPE_5515, "Helios-1615 and Helios-16P": TYPE_1615}
#: The microseconds from the start of a firing to each laser of a 16P (nebula's decoder).
TIMES_16P_US = (
    0,
    3.15,
    6.3,
    9.45,
    13.26,
    17.08,
    20.56,
    23.71,
    26.53,
    27.77,
    31.49,
    32.73,
    36.46,
    38.94,
    41.42,
    43.91,
)
#: The elevations in the DIFOP of a captured unit, in steps of a third of a degree.
ELEVATION_5515_DEG = (
    *(15, 13, 11, 9, 7, 5.5, 4, 2.67, 1.33, 0, -1.33, -2.67, -4, -5.33, -6.67, -8),
    *(-10, -16, -13, -19, -22, -28, -25, -31, -34, -37, -40, -43, -46, -49, -52, -55),
)

HELIOS_16P_ROTOR = RotorModel(
    delay=np.array(TIMES_16P_US) * 1e-6,
    period=FIRING_PERIOD_S,
    lens_distance=0.03498,
    # assumed: the topmost laser first, 2 degrees apart over the model's 30 degrees
    vertical=15.0 - 2 * np.arange(16),
)
HELIOS_5515_ROTOR = RotorModel(
    delay=np.arange(LASERS) * 1.73e-6,
    period=FIRING_PERIOD_S,
    lens_distance=0.03498,
    vertical=np.array(ELEVATION_5515_DEG),
)
# assumed: the topmost laser first, 1 degree apart over the model's 31 degrees
HELIOS_32_ROTOR = dataclasses.replace(HELIOS_5515_ROTOR, vertical=15.0 - np.arange(LASERS))


def make_packet_struct(blocks: Construct) -> Struct:
    """Return the struct of a data packet with these blocks."""
    return Struct(
        "header" / Const(b"\x55\xaa\x05\x5a"),
        "protocol_version" / Enum(Int16ub, old=0, latest=1),
        "reserved_6" / Bytes(2),
        "top_packet_count"
        / Bytes(4)
        * "four one-byte counters; in a packet, each counter is 3 higher than the one before it",
        "bottom_packet_count" / Int32ub * "packet counter",
        "reserved_16" / Bytes(1),
        "range_resolution" / Enum(Int8ub, **{"5 mm": 0, "2.5 mm": 1}),
        "angle_pulse_interval" / Scaled(Int16ub, 1e-6, "s"),
        *TIME,
        "lidar_type" / Enum(Int8ub, **LIDAR_TYPES),
        "reserved_31" / Bytes(7),
        "temperature" / TEMPERATURE,
        "reserved_40" / Bytes(2),
        "blocks" / blocks,
        "tail" / Bytes(6) * "reserved bytes, then 00 FF",
    )


#: The fields from byte 313 on (Table 11). A 16P has the angles of 16 lasers, and reserved bytes in
#: place of the angles of lasers 17 to 32.
STATUS: tuple[Construct, ...] = (
    "operating_status" / Bytes(12) * "current and voltages: input, 12 V, 5 V, 2.5 V, APD",
    "reserved_325" / Bytes(17),
    "board_temperatures" / Bytes(10),
    "measured_rpm" / Scaled(Int16ub, 1, "rpm"),
    "faults" / Bytes(6),
    "code_wheel" / Int8ub * "calibration state",
    "pps_trigger" / Int8ub,
    "reserved_362" / Bytes(20),
    "gprmc" / Bytes(86),
)
DIFOP_START = (*DIFOP_HEAD, *DIFOP_VERSIONS, *DIFOP_UNIT, *DIFOP_TIME, *STATUS)
DIFOP_END = ("reserved_660" / Bytes(586), DIFOP_TAIL)
OTHER_LASERS = Bytes(48) * "values of lasers 17 to 32 in other models"
DIFOP_16 = Struct(
    *DIFOP_START,
    "vertical" / make_angles(16),
    "reserved_516" / OTHER_LASERS,
    "horizontal" / make_angles(16),
    "reserved_612" / OTHER_LASERS,
    *DIFOP_END,
)
DIFOP_32 = Struct(
    *DIFOP_START, "vertical" / make_angles(LASERS), "horizontal" / make_angles(LASERS), *DIFOP_END
)


def plausible(f: Fields) -> Any:
    """Return whether azimuths are below 360 degrees (manual 6.2.2.2)."""
    return f.blocks.azimuth < 360


def points_16p(f: Fields) -> Polar:
    """Return the points of blocks with two firings of 16 lasers.

    The ring of a point is the position of its laser in the block.
    """
    polar = points_of_groups(
        f, f.state.difop.return_mode == DUAL, HELIOS_16P_ROTOR, laser_angles(f)
    )
    return dataclasses.replace(polar, range=scale_range(f, polar), ring=np.arange(16))


def points_32(f: Fields, model: RotorModel) -> Polar:
    """Return the points of blocks with one firing."""
    polar = points_of_firings(f, f.state.difop.return_mode == DUAL, model)
    return dataclasses.replace(polar, range=scale_range(f, polar))


def scale_range(f: Fields, polar: Polar) -> Any:
    """Return ranges in metres, scaled by the distance step that the header declares."""
    return polar.range * np.where(f.range_resolution == 0, 2, 1)


def sweep_data(i: int, firings: float, lidar_type: int) -> dict[str, Any]:
    """Return the values of simulated packet i, with `firings` firings per block."""
    counts = {"protocol_version": 1, "bottom_packet_count": i % (1 << 32), "range_resolution": 1}
    return rotation_values(i, BLOCKS, firings * FIRING_PERIOD_S, lidar_type=lidar_type, **counts)


def has_block_pairs(f: Fields) -> Any:
    """Return whether the first two blocks have the same azimuth, as with dual return."""
    return f.blocks[0].azimuth == f.blocks[1].azimuth


def has_equal_halves(f: Fields) -> Any:
    """Return whether the distances in the two halves of the blocks are mostly equal.

    With dual return, the halves of a 16P's block are the two returns of one firing.
    """
    distance = np.asarray(f.blocks.channels.distance)
    first = distance[..., :16]
    second = distance[..., 16:]
    return (first == second).sum(axis=(1, 2)) > ((first != second) | (first == 0)).sum(axis=(1, 2))


DIFOP_SIMULATION = Simulation(partial(sweep_difop, speed="measured_rpm"), rate=1)
DATA_FRAME_32 = Frame(
    make_packet_struct(make_blocks(BLOCKS, LASERS, 0.0025)), data=True, plausible=plausible
)
DIFOP_FRAME_32 = Frame(DIFOP_32, simulation=DIFOP_SIMULATION)
MODEL_5515 = Relative("type 6, Helios-5515", lambda f: f.lidar_type == TYPE_5515)
NOT_5515 = Relative("type other than 6", lambda f: f.lidar_type != TYPE_5515)

HELIOS_16P = Sensor(
    "robosense-helios16p",
    model="RS-Helios-16P",
    frames={
        "data": Frame(
            make_packet_struct(make_blocks(BLOCKS, 16, 0.0025, firings=2)),
            data=True,
            plausible=plausible,
        ),
        "difop": Frame(DIFOP_16, simulation=DIFOP_SIMULATION),
    },  # 600 and 1200 rpm (manual B.1)
    points=points_16p,
    sequence=PacketCounter("bottom_packet_count"),
    state=HELIOS_16P_ROTOR.make_default_state(return_mode=STRONGEST),
    simulation=Simulation(partial(sweep_data, firings=2, lidar_type=TYPE_1615)),
    range_limits=(0.1, 180.0),  # rs_driver's limits for this model
    # firmware: that of the first of three boards in Table 11; no temperature, because its sign is
    # in a separate field
    info={
        "serial": "difop.serial_number",
        "firmware": "difop.top_firmware",
        "model": "data.lidar_type",
    },
    relatives={
        "robosense-helios5515": MODEL_5515,
        "robosense-helios32": Relative(
            "with dual return, the two blocks of a pair have the same azimuth; with single return,"
            " a packet arrives every 0.67 ms",
            has_block_pairs,
        ),
    },
    source=(
        "RS-Helios-16P user manual, 5.4, 6.2, 6.3 and appendix B; rs_driver; capture and"
        " point clouds of nebula"
    ),
    **{
        **COMMON,
        "clock": dataclasses.replace(COMMON["clock"], status=make_clock_status()),
        "turn": (FACTORY_SPEED_HZ, 20.0),
        "status": "capture",
    },
)

HELIOS_32 = dataclasses.replace(
    HELIOS_16P,
    id="robosense-helios32",
    model="RS-Helios-1615",
    frames={"data": DATA_FRAME_32, "difop": DIFOP_FRAME_32},
    points=partial(points_32, model=HELIOS_32_ROTOR),
    state=HELIOS_32_ROTOR.make_default_state(return_mode=STRONGEST),
    simulation=Simulation(partial(sweep_data, firings=1, lidar_type=TYPE_1615)),
    turn=SPEED_LIMITS_HZ,  # 300, 600 and 1200 rpm (Helios 32 product manual)
    relatives={
        "robosense-helios5515": MODEL_5515,
        "robosense-helios16p": Relative(
            "with dual return, the two halves of a block are equal; with single return, a packet"
            " arrives every 1.33 ms",
            has_equal_halves,
        ),
    },
    status="manual",
    source=(
        "rs_driver (decoder_RSHELIOS.hpp); RS-Helios-16P user manual; not tested with packets"
        " of this model"
    ),
)

HELIOS_5515 = dataclasses.replace(
    HELIOS_32,
    id="robosense-helios5515",
    model="RS-Helios-5515",
    points=partial(points_32, model=HELIOS_5515_ROTOR),
    state=HELIOS_5515_ROTOR.make_default_state(return_mode=STRONGEST),
    simulation=Simulation(partial(sweep_data, firings=1, lidar_type=TYPE_5515)),
    relatives={"robosense-helios16p": NOT_5515, "robosense-helios32": NOT_5515},
    status="capture",
    source=(
        "rs_driver (decoder_RSHELIOS.hpp); RS-Helios-16P user manual; capture of this model"
        " from nebula"
    ),
)
