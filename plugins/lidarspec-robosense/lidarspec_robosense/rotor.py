"""The parts that the rotating lidars share: clocks, temperatures, DIFOP, and points.

DIFOP, the device information, contains the configured speed, the return mode and the angles of each
laser of the sensor. It has three layouts. RS-LiDAR-16, -32 and RS-Bpearl have the first layout, and
Helios has the second. The layout of the Ruby family begins like the second layout and ends like the
first layout, with 128 lasers.

Source: the vendor's rs_driver (decoder.hpp, decoder_mech.hpp, block_iterator.hpp: layouts,
geometry, time, gaps); RS-Helios-16P user manual, Table 11 and appendix B (fields of the second
layout); Airy manual, Table 8 (one DIFOP packet a second, assumed for the other models).

In a firing, each laser fires once. A shot comprises all firings between one azimuth and the next:
one firing, or two if a block contains two firings. A slot is the position of a laser's values in a
block.

If the user has limited the field of view, the sensor sends no blocks outside it, so in some packets
the azimuth jumps between two blocks. The times of the points after the jump are too early, and are
not corrected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    BytesInteger,
    ByteSwapped,
    Const,
    Construct,
    Enum,
    Int8ub,
    Int16ub,
    Int24ub,
    Int32ub,
    Struct,
)
from numpy.typing import NDArray

from lidarspec.spec import (
    Clock,
    ClockState,
    ClockStatus,
    Fields,
    OnWrap,
    Polar,
    Scaled,
    Udp,
    between_blocks,
    following,
)

FACTORY_SPEED_HZ = 10  # revolutions per second
SPEED_LIMITS_HZ = (5.0, 20.0)  # lowest and highest of the family
MAX_SPEED_DEG_S = SPEED_LIMITS_HZ[1] * 360
BLOCK_FLAG: Construct = Const(b"\xff\xee")  # the first bytes of a block

#: The temperature of most models: low byte first, with a sign bit.
TEMPERATURE = ByteSwapped(
    BitStruct(
        "negative" / BitsInteger(1),
        "magnitude" / Scaled(BitsInteger(12), 0.0625, "degC"),
        "reserved" / BitsInteger(3),
    )
)
#: The temperature of the Ruby family: high byte first.
TEMPERATURE_BE = BitStruct(
    "negative" / BitsInteger(1),
    "magnitude" / Scaled(BitsInteger(11), 0.0625, "degC"),
    "reserved" / BitsInteger(4),
)
#: The time in data packets and DIFOP, of the models that count seconds.
TIME: tuple[Construct, ...] = (
    "seconds" / Scaled(BytesInteger(6), 1, "s") * "time since 1970, if synchronized",
    "microseconds" / Scaled(Int32ub, 1e-6, "s"),
)


def make_blocks(
    count: int, lasers: int, step: float, *, firings: int = 1, flag: Construct = BLOCK_FLAG
) -> Construct:
    """Return the array of blocks; a block has one azimuth.

    Args:
        count: the number of blocks.
        lasers: the number of lasers.
        step: the size of a distance step in metres.
        firings: how often a block contains each laser, 1 or 2.
        flag: the declaration of the bytes at the start of a block.
    """
    channel = Struct("distance" / Scaled(Int16ub, step, "m") * "0: no return", "intensity" / Int8ub)
    channels: Construct = "channels" / Array(lasers, channel)
    if firings > 1:
        groups = (
            Struct(channels)
            * "single return: two firings; dual return: the two returns of one firing"
        )
        channels = "groups" / Array(firings, groups)
    azimuth: Construct = (
        Scaled(Int16ub, 0.01, "deg")
        * "angle of the rotor, clockwise, when the first laser of the block fires"
    )
    return Array(count, Struct("flag" / flag, "azimuth" / azimuth, channels))


def make_angles(lasers: int, step: float = 0.01) -> Construct:
    """Return the array with the angle of each laser, as a sign and a magnitude.

    `step` is the angle in degrees for which one unit of the raw magnitude stands.
    """
    sign = Enum(Int8ub, positive=0, negative=1, not_calibrated=255)
    return Array(lasers, Struct("sign" / sign, "value" / Scaled(Int16ub, step, "deg")))


#: Codes of DIFOP of most models, and of the packets of an M1 (user guides).
SYNC_MODES = {"internal": 0, "PPS": 1, "PTP": 2, "gPTP": 3}
SYNC_STATES = {"none": 0, "locked": 1, "timeout": 2}
#: The mode and the status, of one byte each, are combined into one value: mode * CODES_PER_MODE +
#: status.
CODES_PER_MODE = 256
WAVE_MODES = {"dual": 0, "strongest": 4, "last": 5, "first": 6}
RETURN_NUMBERS = {"single": 0, "first": 1, "second": 2}
SOURCES = ("internal clock", "PPS", "PTP", "gPTP")


def make_clock_status(sources: Sequence[str] = SOURCES) -> ClockStatus:
    """Return the declaration that reads the state of the clock from DIFOP.

    `sources` has the name of the time source for each mode of synchronization.

    Source: RS-LiDAR-M1 and RS-Helios user guides, time synchronization in DIFOP.
    """
    internal, *others = sources
    states = {status: ClockState(internal, False, epoch="boot") for status in SYNC_STATES.values()}
    for mode, source in enumerate(others, start=1):
        if not source:
            continue
        source_epoch = "utc" if mode == SYNC_MODES["PPS"] else None
        first = mode * CODES_PER_MODE
        states[first + SYNC_STATES["none"]] = ClockState(
            f"{source}, not locked", False, epoch="boot"
        )
        states[first + SYNC_STATES["locked"]] = ClockState(
            f"locked to {source}", True, epoch=source_epoch
        )
        states[first + SYNC_STATES["timeout"]] = ClockState(
            f"{source} lost", False, epoch=source_epoch
        )
    return ClockStatus(
        lambda f: f.time_sync_mode * CODES_PER_MODE + f.time_sync_status, states, frame="difop"
    )


#: The first 50 bytes of every DIFOP.
DIFOP_HEAD: tuple[Construct, ...] = (
    "header" / Const(b"\xa5\xff\x00\x5a\x11\x11\x55\x55"),
    "rpm" / Scaled(Int16ub, 1, "rpm") * "configured speed",
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
)
#: Bytes 50 to 291 of the second layout.
DIFOP_VERSIONS: tuple[Construct, ...] = (
    "software" / Bytes(5),
    "motor_firmware" / Bytes(5),
    "hardware" / Bytes(3),
    "web_version" / Bytes(4),
    "backup_checksums"
    / Bytes(16)
    * "checksums of the top board, the bottom board, the software and the web page",
    "gateway" / Bytes(4),
    "subnet_mask" / Bytes(4),
    "reserved_91" / Bytes(201),
)
#: Bytes 292 to 300 of every layout.
DIFOP_UNIT: tuple[Construct, ...] = (
    "serial_number" / Bytes(6),
    "zero_angle_offset" / Int16ub,
    "return_mode" / Int8ub,
)
#: Bytes 301 to 312 of the second layout.
DIFOP_TIME: tuple[Construct, ...] = (
    "time_sync_mode" / Enum(Int8ub, **SYNC_MODES),
    "time_sync_status" / Enum(Int8ub, **SYNC_STATES),
    *TIME,
)
#: Bytes 313 to 467 of the first layout.
DIFOP_STATUS: tuple[Construct, ...] = (
    "currents" / Array(2, Int24ub),
    "voltages" / Array(9, Int16ub),
    "reserved_337" / Bytes(5),
    "diagnostics" / Bytes(31),
    "measured_speed" / Scaled(Int16ub, 1 / 6, "rpm"),
    "diagnostics_2" / Bytes(7),
    "gprmc" / Bytes(86),
)
DIFOP_TAIL = "tail" / Const(b"\x0f\xf0")


def make_first_layout(*end: Construct) -> Construct:
    """Return the device information of the first layout.

    `end` are the fields from byte 468 on.
    """
    time = ("software" / Int16ub, "time" / Bytes(10))
    return Struct(
        *DIFOP_HEAD, "reserved_50" / Bytes(242), *DIFOP_UNIT, *time, *DIFOP_STATUS, *end, DIFOP_TAIL
    )


@dataclass(frozen=True, eq=False)
class RotorModel:
    """The firing times, geometry and nominal angles of a model.

    Attributes:
        delay: the seconds from the time of the block to the firing of each laser, (slots,), or
            (blocks, slots) if blocks contain different lasers.
        period: the seconds from one firing of all lasers to the next.
        lens_distance: the distance in metres from the axis to the optical centre, along the
            azimuth of the block.
        vertical, horizontal: (lasers,) the nominal angles in degrees, which are used until a DIFOP
            packet with the measured angles arrives.
        height: the height of the optical centre above the origin, metres.
    """

    delay: NDArray[Any]
    period: float
    lens_distance: float
    vertical: NDArray[Any]
    horizontal: NDArray[Any] | None = None
    height: float = 0.0

    @property
    def ring(self) -> NDArray[np.intp]:
        """The number of each laser, counted from the lowest elevation, (lasers,)."""
        return np.argsort(np.argsort(self.vertical))

    def make_default_state(self, **others: Any) -> dict[str, dict[str, Any]]:
        """Return the values that are used until the first DIFOP packet."""
        horizontal = np.zeros(len(self.vertical)) if self.horizontal is None else self.horizontal
        nominal_angles = {
            **split_angles("vertical", self.vertical),
            **split_angles("horizontal", horizontal),
        }
        return {"difop": {"rpm": FACTORY_SPEED_HZ * 60, **nominal_angles, **others}}


def split_angles(name: str, values: NDArray[np.float64]) -> dict[str, Any]:
    """Return the default values of angles as signs and magnitudes, as in DIFOP."""
    return {f"{name}.sign": values < 0, f"{name}.value": np.abs(values)}


def laser_degrees(entry: Any) -> Any:
    """Return the angle of each channel's laser in degrees.

    `entry` is an array of signs and magnitudes in DIFOP. The angles are nan if the sensor is not
    calibrated.
    """
    sign = entry.sign.on("channels")
    value = entry.value.on("channels")
    return np.where(sign == 0, value, np.where(sign == 1, -value, np.nan))


def laser_angles(f: Fields) -> tuple[Any, Any]:
    """Return the elevation and the horizontal angle of each laser, in degrees.

    Horizontal angles are clockwise from the direction of the rotor.
    """
    return laser_degrees(f.state.difop.vertical), laser_degrees(f.state.difop.horizontal)


def points_of_firings(f: Fields, dual: Any, model: RotorModel, *, first_echo: Any = 0) -> Polar:
    """Return the points of blocks that contain each laser once.

    With `dual`, two consecutive blocks contain the two returns of one firing. `first_echo` is the
    number of the return in the first block of the packet: 0, or 1 if the block with the other
    return is in the previous packet.
    """
    azimuth = f.blocks.azimuth
    block = f.blocks.index
    next_azimuth = np.where(dual, following(azimuth, 2), following(azimuth))
    shot = np.where(dual, (block + first_echo) // 2, block)
    echo = np.where(dual, (block + first_echo) % 2, 0)
    times = {"elapsed": model.delay, "duration": model.period, "shot": shot}
    return make_points(
        f, f.blocks.channels, model, laser_angles(f), next_azimuth, echo=echo, **times
    )


def points_of_groups(f: Fields, dual: Any, model: RotorModel, angles: tuple[Any, Any]) -> Polar:
    """Return the points of blocks with two groups, each with all lasers.

    With `dual`, the groups are the two returns of one firing; otherwise they are two firings.
    `angles` has the elevation and the horizontal angle of each laser, as in `make_points`.
    """
    group = np.arange(2)[:, None]
    duration = np.where(dual, 1, 2) * model.period
    elapsed = np.where(dual, 0, group) * model.period + model.delay
    next_azimuth = following(f.blocks.azimuth)
    echo = np.where(dual, group, 0)
    channels = f.blocks.groups.channels
    shot = f.blocks.index
    times = {"elapsed": elapsed, "duration": duration, "shot": shot}
    return make_points(f, channels, model, angles, next_azimuth, echo=echo, **times)


def make_points(
    f: Fields,
    channels: Any,
    model: RotorModel,
    angles: tuple[Any, Any],
    next_azimuth: Any,
    *,
    elapsed: Any,
    duration: Any,
    shot: Any,
    echo: Any,
    distance: Any = None,
    ring: Any = None,
) -> Polar:
    """Return the points of lasers with an optical centre away from the axis.

    Source: rs_driver, internDecodeMsopPkt.

    Args:
        angles: the elevation of each laser, and its angle clockwise from the rotor's direction, in
            degrees.
        next_azimuth: the azimuth of the next shot, for each block, in degrees.
        elapsed: the seconds from the time at which the rotor has the azimuth of the shot to the
            firing of each laser.
        duration: the seconds from shot to shot.
        shot: the number of the shot in the packet, for each block.
        echo: the number of the return, for each block.
        distance: the distances in metres; by default the field `distance` of the channels.
        ring: the numbers of the lasers; by default in the order of their elevations.
    """
    vertical, horizontal = angles
    step = between_blocks(f.blocks.azimuth, next_azimuth, fastest=MAX_SPEED_DEG_S * duration)
    step = np.where(np.isnan(step), f.state.difop.rpm * 6 * duration, step)
    clockwise = np.deg2rad(f.blocks.azimuth + step * elapsed / duration)
    return Polar(
        range=channels.distance if distance is None else distance,
        azimuth=-(clockwise + np.deg2rad(horizontal)),
        elevation=np.deg2rad(vertical),
        intensity=channels.intensity,
        time=shot * duration + elapsed,
        ring=model.ring if ring is None else ring,
        return_index=echo,
        origin=(
            model.lens_distance * np.cos(clockwise),
            -model.lens_distance * np.sin(clockwise),
            model.height,
        ),
    )


def pace(f: Fields, firings: float, period: float, dual: int) -> Any:
    """Return the time from one packet to the next, in seconds.

    Args:
        firings: the number of firings in a packet with single return.
        period: the seconds from one firing to the next.
        dual: the return mode in DIFOP that means dual return.
    """
    return np.where(f.state.difop.return_mode == dual, firings / 2, firings) * period


def rotation_values(i: int, shots: int, period: float, **others: Any) -> dict[str, Any]:
    """Return the time and the azimuths of simulated packet i with single return.

    Args:
        shots: the number of shots in a packet.
        period: the seconds from shot to shot.
        others: the values of other fields, which are added to the result.
    """
    time = i * shots * period
    azimuth = np.round((i * shots + np.arange(shots)) * period * FACTORY_SPEED_HZ * 360, 2) % 360
    return {"seconds": int(time), "microseconds": time % 1, "blocks.azimuth": azimuth, **others}


def sweep_difop(i: int, speed: str = "measured_speed", **others: Any) -> Mapping[str, Any]:
    """Return the device information with the factory's settings and default angles.

    `speed` is the name of the field with the measured speed.
    """
    addresses = {"lidar_ip": bytes([192, 168, 1, 200]), "host_ip": bytes([192, 168, 1, 102])}
    return {
        speed: FACTORY_SPEED_HZ * 60,
        "msop_port": 6699,
        "difop_port": 7788,
        "fov_end": 360.0,
        **addresses,
        **others,
    }


#: Arguments of `Sensor` that all rotating models share.
COMMON: dict[str, Any] = {
    "vendor": "RoboSense",
    "scan": OnWrap("blocks.azimuth"),
    "links": {"data": Udp(6699, 7788)},
    # Helios and Ruby subtract the leap seconds of TAI from the grandmaster's time: with a
    # grandmaster that sends UTC they are 37 s late (issues rs_driver 75, rslidar_sdk 169).
    "clock": Clock(("seconds", "microseconds"), epoch="utc"),
    "vendor_axes": ("forward", "left", "up"),
    "turn": SPEED_LIMITS_HZ,
    "returns": ("varying", "varying"),  # a setting; the order is not documented
    "status": "manual",
}
