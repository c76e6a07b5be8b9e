"""CSPC M1C1_Mini, old and new, COIN-D4, COIN-D4A and COIN-D6: 360 degree triangulation and
time-of-flight lidars, started over a UART.

Source: CSPC M1C1_Mini development manual, sections 1 and 2. What it does not say comes from the
vendor's SDK (ros_cspc_lidar_coin_d4a, sdk/lidar_information.h), the manual's edition v1.1
(2020-01-22), or captures of a COIN-D4 and a COIN-D6.

Known errors and gaps of the manual: the printed sum of the device information, 0x0402, is 0x0403
(v1.1 has it right); the corrections of the angle example, 10.9442 and 11.8653 degrees, are 10.9445
and 11.8674 at 1000 and 8000 mm, and 71.1718 is 71.171875; the figure with the order of the checksum
is lost (the grouping here fits every captured packet); no baud rate, no rule for packets that cross
360 degrees or have one sample (the formula divides by LSN - 1), no command for the announced switch
between 5.5 and 7 Hz. Besides the fillers FE and FF, a COIN-D4 sends FA FA once, in no manual.

Of a COIN-D4A only the vendor's driver is public, of a COIN-D6 what others saw of one: 10 turns a
second, 400 points each, and every three seconds a frame that nobody explains. That both name
themselves by their model is assumed. The M1C1_Mini of the manual's edition v1.1 is a sensor of its
own: samples of two bytes, answers that begin with AA 55, no exposure, and packets that do not tell
how fast it turns. The M1CT_Coin_Plus, which sends Camsense's packets, is left out.
"""

from __future__ import annotations

import dataclasses
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
    Const,
    Construct,
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

STEPS = 380  # points a turn: 360 degrees by the step of the manual's angle example, 0.9473 degrees
SAMPLES = 25  # samples of a full packet (the manual's angle example)
SETTLING = 1.0  # seconds; the manual has "less than 3" (1b)
LOW_EXPOSURE = 2
LOW_SPEED = 5.5  # Exp_M and Hz of the slower of the two speeds (manual 1c and 2.2.3, Exp_M)

COMMAND = Checksummed(
    Struct(
        "header" / Const(b"\xaa\x55"),
        "mode" / Int8ul * "F0 start, F1 low exposure, F2 high exposure, F5 stop; FC version (SDK)",
        "checksum" / Int8ul,
    ),
    field="checksum",
    algorithm=Xor(),
)


def ack(header: bytes) -> Checksummed:
    """Return the acknowledgement of a command, behind this header."""
    return Checksummed(
        Struct(
            "header" / Const(header),
            "mode" / Int8ul * "the command's mode ^ A0",
            "length" / Const(7, Int8ul) * "of the data: firmware and reserved",
            "firmware" / Int8ul * "to start: 3 is V3.0",
            "reserved" / Bytes(6),
            "checksum" / Int8ul,
        ),
        field="checksum",
        algorithm=Xor(),
    )


INFO = Checksummed(
    Struct(
        "header" / Const(b"\xa5\x5a"),
        "length" / Const(20, Int16ul) * "of the data: all that follows the type",
        "sum" / Int16ul,
        "type" / Const(0x01, Int8ul) * "device information",
        "model" / Bytes(12) * "ASCII, ends with 00",
        "zero_angle"
        / Scaled(Int16ul, 1, "deg")
        * "from the data's zero to the one marked on the housing, clockwise",
        "direction" / Int8ul * "0: clockwise",
        "correction" / Int8ul * "1: the host has to correct the angles",
        "reserved" / Bytes(3),
        "revision" / Int8ul * "of the software",
    ),
    field="sum",
    algorithm=Sum(16),
)

SCAN_START = Checksummed(
    Struct(
        "header" / Const(b"\xa5\x5a"),
        "length" / Const(0, Int16ul) * "0: point packets follow without end",
        "sum" / Int16ul,
        "type" / Const(0x81, Int8ul) * "scan data begins",
    ),
    field="sum",
    algorithm=Sum(16),
)


AUXILIARY = Checksummed(
    Struct(
        "header" / Const(b"\xa5\x5a\x04\x00\xfe"),
        "checksum" / Int8ul,
        "type" / Const(0x06, Int8ul),
        "value" / Int8ul * "38 to 3F were seen; its meaning is not known",
        "reserved" / Const(bytes(3)),
    ),
    field="checksum",
    algorithm=Xor(),
)


def angle() -> Construct:
    """FSA and LSA: 1/64 degree above a check bit that is always 1 (manual 2.2.3)."""
    return ByteSwapped(
        BitStruct(
            "angle" / Scaled(BitsInteger(15), 1 / 64, "deg"), "check" / Const(1, BitsInteger(1))
        )
    )


def data(first: Construct, sample: Construct, groups: tuple[int, ...]) -> Checksummed:
    """Return the point packet.

    Args:
        first: what stands above the bit that says that a turn begins, 7 bits.
        sample: one of them.
        groups: sizes of the words that the checksum takes of it.
    """
    return Checksummed(
        Struct(
            "header" / Const(b"\xaa\x55"),
            "mt" / BitStruct(first, "start" / BitsInteger(1) * "1: start packet, a turn begins"),
            "lsn" / Int8ul * "number of samples",
            "fsa" / angle() * "angle of the first sample",
            "lsa" / angle() * "angle of the last sample",
            "cs" / Int16ul,
            "samples" / Array(this.lsn, sample),
        ),
        field="cs",
        algorithm=WordXor(head=8, groups=groups),
    )


DISTANCE = "distance" / Scaled(BitsInteger(14), 0.001, "m") * "0: no return"
DATA = data(
    "frequency"
    / Scaled(BitsInteger(7), 0.1, "Hz")
    * "of scans, in a start packet; firmware number in the next packet; else 0",
    ByteSwapped(
        BitStruct(
            DISTANCE, "intensity" / BitsInteger(8), "exposure" / BitsInteger(2) * "1 high, 2 low"
        )
    ),
    (1, 2),
)
OLDER_DATA = data(
    "reserved" / BitsInteger(7),
    ByteSwapped(BitStruct(DISTANCE, "flags" / BitsInteger(2) * "not explained")),
    (2,),
)


def ack_plausible(f: Fields) -> Any:
    """Modes of commands are F0 to FF, and the answer's is that with A0 taken off (manual 2.1.3,
    SDK).
    """
    return (f.mode >= 0x50) & (f.mode <= 0x5F)


def plausible(f: Fields) -> Any:
    """Angles below 360 degrees, a sample at least, and in a start packet one alone (manual 2.2.3,
    M&T).
    """
    return (
        (f.fsa.angle < 360)
        & (f.lsa.angle < 360)
        & (f.lsn >= 1)
        & ((f.mt.start == 0) | (f.lsn == 1))
    )


def correction(distance: Any) -> Any:
    """Return the angle correction in degrees for a distance in metres, 0 where there is no return.

    Source: manual 2.2.3, AngCorrect; the distance there is in millimetres.
    """
    mm = np.maximum(distance * 1000, 1)
    return np.where(distance > 0, np.rad2deg(np.arctan(19.16 * (mm - 90.15) / (90.15 * mm))), 0)


def directions(f: Fields, zero: str) -> tuple[Any, Any]:
    """Even steps from FSA to LSA, and those corrected (manual 2.2.3), from the zero of the data or
    from the one marked on the housing.
    """
    raw = spread(f.fsa.angle, f.lsa.angle, f.lsn, full=360.0)  # degrees, (n, LSN)
    clockwise = raw - np.where(f.state.info.correction == 1, correction(f.samples.distance), 0)
    return raw, clockwise + f.state.info.zero_angle if zero == "housing" else clockwise


def points(f: Fields, zero: str = "data") -> Polar:
    """The points of a packet, and their times by the speed that the last start packet told."""
    raw, clockwise = directions(f, zero)
    rate = (
        last(f.mt.frequency, where=(f.mt.start == 1) & (f.mt.frequency > 0)) * 360
    )  # degrees per second
    return Polar(
        range=f.samples.distance,
        azimuth=-np.deg2rad(clockwise),  # clockwise (manual, section 1a)
        intensity=f.samples.intensity,
        time=np.nan_to_num((raw - f.fsa.angle) / rate),
    )


def older_points(f: Fields, zero: str = "data") -> Polar:
    """Return the points of a packet of the older kind, which all have the time of their packet."""
    return Polar(range=f.samples.distance, azimuth=-np.deg2rad(directions(f, zero)[1]))


def configure(
    points: Callable[..., Polar],
    sensor: Sensor,
    /,
    *,
    zero: Literal["data", "housing"] = "data",
) -> Sensor:
    """Return the sensor with angles from the zero of the data, as on the wire, or the housing.

    Source: manual 2.2.2, bytes 13 and 14; it does not say whether the host should add the angle.
    """
    return dataclasses.replace(sensor, points=partial(points, zero=zero))


def sweep(i: int, steps: int = STEPS, hertz: float = LOW_SPEED) -> dict[str, float]:
    """Packet i of turns of so many points, 5.5 Hz is the slower speed: a start packet, then packets
    of 25 samples and a shorter one.
    """
    packet = i % (1 + -(-(steps - 1) // SAMPLES))
    first = 0 if packet == 0 else 1 + (packet - 1) * SAMPLES
    samples = 1 if packet == 0 else min(SAMPLES, steps - first)
    return {
        "mt.frequency": hertz if packet == 0 else 0.0,
        "mt.start": int(packet == 0),
        "lsn": samples,
        "fsa.angle": first * 360 / steps,
        "lsa.angle": (first + samples - 1) * 360 / steps,
        "samples.exposure": LOW_EXPOSURE,
    }


def older_sweep(i: int) -> dict[str, float]:
    """Packet i of the older kind, in turns like those of the newer one."""
    return {
        name: value
        for name, value in sweep(i).items()
        if name not in ("mt.frequency", "samples.exposure")
    }


def asking(mode: int, **more: Any) -> Command:
    """The command of this mode that is answered with an acknowledgement of the same mode; sent
    twice, it does the same once.
    """
    return Command(
        "command", {"mode": mode}, reply="ack", matches={"mode": mode ^ 0xA0}, retries=1, **more
    )


def make_start_packets(
    firmware: int, model: bytes, revision: int, *noise: bytes
) -> tuple[Any, ...]:
    """What a sensor sends when it is started: fillers while the speed settles, noise, and what it
    is (manual 1b, 2.1.3 and 2.2).
    """
    return (
        ("ack", {"firmware": firmware}),
        SETTLING,
        *noise,
        ("info", {"model": model, "revision": revision}),
        "scan_start",
    )


def tells_state(f: Fields) -> Any:
    """Whether a packet that begins no turn says what a CSPC says at most in the first one after a
    start (manual 2.2.3, M&T).
    """
    return (f.mt.start == 0) & (f.mt.frequency > 0)


# the packet is the same, and the bits of a sample mean something else (YDLIDAR SDK, communication
# protocol)
TMINI = Relative(
    "bits are set beside the lowest of the third byte in packets that begin no turn", tells_state
)
OTHERS: dict[str, str | Relative] = {
    **dict.fromkeys(("ydlidar-g2", "ydlidar-g4b", "ydlidar-s4b"), "the answers to its requests"),
    **dict.fromkeys(("ydlidar-tmini", "ydlidar-tmini-pro", "ydlidar-tmini-plus"), TMINI),
}

COINS = ("cspc-coin-d4", "cspc-coin-d4a", "cspc-coin-d6")
VERSION = (("ack", {"firmware": 3}),)

M1C1_MINI = Sensor(
    "cspc-m1c1-mini",
    vendor="CSPC",
    model="M1C1_Mini",
    frames={
        "ack": Frame(ack(b"\xa5\x5a"), plausible=ack_plausible),
        "info": Frame(INFO),
        "scan_start": Frame(SCAN_START),
        "data": Frame(DATA, data=True, max_length=10 + 3 * 255, plausible=plausible),
        "command": Frame(COMMAND, direction="out"),
    },
    points=points,
    scan=OnFlag("mt.start"),
    # 150 000 for this 3-byte format and DTR low: the SDK; 115 200: v1.1, for the older 2-byte
    # format.
    links={"data": Serial(150_000, 115_200, dtr=False)},
    commands={
        "start": asking(0xF0, starts=True),
        "stop": asking(0xF5, stops=True),
        "low_exposure": Command("command", {"mode": 0xF1}),
        "high_exposure": Command("command", {"mode": 0xF2}),
        "get_version": asking(0xFC),
    },
    fillers=b"\xfe\xff",
    state={
        "info": {"correction": 1, "zero_angle": 12}
    },  # the device information printed in the manual, 2.2.2
    simulation=Simulation(
        sweep, answers={"start": make_start_packets(3, b"M1C1_Mini", 4), "get_version": VERSION}
    ),
    configure=partial(configure, points),
    on_open=("start",),
    on_close=("stop",),
    range_limits=(0.001, 16.383),  # what the field can hold; the manual gives none
    vendor_axes=("forward", "right", "up"),
    turn=(LOW_SPEED, 7.0),  # manual 1c
    relatives={**dict.fromkeys(COINS, "info.model"), **OTHERS},
    info={
        "model": "info.model",
        "firmware": "info.revision",
    },  # ack.firmware is 0 but in the answer to start (manual 2.1.3)
    status="vectors",
    source=(
        "CSPC M1C1_Mini development manual (3-byte samples), sections 1 and 2; baud rate and FC"
        " from the vendor's SDK"
    ),
)


# two bytes a sample, like these; an M1C1_Mini says what it is when it is started, and never how
# fast it turns
MODELS_2 = "f4 g1 g2a g2c g4 g4-pro g4c g5 g6 g7 s2 s4 tg15 tg30 tg50 tx20 tx8 x2 x3 x4 x4-pro"
TELLS_SPEED = Relative(
    "start packets tell how fast it turns",
    lambda f: np.asarray((f.mt.start == 1) & (f.mt.reserved > 0)).any(),
)
M1C1_MINI_V11 = Sensor(
    "cspc-m1c1-mini-v11",
    vendor="CSPC",
    model="M1C1_Mini",
    frames={
        "ack": Frame(ack(b"\xaa\x55"), plausible=ack_plausible),
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
    relatives={f"ydlidar-{name}": TELLS_SPEED for name in MODELS_2.split()},
    info=M1C1_MINI.info,
    status="vectors",
    source=(
        "CSPC M1C1_Mini development manual v1.1 (2020-01-22), sections 1 and 2; baud rate and DTR"
        " from the vendor's SDK"
    ),
)


def coin(model: str, **facts: Any) -> Sensor:
    """A time-of-flight lidar of the COIN series: an M1C1_Mini but for these facts, whose angles
    need no correction.
    """
    name = f"cspc-{model.lower()}"
    return dataclasses.replace(
        M1C1_MINI,
        id=name,
        model=model,
        links={"data": Serial(230_400, dtr=False)},
        state={
            "info": {"correction": 0, "zero_angle": 0}
        },  # the device information of a live COIN-D4
        relatives={**dict.fromkeys({"cspc-m1c1-mini", *COINS} - {name}, "info.model"), **OTHERS},
        **{
            "turn": None,
            "simulation": coin_simulation(model),
            **facts,
        },  # the manual's two speeds are the M1C1_Mini's
    )


def coin_simulation(model: str, **turns: Any) -> Simulation:
    """Return a simulated one, which says what it is when it is started."""
    answers = {
        "start": make_start_packets(1, model.encode(), 1, b"\xfa\xfa"),
        "get_version": VERSION,
    }
    return Simulation(partial(sweep, **turns), answers=answers)


COIN_D4 = coin(
    "COIN-D4",
    status="capture",
    source=(
        "the M1C1_Mini's manual; baud rate from the vendor's SDK; a captured start-up of a COIN-D4"
    ),
)
COIN_D4A = coin(
    "COIN-D4A",
    range_limits=(0.001, 12.0),
    status="manual",
    source="the vendor's driver, ros_cspc_lidar_coin_d4a: baud rate, 12 m",
)
COIN_D6 = coin(
    "COIN-D6",
    frames={
        **M1C1_MINI.frames,
        "auxiliary": Frame(
            AUXILIARY, simulation=Simulation(lambda i: {"value": 0x38 + i % 8}, rate=1 / 3)
        ),
    },
    simulation=coin_simulation("COIN-D6", steps=400, hertz=10.0),
    status="manual",
    source=(
        "the vendor's SDK (baud rate); what others saw of a COIN-D6: turns, points, the auxiliary"
        " frame"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The CSPC sensors."""
    return [M1C1_MINI, M1C1_MINI_V11, COIN_D4, COIN_D4A, COIN_D6]
