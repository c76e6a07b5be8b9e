"""SICK microScan3, nanoScan3 and outdoorScan3: safety laser scanners, which send scans over UDP.

A message is one scan. It is sent in several datagrams, each of which has its offset in the message.

Source: the vendor's driver sick_safetyscanners (ParseDatagramHeader, UDPPacketMerger,
ParseDataHeader, ParseDerivedValues, ParseMeasurementData, ParseTypeCodeData.cpp, DatagramHeader.h,
SickSafetyscannersRos.cpp). The format allows the blocks of a message at any offset. This module
requires that the blocks are in the order of their entries in the header, and that the derived
values and the measurements are sent. It does not decode the content of the blocks for the system
state, intrusions and applications. The commands of CoLa 2, with which a host selects the blocks and
the address to which the scanner sends them, are not supported. The port is assumed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    Int8ub,
    Int8ul,
    Int16ub,
    Int16ul,
    Int32sl,
    Int32ul,
    OneOf,
    Struct,
    this,
)

from lidarspec.spec import (
    Assembled,
    Clock,
    Fields,
    Frame,
    OnChange,
    PacketCounter,
    Polar,
    Scaled,
    Sensor,
    Simulation,
    Udp,
)

PORT = 6060
HEADER_BYTES = 52
DERIVED_BYTES = 20
#: Possible offsets of the blocks. The block of the system state (16 bytes) may be before them, as
#: well as padding to a multiple of 4 bytes.
DERIVED_OFFSETS = range(HEADER_BYTES, HEADER_BYTES + 65, 4)
MEASUREMENT_OFFSETS = range(HEADER_BYTES + DERIVED_BYTES, HEADER_BYTES + DERIVED_BYTES + 97, 4)
MAX_BEAMS = 2751  # ParseMeasurementData.cpp
MAX_MESSAGE_BYTES = 16_384
#: Degrees per raw step of an angle (DerivedValues.h). The next constant is the angle straight ahead
#: in degrees (SickSafetyscannersRos.cpp).
ANGLE_STEP_DEG = 1 / 4_194_304
AHEAD_DEG = 90.0
#: Days from 1970-01-01 to 1972-01-01, the day from which dates are counted.
EPOCH_DAYS = 730
SECONDS_PER_DAY = 86_400
MM = 0.001  # m
#: Simulated scanner: 275 degrees in steps of 0.5, every 40 ms.
BEAMS = 551
STEP_DEG = 0.5
SCAN_TIME_S = 0.04
SIMULATED_DAY = 20_000
SIMULATED_REFLECTIVITY = 100

DATAGRAM = Struct(
    "marker" / Const(b"MS3 "),
    "protocol" / Int16ub,
    "major" / Int8ub,
    "minor" / Int8ub,
    "total_length" / Int32ul * "number of bytes of the message",
    "identification" / Int32ul * "message counter",
    "fragment_offset" / Int32ul * "offset of this datagram in the message, in bytes",
    "reserved" / Bytes(4),
)


def make_block(offsets: range | None = None) -> Struct:
    """Return the struct with offset and size of a block; both are 0 if it is not sent.

    Args:
        offsets: the possible offsets; None for all.
    """
    offset = Int16ul if offsets is None else OneOf(Int16ul, offsets)
    return Struct("offset" / offset, "size" / Int16ul)


BEAM = Struct(
    "distance" / Scaled(Int16ul, MM, "m") * "to be multiplied by `factor`",
    "reflectivity" / Int8ul,
    "status"
    / BitStruct(
        "reserved" / BitsInteger(2),
        "contamination_warning" / BitsInteger(1),
        "contamination" / BitsInteger(1),
        "reflector" / BitsInteger(1),
        "glare" / BitsInteger(1),
        "infinite" / BitsInteger(1) * "1: no echo",
        "valid" / BitsInteger(1),
    ),
)
MESSAGE = Struct(
    "version_indicator" / Int8ul,
    "major" / Int8ul,
    "minor" / Int8ul,
    "release" / Int8ul,
    "serial" / Int32ul * "serial number of the scanner",
    "plug_serial" / Int32ul * "serial number of the system plug",
    "channel" / Int8ul,
    "reserved" / Bytes(3),
    "sequence" / Int32ul * "message counter",
    "scan_number" / Int32ul * "scan counter",
    "date"
    / Scaled(Int16ul, SECONDS_PER_DAY, "s", EPOCH_DAYS * SECONDS_PER_DAY)
    * "days since 1972-01-01",
    "reserved_2" / Bytes(2),
    "time" / Scaled(Int32ul, 0.001, "s") * "time since midnight",
    "blocks"
    / Struct(
        "system_state" / make_block(),
        "derived" / make_block(DERIVED_OFFSETS),
        "measurement" / make_block(MEASUREMENT_OFFSETS),
        "intrusion" / make_block(),
        "application" / make_block(),
    ),
    "system_state" / Bytes(this.blocks.derived.offset - HEADER_BYTES),
    "derived"
    / Struct(
        "factor" / Int16ul * "factor by which all distances are multiplied",
        "beams" / Int16ul,
        "scan_time" / Scaled(Int16ul, 0.001, "s"),
        "reserved" / Bytes(2),
        "start_angle"
        / Scaled(Int32sl, ANGLE_STEP_DEG, "deg")
        * "first angle; 90 degrees is straight ahead",
        "step" / Scaled(Int32sl, ANGLE_STEP_DEG, "deg"),
        "interval" / Scaled(Int32ul, 1e-6, "s") * "time between two beams",
    ),
    "derived_rest"
    / Bytes(this.blocks.measurement.offset - this.blocks.derived.offset - DERIVED_BYTES),
    "beam_count" / Int32ul,
    "beams" / Array(this.beam_count, BEAM),
    "intrusion" / Bytes(this.blocks.intrusion.size),
    "application" / Bytes(this.blocks.application.size),
)


def plausible(f: Fields) -> Any:
    """Return whether the number of beams, the factor and the times are possible."""
    return (
        (f.beam_count <= MAX_BEAMS)
        & (f.derived.factor >= 1)
        & (f.time < SECONDS_PER_DAY)
        & (np.abs(f.derived.start_angle) <= 360)
    )


def points(f: Fields) -> Polar:
    """Return one point for each beam; a beam without an echo has the range inf."""
    beam = f.beams
    angle = f.derived.start_angle + beam.index * f.derived.step
    no_echo = beam.status.infinite == 1
    return Polar(
        range=np.where(no_echo, 0.0, beam.distance * f.derived.factor),
        azimuth=np.deg2rad(angle - AHEAD_DEG),
        intensity=beam.reflectivity,
        time=beam.index * f.derived.interval,
        invalid=(beam.status.valid == 0) & ~no_echo,
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of simulated scan i."""
    measurement_offset = HEADER_BYTES + DERIVED_BYTES
    return {
        "sequence": i,
        "scan_number": i,
        "date": (SIMULATED_DAY + EPOCH_DAYS) * SECONDS_PER_DAY,
        "time": i * SCAN_TIME_S % SECONDS_PER_DAY,
        "blocks.derived.offset": HEADER_BYTES,
        "blocks.derived.size": DERIVED_BYTES,
        "blocks.measurement.offset": measurement_offset,
        "blocks.measurement.size": 4 + 4 * BEAMS,
        "derived.factor": 1,
        "derived.beams": BEAMS,
        "derived.scan_time": SCAN_TIME_S,
        "derived.start_angle": AHEAD_DEG - (BEAMS - 1) / 2 * STEP_DEG,
        "derived.step": STEP_DEG,
        "derived.interval": SCAN_TIME_S / 360 * STEP_DEG,
        "beam_count": BEAMS,
        "beams.reflectivity": np.full(BEAMS, SIMULATED_REFLECTIVITY),
        "beams.status.valid": np.ones(BEAMS),
    }


MICROSCAN3 = Sensor(
    "sick-microscan3",
    vendor="SICK",
    model="microScan3, nanoScan3, outdoorScan3",
    frames={"data": Frame(MESSAGE, data=True, max_length=MAX_MESSAGE_BYTES, plausible=plausible)},
    points=points,
    scan=OnChange("scan_number"),
    clock=Clock(("date", "time"), epoch="utc"),
    sequence=PacketCounter("sequence"),
    links={
        "data": Udp(
            PORT,
            assembled=Assembled(
                DATAGRAM,
                key="identification",
                index="fragment_offset",
                count="total_length",
                in_bytes=True,
            ),
        )
    },
    simulation=Simulation(sweep, rate=1 / SCAN_TIME_S),
    info={"serial": "data.serial"},
    range_limits=(0.1, 64.0),
    status="manual",
    source="the vendor's driver sick_safetyscanners; the port is an assumption",
)
