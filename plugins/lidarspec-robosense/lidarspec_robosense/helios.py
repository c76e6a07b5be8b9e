"""RoboSense RS-Helios-16P: rotating lidar of 16 lasers over UDP; its own angles come with the device information (DIFOP).

Source: RS-Helios-16P user manual: 5.4.2 (return modes), 6.2 and Table 9 (MSOP), 6.3 and Table 11 (DIFOP), appendix B.3
to B.13 (registers). From the vendor's rs_driver (decoder_RSHELIOS_16P.hpp): coordinates, optical centre, temperature,
where the horizontal angles stand. From nebula's former decoder of this model: the times of the lasers, by which the
azimuths of the point clouds that it published come out to their last digit.

Known errors and contradictions: the manual's worked distance, 320 steps of 0.25 cm, is printed as 8 m and is 0.8 m; its
vertical angle 00 05 d6, printed as 14.95 degrees, is 14.94, and its horizontal one, 01 01 96, needs brackets (-4.06);
appendix B.13 has nanoseconds in the second part of a time, Table 9 and the capture have microseconds; the manual of the
Helios-1610 has the type at byte 31, rs_driver and the capture at 30. rs_driver gives the second firing 27.68 us after the
first one; the manual's azimuth in between (half the step) and about 100 us from block to block ask for 55.56 us.

The published capture under this model's name says type 6, RS-Helios-5515, and holds 32 lasers: read as 16P, as it was
published, the second half of each block gets directions that its lasers did not have, and the times of a packet run
twice as long as it took. Not expressed: with a field of view set, blocks after the gap are later than a packet's times say.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, BitsInteger, BitStruct, Bytes, BytesInteger, ByteSwapped, Const, Construct, Int8ub, Int16ub, Int32ub, Struct

from lidarspec.spec import Clock, Fields, Frame, OnWrap, Polar, Scaled, Sensor, Sequence, Simulation, Udp, following, previous, wrap

BLOCKS, GROUPS, LASERS = 12, 2, 16
DUAL, STRONGEST = 0, 4  # return modes (manual 5.4.2)
FIRING = 55.56e-6  # seconds from one firing of the 16 lasers to the next (rs_driver, nebula)
#: seconds from the start of a firing to each laser (nebula's 16P decoder).
LASER_TIMES = np.array([0, 3.15, 6.3, 9.45, 13.26, 17.08, 20.56, 23.71, 26.53, 27.77, 31.49, 32.73, 36.46, 38.94, 41.42, 43.91]) * 1e-6
LENS = 0.03498  # metres from the axis to the optical centre, in the rotor's direction (rs_driver, RX)
GAP = 1.0  # degrees; a longer step between blocks is the edge of the field of view that was set (rs_driver)
TURNS = 10  # per second, the factory's setting
#: degrees; assumed: the topmost laser first, 2 degrees apart over the model's 30 degrees. Units differ by degrees.
VERTICAL = 15.0 - 2 * np.arange(LASERS)

#: of most models: the low byte first, its sign in a bit of its own.
TEMPERATURE = ByteSwapped(
    BitStruct(
        "negative" / BitsInteger(1),
        "magnitude" / Scaled(BitsInteger(12), 0.0625, "degC"),
        "reserved" / BitsInteger(3),
    )
)

DATA = Struct(
    "header" / Const(b"\x55\xaa\x05\x5a"),
    "protocol_version" / Int16ub * "0 old, 1 latest",
    "reserved_6" / Bytes(2),
    "top_packet_count" / Bytes(4) * "four counts, each 3 above the one before",
    "bottom_packet_count" / Int32ub * "of packets",
    "reserved_16" / Bytes(1),
    "range_resolution" / Int8ub * "1: 2.5 mm, 0: 5 mm",
    "angle_pulse_interval" / Scaled(Int16ub, 1e-6, "s"),
    "seconds" / Scaled(BytesInteger(6), 1, "s") * "since 1970, where synchronised",
    "microseconds" / Scaled(Int32ub, 1e-6, "s"),
    "lidar_type" / Int8ub * "6 Helios-5515, 7 Helios-1615 and Helios-16P",
    "reserved_31" / Bytes(7),
    "temperature" / TEMPERATURE,
    "reserved_40" / Bytes(2),
    "blocks"
    / Array(
        BLOCKS,
        Struct(
            "flag" / Const(b"\xff\xee"),
            "azimuth" / Scaled(Int16ub, 0.01, "deg") * "of the rotor, clockwise, at the block's first laser",
            "groups"
            / Array(
                GROUPS,
                Struct(
                    "channels"
                    / Array(
                        LASERS,
                        Struct(
                            "distance" / Scaled(Int16ub, 0.0025, "m") * "0: no return; twice as much at range_resolution 0",
                            "intensity" / Int8ub,
                        ),
                    ),
                )
                * "single return: two firings; dual return: the two returns of one firing",
            ),
        ),
    ),
    "tail" / Bytes(6) * "reserved, and 00 FF",
)


def angles() -> Construct:
    """Sign and size of an angle for each laser (manual B.9, B.10)."""
    return Array(
        LASERS,
        Struct(
            "sign" / Int8ub * "0 positive, 1 negative, 255 not calibrated",
            "value" / Scaled(Int16ub, 0.01, "deg"),
        ),
    )


DIFOP = Struct(
    "header" / Const(b"\xa5\xff\x00\x5a\x11\x11\x55\x55"),
    "rpm" / Scaled(Int16ub, 1, "rpm") * "as set",
    "lidar_ip" / Bytes(4),
    "host_ip" / Bytes(4),
    "mac" / Bytes(6),
    "msop_local_port" / Int16ub,
    "msop_port" / Int16ub,
    "difop_local_port" / Int16ub,
    "difop_port" / Int16ub,
    "fov_start" / Scaled(Int16ub, 0.01, "deg"),
    "fov_end" / Scaled(Int16ub, 0.01, "deg"),
    "reserved_36" / Bytes(2),
    "phase_lock" / Scaled(Int16ub, 1, "deg"),
    "top_firmware" / Bytes(5),
    "bottom_firmware" / Bytes(5),
    "software" / Bytes(5),
    "motor_firmware" / Bytes(5),
    "hardware" / Bytes(3),
    "web_version" / Bytes(4),
    "backup_checksums" / Bytes(16) * "of top board, bottom board, software, web page",
    "gateway" / Bytes(4),
    "subnet_mask" / Bytes(4),
    "reserved_91" / Bytes(201),
    "serial_number" / Bytes(6),
    "zero_angle_offset" / Int16ub,
    "return_mode" / Int8ub * "0 dual, 4 strongest, 5 last, 6 first",
    "time_sync_mode" / Int8ub,
    "time_sync_status" / Int8ub,
    "seconds" / Scaled(BytesInteger(6), 1, "s"),
    "microseconds" / Scaled(Int32ub, 1e-6, "s"),
    "operating_status" / Bytes(12) * "current, and voltages: in, 12 V, 5 V, 2.5 V, APD",
    "reserved_325" / Bytes(17),
    "board_temperatures" / Bytes(10),
    "measured_rpm" / Scaled(Int16ub, 1, "rpm"),
    "faults" / Bytes(6),
    "code_wheel" / Int8ub * "whether it is calibrated",
    "pps_trigger" / Int8ub,
    "reserved_362" / Bytes(20),
    "gprmc" / Bytes(86),
    "vertical" / angles(),
    "reserved_516" / Bytes(48) * "of lasers 17 to 32 in other models",
    "horizontal" / angles(),
    "reserved_612" / Bytes(48) * "of lasers 17 to 32 in other models",
    "reserved_660" / Bytes(586),
    "tail" / Const(b"\x0f\xf0"),
)


def plausible(f: Fields) -> Any:
    """Azimuths below 360 degrees (manual 6.2.2.2)."""
    return f.blocks.azimuth < 360


def signed(entry: Any) -> Any:
    """Degrees of each laser, on the lasers' axis; nan, so no point, where the sensor is not calibrated."""
    sign, value = entry.sign.on("channels"), entry.value.on("channels")
    return np.where(sign == 0, value, np.where(sign == 1, -value, np.nan))


def rotor_step(f: Fields, duration: Any) -> Any:
    """Degrees from each block to the next; over a loss or a gap as before it, or as the rotor was set to turn."""
    azimuth = f.blocks.azimuth
    ahead, behind = wrap(following(azimuth) - azimuth, 360), wrap(azimuth - previous(azimuth), 360)
    usual = np.where(behind <= GAP, behind, f.state.difop.rpm * 6 * duration)
    return np.where(ahead <= GAP, ahead, usual)


def points(f: Fields) -> Polar:
    """Lasers beside the rotor's direction, from an optical centre that turns with it (rs_driver, internDecodeMsopPkt)."""
    difop = f.state.difop
    dual = difop.return_mode == DUAL
    group = np.arange(GROUPS)[:, None]
    duration = np.where(dual, 1, GROUPS) * FIRING
    elapsed = np.where(dual, 0, group) * FIRING + LASER_TIMES
    rotor = np.deg2rad(f.blocks.azimuth + rotor_step(f, duration) * elapsed / duration)
    channels = f.blocks.groups.channels
    return Polar(
        range=channels.distance * np.where(f.range_resolution == 0, 2, 1),
        azimuth=-(rotor + np.deg2rad(signed(difop.horizontal))),
        elevation=np.deg2rad(signed(difop.vertical)),
        intensity=channels.intensity,
        time=np.arange(BLOCKS)[:, None, None] * duration + elapsed,
        ring=np.arange(LASERS),
        return_index=np.where(dual, group, 0),
        origin=(LENS * np.cos(rotor), -LENS * np.sin(rotor), 0),
    )


def sweep(i: int) -> dict[str, Any]:
    """Packet i of a sensor in single return mode."""
    block = i * BLOCKS + np.arange(BLOCKS)
    time = i * BLOCKS * GROUPS * FIRING
    return {
        "protocol_version": 1,
        "bottom_packet_count": i % (1 << 32),
        "range_resolution": 1,
        "seconds": int(time),
        "microseconds": time % 1,
        "lidar_type": 7,
        "blocks.azimuth": np.round(block * GROUPS * FIRING * TURNS * 360, 2) % 360,
    }


def sweep_difop(i: int) -> dict[str, Any]:
    """The device information of a sensor with the factory's settings; the angles are the default ones."""
    addresses = {"lidar_ip": bytes([192, 168, 1, 200]), "host_ip": bytes([192, 168, 1, 102])}
    return {"measured_rpm": TURNS * 60, "msop_port": 6699, "difop_port": 7788, "fov_end": 360.0, **addresses}


HELIOS_16P = Sensor(
    "robosense-helios16p",
    vendor="RoboSense",
    model="RS-Helios-16P",
    frames={
        "data": Frame(DATA, data=True, plausible=plausible),
        "difop": Frame(DIFOP, simulation=Simulation(sweep_difop, rate=1)),  # the rate: assumed, the M1's
    },
    points=points,
    scan=OnWrap("blocks.azimuth"),
    links={"data": Udp(6699, 7788)},
    clock=Clock(("seconds", "microseconds")),
    sequence=Sequence("bottom_packet_count"),
    state={
        "difop": {
            "rpm": TURNS * 60,
            "return_mode": STRONGEST,
            "vertical.sign": VERTICAL < 0,
            "vertical.value": np.abs(VERTICAL),
            "horizontal.sign": np.zeros(LASERS),
            "horizontal.value": np.zeros(LASERS),
        }
    },
    simulation=Simulation(sweep),
    range_limits=(0.1, 180.0),  # rs_driver's limits for this model
    vendor_axes=("forward", "left", "up"),
    turn=(TURNS, 20.0),  # 600 and 1200 rpm (manual B.1)
    # firmware: the first of three boards in Table 11; the temperature has its sign in a field of its own
    info={"serial": "difop.serial_number", "firmware": "difop.top_firmware", "model": "data.lidar_type"},
    aliases=("helios16p", "rs-helios-16p"),
    status="capture",
    acknowledged={
        "LS511": "the rotor turns clockwise, and the angle on the wire with it, in axes that are right-handed",
        "LS710": "the capture is another's, and too large: the project's tests read it where it is",
    },
    source="RS-Helios-16P user manual, 5.4, 6.2, 6.3 and appendix B; rs_driver; nebula's capture and point clouds",
)
