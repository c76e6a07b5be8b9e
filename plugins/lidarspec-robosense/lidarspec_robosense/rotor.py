"""What the rotating lidars have in common: clocks, temperatures, DIFOP in three layouts, and lasers
beside the direction of a rotor.

DIFOP tells the speed as set, the return mode and the angles of each laser of the unit. Its first
layout is that of RS-LiDAR-16, -32 and RS-Bpearl, the second that of Helios; the Ruby family has the
head of the second and the tail of the first, for 128 lasers.

Source: the vendor's rs_driver (decoder.hpp, decoder_mech.hpp, block_iterator.hpp: layouts,
geometry, time, gaps); RS-Helios-16P user manual, Table 11 and appendix B (what its second layout
holds). That a DIFOP packet comes once a second: Airy manual, Table 8; assumed of the others.

Not expressed: with a field of view set, blocks after the gap are later than a packet's times say.
"""

from __future__ import annotations

from collections.abc import Mapping
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
    Int8ub,
    Int16ub,
    Int24ub,
    Int32ub,
    Struct,
)
from numpy.typing import NDArray

from lidarspec.spec import Clock, Fields, OnWrap, Polar, Scaled, Udp, between_blocks, following

TURNS = 10  # per second, the factory's setting
TURN = (5.0, 20.0)  # turns per second, the slowest and the fastest of the family
FASTEST = TURN[1] * 360  # degrees per second

BLOCK: Construct = Const(b"\xff\xee")  # what a block begins with
#: of most models: the low byte first, its sign in a bit of its own.
TEMPERATURE = ByteSwapped(
    BitStruct(
        "negative" / BitsInteger(1),
        "magnitude" / Scaled(BitsInteger(12), 0.0625, "degC"),
        "reserved" / BitsInteger(3),
    )
)
#: of the Ruby family: the high byte first.
TEMPERATURE_BE = BitStruct(
    "negative" / BitsInteger(1),
    "magnitude" / Scaled(BitsInteger(11), 0.0625, "degC"),
    "reserved" / BitsInteger(4),
)
#: in packets of both kinds, of the models that count seconds.
TIME: tuple[Construct, ...] = (
    "seconds" / Scaled(BytesInteger(6), 1, "s") * "time since 1970, if synchronized",
    "microseconds" / Scaled(Int32ub, 1e-6, "s"),
)


def blocks(
    count: int, lasers: int, step: float, *, firings: int = 1, flag: Construct = BLOCK
) -> Construct:
    """So many blocks of one azimuth, of one firing or of two groups, with distances in steps of so
    many metres.
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
        * "angle of the rotor, clockwise, at the first laser of the block"
    )
    return Array(count, Struct("flag" / flag, "azimuth" / azimuth, channels))


def angles(lasers: int, step: float = 0.01) -> Construct:
    """Sign and size of an angle of each laser, in steps of so many degrees."""
    sign = Int8ub * "0 positive, 1 negative, 255 not calibrated"
    return Array(lasers, Struct("sign" / sign, "value" / Scaled(Int16ub, step, "deg")))


#: the first 40 bytes of every DIFOP.
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
#: bytes 50 to 302 of the second layout.
DIFOP_VERSIONS: tuple[Construct, ...] = (
    "software" / Bytes(5),
    "motor_firmware" / Bytes(5),
    "hardware" / Bytes(3),
    "web_version" / Bytes(4),
    "backup_checksums" / Bytes(16) * "checksums of top board, bottom board, software, web page",
    "gateway" / Bytes(4),
    "subnet_mask" / Bytes(4),
    "reserved_91" / Bytes(201),
)
#: bytes 292 to 301 of every layout.
DIFOP_UNIT: tuple[Construct, ...] = (
    "serial_number" / Bytes(6),
    "zero_angle_offset" / Int16ub,
    "return_mode" / Int8ub,
)
#: bytes 301 to 312 of the second layout.
DIFOP_TIME: tuple[Construct, ...] = ("time_sync_mode" / Int8ub, "time_sync_status" / Int8ub, *TIME)
#: bytes 313 to 467 of the first layout.
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


def difop_first(*end: Construct) -> Construct:
    """Device information of the first layout; what stands from byte 468 on."""
    time = ("software" / Int16ub, "time" / Bytes(10))
    return Struct(
        *DIFOP_HEAD, "reserved_50" / Bytes(242), *DIFOP_UNIT, *time, *DIFOP_STATUS, *end, DIFOP_TAIL
    )


@dataclass(frozen=True, eq=False)
class Rotor:
    """What tells the models apart.

    Attributes:
        delay: (slots,) seconds from the block to the firing of each laser; (blocks, slots) where
            blocks hold different lasers.
        period: seconds from one firing of all lasers to the next.
        lens: metres from the axis to the optical centre, in the rotor's direction.
        height: metres of it above the origin.
        vertical, horizontal: (lasers,) degrees, nominal, until DIFOP says the unit's own.
    """

    delay: NDArray[Any]
    period: float
    lens: float
    vertical: NDArray[Any]
    horizontal: NDArray[Any] | None = None
    height: float = 0.0

    @property
    def ring(self) -> NDArray[np.intp]:
        """(lasers,) the lasers, counted from the lowest nominal one."""
        return np.argsort(np.argsort(self.vertical))

    def state(self, **others: Any) -> dict[str, dict[str, Any]]:
        """What stands in for the first DIFOP packet."""
        horizontal = np.zeros(len(self.vertical)) if self.horizontal is None else self.horizontal
        own = {**signs("vertical", self.vertical), **signs("horizontal", horizontal)}
        return {"difop": {"rpm": TURNS * 60, **own, **others}}


def signs(name: str, values: NDArray[np.float64]) -> dict[str, Any]:
    """Angles as DIFOP has them."""
    return {f"{name}.sign": values < 0, f"{name}.value": np.abs(values)}


def laser_degrees(entry: Any) -> Any:
    """Degrees of each laser, on the lasers' axis; nan, so no point, where the sensor is not
    calibrated.
    """
    sign = entry.sign.on("channels")
    value = entry.value.on("channels")
    return np.where(sign == 0, value, np.where(sign == 1, -value, np.nan))


def directions(f: Fields) -> tuple[Any, Any]:
    """Degrees above the horizon, and clockwise of the rotor's direction, of each laser."""
    return laser_degrees(f.state.difop.vertical), laser_degrees(f.state.difop.horizontal)


def pairs(f: Fields, dual: Any, model: Rotor, *, late: Any = 0) -> Polar:
    """Points of blocks of all lasers; with dual return, pairs of blocks are one firing, the first
    of which began `late` blocks ago.
    """
    azimuth = f.blocks.azimuth
    block = f.blocks.index
    ahead = np.where(dual, following(azimuth, 2), following(azimuth))
    shot = np.where(dual, (block + late) // 2, block)
    echo = np.where(dual, (block + late) % 2, 0)
    times = {"elapsed": model.delay, "duration": model.period, "shot": shot}
    return beams(f, f.blocks.channels, model, directions(f), ahead, echo=echo, **times)


def halves(f: Fields, dual: Any, model: Rotor, lasers: tuple[Any, Any]) -> Polar:
    """Return the points of blocks with two groups of all lasers.

    The groups are two firings, or with dual return the two returns of one firing.
    """
    group = np.arange(2)[:, None]
    duration = np.where(dual, 1, 2) * model.period
    elapsed = np.where(dual, 0, group) * model.period + model.delay
    ahead = following(f.blocks.azimuth)
    echo = np.where(dual, group, 0)
    channels = f.blocks.groups.channels
    shot = f.blocks.index
    times = {"elapsed": elapsed, "duration": duration, "shot": shot}
    return beams(f, channels, model, lasers, ahead, echo=echo, **times)


def beams(
    f: Fields,
    channels: Any,
    model: Rotor,
    lasers: tuple[Any, Any],
    ahead: Any,
    *,
    elapsed: Any,
    duration: Any,
    shot: Any,
    echo: Any,
    distance: Any = None,
    ring: Any = None,
) -> Polar:
    """Return the points of lasers beside the rotor's direction.

    The optical centre turns with the rotor (rs_driver, internDecodeMsopPkt). Before the first good
    step between shots, the speed that DIFOP reports gives the step.

    Args:
        lasers: degrees above the horizon, and clockwise of the rotor's direction.
        ahead: azimuth of the next shot, degrees.
        elapsed: seconds from the azimuth of a shot to each laser.
        duration: seconds from shot to shot.
        shot: the number of the shot in the packet, for each block.
        echo: the number of the return, for each block.
        distance: metres; by default the field of that name in `channels`.
        ring: numbers of the lasers; by default in the order of their elevation.
    """
    vertical, horizontal = lasers
    step = between_blocks(f.blocks.azimuth, ahead, fastest=FASTEST * duration)
    step = np.where(np.isnan(step), f.state.difop.rpm * 6 * duration, step)
    rotor = np.deg2rad(f.blocks.azimuth + step * elapsed / duration)
    return Polar(
        range=channels.distance if distance is None else distance,
        azimuth=-(rotor + np.deg2rad(horizontal)),
        elevation=np.deg2rad(vertical),
        intensity=channels.intensity,
        time=shot * duration + elapsed,
        ring=model.ring if ring is None else ring,
        return_index=echo,
        origin=(model.lens * np.cos(rotor), -model.lens * np.sin(rotor), model.height),
    )


def pace(f: Fields, shots: float, period: float, dual: int) -> Any:
    """Return the seconds from a packet to the next, by the return mode that DIFOP tells.

    Args:
        shots: of a packet with single return; with dual return it has half as many.
        period: seconds from shot to shot.
        dual: the return mode with two returns.
    """
    return np.where(f.state.difop.return_mode == dual, shots / 2, shots) * period


def sweep(i: int, shots: int, period: float, **others: Any) -> dict[str, Any]:
    """Packet i of so many shots a packet, in single return mode, with the time in seconds and
    microseconds.
    """
    time = i * shots * period
    azimuth = np.round((i * shots + np.arange(shots)) * period * TURNS * 360, 2) % 360
    return {"seconds": int(time), "microseconds": time % 1, "blocks.azimuth": azimuth, **others}


def sweep_difop(i: int, speed: str = "measured_speed", **others: Any) -> Mapping[str, Any]:
    """The device information of a sensor with the factory's settings; the angles are the default
    ones.
    """
    addresses = {"lidar_ip": bytes([192, 168, 1, 200]), "host_ip": bytes([192, 168, 1, 102])}
    return {
        speed: TURNS * 60,
        "msop_port": 6699,
        "difop_port": 7788,
        "fov_end": 360.0,
        **addresses,
        **others,
    }


#: what the declarations of all of them have in common.
COMMON: dict[str, Any] = {
    "vendor": "RoboSense",
    "scan": OnWrap("blocks.azimuth"),
    "links": {"data": Udp(6699, 7788)},
    "clock": Clock(("seconds", "microseconds")),
    "vendor_axes": ("forward", "left", "up"),
    "turn": TURN,
    "status": "manual",
}
