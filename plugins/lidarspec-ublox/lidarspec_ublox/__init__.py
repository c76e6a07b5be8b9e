"""u-blox GNSS receivers, for the time and position of lidars.

Source: ZED-F9P Interface Description, UBX-18010854 R04 (protocol version 27), with page numbers. M8
receivers (protocol version 15 and later) send the same messages. CFG-MSG and CFG-RATE are
deprecated from protocol version 23.01 on, and still accepted (p. 54 and 74).

A receiver sends UBX and NMEA over the same line. Known errors: in the manual, the example of RMC
with `navStatus` (p. 23) has the checksum of the sentence without `navStatus`. Receivers that send
NMEA 2.3 omit `navStatus`; receivers that send older versions also omit `posMode`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from construct import (
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    Construct,
    Enum,
    Float32b,
    Float64b,
    Int8ub,
    Int8ul,
    Int16sl,
    Int16ul,
    Int32sl,
    Int32ul,
    Struct,
    this,
)

from lidarspec.spec import (
    Checksummed,
    Clock,
    ClockState,
    ClockStatus,
    Command,
    Fields,
    Fletcher,
    Frame,
    HexCheck,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    Tokens,
    unix_time,
)

SYNC = b"\xb5\x62"  # UBX frames, 3.2 UBX Frame Structure
ACK = 0x05
CFG = 0x06
MAX_PAYLOAD_BYTES = 1200  # of other UBX messages: more than RXM-RAWX with 35 signals
MAX_SENTENCE_BYTES = 120  # NMEA 0183 allows 82; sentences of high precision are longer
WEEK_S = 604_800.0


def make_ubx(message: bytes, size: int, *fields: Construct) -> Construct:
    """Return the struct of a UBX frame: class and id, length, payload, checksum.

    `size` is the length of the payload in bytes, `fields` are its fields.
    """
    names = [field.name for field in fields]
    return Checksummed(
        Struct(
            "sync" / Const(SYNC),
            "message" / Const(message) * "class and id",
            "length" / Const(size, Int16ul) * "number of bytes of the payload",
            *fields,
            "checksum" / Int16ul,
        ),
        field="checksum",
        algorithm=Fletcher(),
        over=("message", "length", *names),
    )


FIX_TYPES = Enum(
    Int8ul, none=0, dead_reckoning=1, fix_2d=2, fix_3d=3, gnss_and_dead_reckoning=4, time_only=5
)

NAV_PVT = make_ubx(  # p. 150
    b"\x01\x07",
    92,
    "time_of_week" / Scaled(Int32ul, 0.001, "s") * "iTOW: GPS time of week",
    "year" / Int16ul * "UTC",
    "month" / Int8ul,
    "day" / Int8ul,
    "hour" / Int8ul,
    "minute" / Int8ul,
    "second" / Int8ul * "0 to 60; 60 is a leap second",
    "valid"
    / BitStruct(
        "reserved" / BitsInteger(4),
        "magnetic" / BitsInteger(1),
        "fully_resolved" / BitsInteger(1),
        "time" / BitsInteger(1),
        "date" / BitsInteger(1),
    ),
    "time_accuracy" / Scaled(Int32ul, 1, "ns"),
    "nano" / Scaled(Int32sl, 1, "ns") * "fraction of the second, which may be negative",
    "fix_type" / FIX_TYPES,
    "flags"
    / BitStruct(
        "carrier_phase" / Enum(BitsInteger(2), none=0, float=1, fixed=2),
        "heading_valid" / BitsInteger(1) * "1: vehicle_heading is valid",
        "power_save" / BitsInteger(3) * "state of the power save mode",
        "differential" / BitsInteger(1),
        "fix_valid" / BitsInteger(1),
    ),
    "flags2"
    / BitStruct(
        "time_confirmed" / BitsInteger(1),
        "date_confirmed" / BitsInteger(1),
        "confirmation_available" / BitsInteger(1),
        "reserved" / BitsInteger(5),
    ),
    "satellites" / Int8ul * "numSV: satellites used in the solution",
    "longitude" / Scaled(Int32sl, 1e-7, "deg"),
    "latitude" / Scaled(Int32sl, 1e-7, "deg"),
    "height" / Scaled(Int32sl, 0.001, "m") * "height above the ellipsoid",
    "height_msl" / Scaled(Int32sl, 0.001, "m") * "height above mean sea level",
    "horizontal_accuracy" / Scaled(Int32ul, 0.001, "m"),
    "vertical_accuracy" / Scaled(Int32ul, 0.001, "m"),
    "velocity_north" / Scaled(Int32sl, 0.001, "m/s"),
    "velocity_east" / Scaled(Int32sl, 0.001, "m/s"),
    "velocity_down" / Scaled(Int32sl, 0.001, "m/s"),
    "ground_speed" / Scaled(Int32sl, 0.001, "m/s"),
    "heading" / Scaled(Int32sl, 1e-5, "deg") * "direction of motion",
    "speed_accuracy" / Scaled(Int32ul, 0.001, "m/s"),
    "heading_accuracy" / Scaled(Int32ul, 1e-5, "deg"),
    "position_dop" / Scaled(Int16ul, 0.01, ""),
    "flags3" / Int16ul,
    "reserved" / Bytes(4),
    "vehicle_heading" / Scaled(Int32sl, 1e-5, "deg"),
    "magnetic_declination" / Scaled(Int16sl, 0.01, "deg"),
    "declination_accuracy" / Scaled(Int16ul, 0.01, "deg"),
)

NAV_TIMEUTC = make_ubx(  # p. 168
    b"\x01\x21",
    20,
    "time_of_week" / Scaled(Int32ul, 0.001, "s") * "iTOW: GPS time of week",
    "time_accuracy" / Scaled(Int32ul, 1, "ns"),
    "nano" / Scaled(Int32sl, 1, "ns") * "fraction of the second, may be negative",
    "year" / Int16ul * "UTC",
    "month" / Int8ul,
    "day" / Int8ul,
    "hour" / Int8ul,
    "minute" / Int8ul,
    "second" / Int8ul * "0 to 60; 60 is a leap second",
    "valid"
    / BitStruct(
        "standard" / Enum(BitsInteger(4), usno=3, european=5, soviet_union=6, ntsc=7),
        "reserved" / BitsInteger(1),
        "utc" / BitsInteger(1),
        "week" / BitsInteger(1),
        "time_of_week" / BitsInteger(1),
    ),
)

TIM_TP = make_ubx(  # p. 183
    b"\x0d\x01",
    16,
    "time_of_week" / Scaled(Int32ul, 0.001, "s") * "time of the week of the next pulse",
    "sub_millisecond" / Scaled(Int32ul, 1e-3 / 2**32, "s"),
    "quantization_error" / Scaled(Int32sl, 1e-12, "s"),
    "week" / Int16ul * "week of the next pulse",
    "flags"
    / BitStruct(
        "reserved" / BitsInteger(3),
        "error_invalid" / BitsInteger(1),
        "raim" / Enum(BitsInteger(2), not_active=1, active=2),
        "utc" / BitsInteger(1) * "1: UTC is available",
        "time_base" / Enum(BitsInteger(1), gnss=0, utc=1),
    ),
    "reference"
    / BitStruct(
        "utc_standard" / BitsInteger(4),
        "gnss" / Enum(BitsInteger(4), gps=0, glonass=1, beidou=2, unknown=15),
    ),
)

ACKNOWLEDGE = make_ubx(b"\x05\x01", 2, "message_class" / Int8ul, "message_id" / Int8ul)
REFUSE = make_ubx(b"\x05\x00", 2, "message_class" / Int8ul, "message_id" / Int8ul)
SET_MESSAGE = make_ubx(  # UBX-CFG-MSG, p. 54
    b"\x06\x01",
    3,
    "message_class" / Int8ul,
    "message_id" / Int8ul,
    "rate" / Int8ul * "n: the message is sent with every n-th navigation solution; 0: never",
)
SET_RATE = make_ubx(  # UBX-CFG-RATE, p. 75
    b"\x06\x08",
    6,
    "period" / Scaled(Int16ul, 0.001, "s") * "time between measurements",
    "cycles" / Int16ul * "number of measurements for each solution",
    "time_reference" / Enum(Int16ul, utc=0, gps=1, glonass=2, beidou=3, galileo=4),
)
POLL_PVT = make_ubx(b"\x01\x07", 0)
POLL_TIMEUTC = make_ubx(b"\x01\x21", 0)
POLL_TIM_TP = make_ubx(b"\x0d\x01", 0)

OTHER_UBX = Checksummed(
    Struct(
        "sync" / Const(SYNC),
        "message_class" / Int8ul,
        "message_id" / Int8ul,
        "length" / Int16ul,
        "payload" / Bytes(this.length),
        "checksum" / Int16ul,
    ),
    field="checksum",
    algorithm=Fletcher(),
    over=("message_class", "message_id", "length", "payload"),
)

RMC = Struct(  # p. 23
    "talker" / Bytes(2) * "GP: GPS; GN: several satellite systems",
    "formatter" / Const(b"RMC"),
    "time" / Float64b * "UTC as hhmmss.ss",
    "status" / Bytes(1) * "A: valid; V: warning",
    "latitude" / Float64b * "ddmm.mmmmm",
    "north_south" / Bytes(1),
    "longitude" / Float64b * "dddmm.mmmmm",
    "east_west" / Bytes(1),
    "speed" / Scaled(Float32b, 1852 / 3600, "m/s") * "sent in knots",
    "course" / Scaled(Float32b, 1, "deg"),
    "date" / Bytes(6) * "ddmmyy",
    "variation" / Scaled(Float32b, 1, "deg") * "magnetic variation",
    "variation_east_west" / Bytes(1),
    "mode" / Bytes(1) * "the manual calls it posMode; sent with NMEA 2.3 or later",
    "navigation_status"
    / Bytes(1)
    * "V: the receiver provides no navigational status; sent with NMEA 4.1 or later",
)
GGA = Struct(
    "talker" / Bytes(2) * "GP: GPS, GN: several systems",
    "formatter" / Const(b"GGA"),
    "time" / Float64b * "hhmmss.ss, UTC",
    "latitude" / Float64b * "ddmm.mmmmm",
    "north_south" / Bytes(1),
    "longitude" / Float64b * "dddmm.mmmmm",
    "east_west" / Bytes(1),
    "quality" / Enum(Int8ub, none=0, fix=1, differential=2, rtk=4, float_rtk=5, dead_reckoning=6),
    "satellites" / Int8ub * "satellites used in the solution, 0 to 12",
    "horizontal_dop" / Float32b,
    "altitude" / Scaled(Float64b, 1, "m") * "height above mean sea level",
    "altitude_unit" / Bytes(1),
    "separation" / Scaled(Float32b, 1, "m") * "height of mean sea level above the ellipsoid",
    "separation_unit" / Bytes(1),
    "age" / Scaled(Float32b, 1, "s") * "age of the differential corrections",
    "station" / Bytes(4) * "id of the station that sends the differential corrections",
)
OTHER_NMEA = Struct("address" / Bytes(5), "content" / Bytes(MAX_SENTENCE_BYTES - 12))

COORDINATES = {"time": "hhmmss.ss", "latitude": "ddmm.mmmmm", "longitude": "dddmm.mmmmm"}
SENTENCE = Tokens(
    start=b"$", sep=b",", end=b"\r\n", base=10, check=HexCheck(), joined=2, padded=True
)
WIRE_RMC = replace(SENTENCE, optional=2, formats=COORDINATES | {"speed": "0.000"})
WIRE_GGA = replace(SENTENCE, formats=COORDINATES | {"satellites": "00", "horizontal_dop": "0.00"})
WIRE_OTHER = replace(SENTENCE, joined=1, rest=True)


def is_plausible_date(f: Fields) -> Any:
    """Return whether date and time are within their limits."""
    return (f.month <= 12) & (f.day <= 31) & (f.hour < 24) & (f.minute < 60) & (f.second <= 60)


def is_plausible_position(f: Fields) -> Any:
    """Return whether latitude, longitude, date and time are within their limits."""
    return is_plausible_date(f) & (abs(f.latitude) <= 90) & (abs(f.longitude) <= 180)


def is_plausible_pulse(f: Fields) -> Any:
    return f.time_of_week < WEEK_S


def utc_time(f: Fields) -> Any:
    """Return the seconds since 1970, and the fraction of a second."""
    return unix_time(f.year, f.month, f.day, f.hour, f.minute, f.second), f.nano * 1e-9


def is_resolved(f: Fields) -> Any:
    """Return whether date and time are valid and fully resolved."""
    valid = f.valid
    return (valid.date == 1) & (valid.time == 1) & (valid.fully_resolved == 1)


# The manual does not say what the receiver counts before UTC is valid.
PVT_CLOCK_STATUS = ClockStatus(  # p. 150: "UTC time of day has been fully resolved"
    is_resolved,
    {
        0: ClockState("time not fully resolved", locked=False, epoch=""),
        1: ClockState("time resolved by GNSS", locked=True),
    },
)
TIMEUTC_CLOCK_STATUS = ClockStatus(  # p. 168: "Valid UTC Time"
    "valid.utc",
    {
        0: ClockState("UTC not valid", locked=False, epoch=""),
        1: ClockState("UTC valid", locked=True),
    },
)


def date_values(i: int, rate: float) -> dict[str, Any]:
    """Return the date of simulated frame i; frame 0 is on Sunday, 2026-01-04."""
    second = int(i // rate)
    return {
        "time_of_week": i / rate % WEEK_S,
        "year": 2026,
        "month": 1,
        "day": 4 + second // 86_400 % 28,
        "hour": second // 3600 % 24,
        "minute": second // 60 % 60,
        "second": second % 60,
        "time_accuracy": 25,
        "nano": i % rate / rate * 1e9,
    }


def pvt_sweep(i: int) -> dict[str, Any]:
    """Return the values of simulated solution i, at five solutions a second."""
    valid = {"valid.date": 1, "valid.time": 1, "valid.fully_resolved": 1}
    return {
        **date_values(i, 5),
        **valid,
        "fix_type": 3,
        "flags.fix_valid": 1,
        "satellites": 12,
        "latitude": 47.2852395 + i % 100_000 * 1.8e-6,
        "longitude": 8.5652537,
        "height": 547.6,
        "height_msl": 499.6,
        "horizontal_accuracy": 1.2,
        "vertical_accuracy": 1.9,
        "velocity_north": 1,
        "ground_speed": 1,
        "position_dop": 1.2,
    }


def timeutc_sweep(i: int) -> dict[str, Any]:
    valid = {"valid.utc": 1, "valid.week": 1, "valid.time_of_week": 1, "valid.standard": 3}
    return {**date_values(i, 1), **valid}


def pulse_sweep(i: int) -> dict[str, Any]:
    """Return the simulated announcement of the pulse at second i + 1."""
    return {"time_of_week": (i + 1) % WEEK_S, "week": 2400 + int((i + 1) // WEEK_S), "flags.utc": 1}


def clock_digits(i: int) -> float:
    """Return second i of a day as the number hhmmss."""
    return i // 3600 % 24 * 10_000 + i // 60 % 60 * 100 + i % 60


def rmc_sweep(i: int) -> dict[str, Any]:
    return {
        "talker": b"GN",
        "time": clock_digits(i),
        "status": b"A",
        "latitude": 4717.11437,
        "north_south": b"N",
        "longitude": 833.91522,
        "east_west": b"E",
        "speed": 1,
        "course": np.nan,
        "date": b"040126",
        "variation": np.nan,
        "mode": b"A",
        "navigation_status": b"V",
    }


def gga_sweep(i: int) -> dict[str, Any]:
    return {
        "talker": b"GN",
        "time": clock_digits(i),
        "latitude": 4717.11437,
        "north_south": b"N",
        "longitude": 833.91522,
        "east_west": b"E",
        "quality": 1,
        "satellites": 12,
        "horizontal_dop": 1.25,
        "altitude": 499.5,
        "altitude_unit": b"M",
        "separation": 48,
        "separation_unit": b"M",
        "age": np.nan,
    }


def make_sentence_frame(struct: Construct, wire: Tokens, **more: Any) -> Frame:
    return Frame(struct, wire=wire, max_length=MAX_SENTENCE_BYTES, **more)


def make_configuration_command(
    message_id: int, frame: str, args: dict[str, Any], **values: Any
) -> Command:
    """Return a command of the class CFG, which the receiver acknowledges or refuses."""
    return Command(
        frame,
        values=values,
        args=args,
        reply="acknowledge",
        matches={"message_class": CFG, "message_id": message_id},
        refusal="refuse",
    )


GNSS = Sensor(
    "ublox-gnss",
    vendor="u-blox",
    model="M8 and F9 receivers",
    frames={
        "nav_pvt": Frame(
            NAV_PVT,
            plausible=is_plausible_position,
            clock=Clock(utc_time, epoch="utc", status=PVT_CLOCK_STATUS),
            simulation=Simulation(pvt_sweep, rate=5),
        ),
        "nav_timeutc": Frame(
            NAV_TIMEUTC,
            plausible=is_plausible_date,
            clock=Clock(utc_time, epoch="utc", status=TIMEUTC_CLOCK_STATUS),
            simulation=Simulation(timeutc_sweep, rate=1),
        ),
        "tim_tp": Frame(
            TIM_TP, plausible=is_plausible_pulse, simulation=Simulation(pulse_sweep, rate=1)
        ),
        "rmc": make_sentence_frame(RMC, WIRE_RMC, simulation=Simulation(rmc_sweep, rate=1)),
        "gga": make_sentence_frame(GGA, WIRE_GGA, simulation=Simulation(gga_sweep, rate=1)),
        "acknowledge": Frame(ACKNOWLEDGE),
        "refuse": Frame(REFUSE),
        "ubx": Frame(OTHER_UBX, max_length=8 + MAX_PAYLOAD_BYTES),
        "nmea": make_sentence_frame(OTHER_NMEA, WIRE_OTHER),
        "set_message": Frame(SET_MESSAGE, direction="out"),
        "set_rate": Frame(SET_RATE, direction="out"),
        "poll_nav_pvt": Frame(POLL_PVT, direction="out"),
        "poll_nav_timeutc": Frame(POLL_TIMEUTC, direction="out"),
        "poll_tim_tp": Frame(POLL_TIM_TP, direction="out"),
    },
    links={"data": Serial(9600, 38_400, 115_200)},
    commands={
        "message": make_configuration_command(
            1,
            "set_message",
            {
                "message_class": ("message_class", 0, 255),
                "message_id": ("message_id", 0, 255),
                "rate": ("rate", 0, 255),
            },
        ),
        "rate": make_configuration_command(
            8, "set_rate", {"period": ("period", 0.025, 65.0)}, cycles=1, time_reference="gps"
        ),
        "nav_pvt": Command("poll_nav_pvt", reply="nav_pvt"),
        "nav_timeutc": Command("poll_nav_timeutc", reply="nav_timeutc"),
        "tim_tp": Command("poll_tim_tp", reply="tim_tp"),
    },
    status="vectors",
    source="ZED-F9P Interface Description, UBX-18010854 R04, p. 23, 54, 75, 150, 168, 183",
)
