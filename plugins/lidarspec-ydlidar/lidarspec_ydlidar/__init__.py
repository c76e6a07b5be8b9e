"""YDLIDAR's 360 degree lidars over a UART: one packet, with samples in eight forms; most models are started by a request.

Source: YDLIDAR SDK: "YDLidar-SDK Communication Protocol" (packets, requests, answers), "Dataset" (bauds, rates, ranges and
turns of the models), core/common/ydlidar_protocol.h (stamps), core/common/DriverInterface.h (numbers of models).

Known errors and gaps: the angles of the protocol's example, 217.0178 and 235.6326 degrees, are 217.0191 and 235.6313 by its
own formula; health is asked with 92 in the SDK and with 91 in older manuals, a reset with 80 and 40; the order of the two
bytes of the firmware differs between manuals (a T-mini's 00 01 is 1.0). Packets do not say which form their samples have,
only how many bytes they are can be told: choose the model by its name. Models with one channel, which have no receiving
line, send by themselves.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from construct import Array, BitsInteger, BitStruct, Bytes, ByteSwapped, Const, Construct, Int8ul, Int16ul, Int32ul, Struct, this

from lidarspec.spec import (
    Checksummed,
    Command,
    Fields,
    Frame,
    OnFlag,
    Polar,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    WordXor,
    Xor,
    hookimpl,
    last,
    spread,
)
from lidarspec_ydlidar import samples
from lidarspec_ydlidar.samples import Form

FULL = 40  # samples of a full packet (protocol, LSN)
AFTER_STOP = 0.03  # seconds (SDK, stop)
AFTER_MOTOR = 0.5  # seconds (SDK, startMotor)


def angle() -> Construct:
    """FSA and LSA: 1/64 degree above a check bit that is always 1."""
    return ByteSwapped(BitStruct("angle" / Scaled(BitsInteger(15), 1 / 64, "deg"), "check" / Const(1, BitsInteger(1))))


def plausible(f: Fields) -> Any:
    """Angles below 360 degrees, a sample at least, and in a zero packet one alone."""
    return (f.fsa.angle < 360) & (f.lsa.angle < 360) & (f.lsn >= 1) & ((f.ct.start == 0) | (f.lsn == 1))


@cache
def data(form: Form) -> Frame:
    """The packet with samples of this form."""
    frequency = Scaled(BitsInteger(7), 0.1, "Hz", form.slowest)
    struct = Struct(
        "header" / Const(b"\xaa\x55"),
        "ct"
        / BitStruct(
            "frequency" / frequency * "of scans, in a zero packet; raw 0: not given",
            "start" / BitsInteger(1) * "1: zero packet, a turn begins",
        ),
        "lsn" / Int8ul * "number of samples",
        "fsa" / angle() * "angle of the first sample",
        "lsa" / angle() * "angle of the last sample",
        "cs" / Int16ul,
        "samples" / Array(this.lsn, form.struct),
    )
    sealed = Checksummed(struct, field="cs", algorithm=WordXor(head=8, groups=form.groups))
    return Frame(sealed, data=True, max_length=10 + form.size * 255, plausible=plausible)


def points(f: Fields, form: Form) -> Polar:
    """Even steps from FSA to LSA, corrected for the distance where the lidar triangulates ("angle analysis")."""
    raw = spread(f.fsa.angle, f.lsa.angle, f.lsn, full=360.0)  # degrees, (n, LSN)
    clockwise = raw if form.correction is None else raw + form.correction(f.samples.distance)
    rate = last(f.ct.frequency, where=(f.ct.start == 1) & (f.ct.frequency > form.slowest)) * 360  # degrees per second
    return Polar(
        range=f.samples.distance,
        azimuth=-np.deg2rad(clockwise),
        intensity=f.samples.intensity if form.intense else None,
        time=np.nan_to_num((raw - f.fsa.angle) / rate),
    )


def answer(kind: int, *fields: Construct, size: int) -> Frame:
    """The answer to a request, with its descriptor in front."""
    header = b"\xa5\x5a" + size.to_bytes(4, "little") + bytes([kind])
    return Frame(Struct("descriptor" / Const(header), *fields))


ANSWERS = {
    "scan_start": Frame(Struct("descriptor" / Const(b"\xa5\x5a\x05\x00\x00\x40\x81") * "packets follow without end")),
    "info": answer(
        0x04,
        "model" / Int8ul,
        "firmware" / Struct("minor" / Int8ul, "major" / Int8ul),
        "hardware" / Int8ul,
        "serial" / Bytes(16) * "a digit a byte",
        size=20,
    ),
    "health": answer(0x06, "status" / Int8ul * "0 good, 1 warning, 2 error", "error" / Int16ul, size=3),
    "speed": answer(0x04, "frequency" / Scaled(Int32ul, 0.01, "Hz") * "of scans", size=4),
    "rate": answer(0x04, "samples" / Int8ul * "number of the sampling rate", size=1),
}
STAMP = Frame(
    Checksummed(
        Struct("header" / Const(b"\xaa\x66"), "cs" / Int8ul, "time" / Scaled(Int32ul, 0.001, "s"), "reserved" / Bytes(1)),
        field="cs",
        algorithm=Xor(),
    )
)
REQUEST = Frame(Struct("start" / Const(b"\xa5"), "cmd" / Int8ul), direction="out")


def asking(cmd: int, reply: str | None = None, **more: Any) -> Command:
    """A request without payload; it does the same once when it is sent twice, unless it changes a speed."""
    return Command("request", {"cmd": cmd}, reply=reply, **more)


COMMANDS = {
    "start_motor": Command(lines={"dtr": True}, settle=AFTER_MOTOR),
    "stop_motor": Command(lines={"dtr": False}),
    "scan": asking(0x60, "scan_start", retries=1, starts=True),
    "force_scan": asking(0x61, "scan_start", retries=1, starts=True),
    "stop": asking(0x65, stops=True, settle=AFTER_STOP),
    "get_info": asking(0x90, "info", retries=1, only_stopped=True),
    "get_health": asking(0x92, "health", retries=1, only_stopped=True),
    "reset": asking(0x80, stops=True),
    "faster": asking(0x09, "speed", only_stopped=True),
    "slower": asking(0x0A, "speed", only_stopped=True),
    "faster_1hz": asking(0x0B, "speed", only_stopped=True),
    "slower_1hz": asking(0x0C, "speed", only_stopped=True),
    "get_speed": asking(0x0D, "speed", retries=1, only_stopped=True),
    "next_rate": asking(0xD0, "rate", only_stopped=True),
    "get_rate": asking(0xD1, "rate", retries=1, only_stopped=True),
}


@dataclass(frozen=True)
class Model:
    """One row of the table of models.

    Attributes:
        form: of its samples.
        baud: of its line.
        rate: samples a second.
        range_limits: in metres.
        turn: the slowest and the fastest number of scans a second.
        number: what it calls itself in its information; 0: no public source says.
        one_channel: whether it only sends.
        proof: its status.
    """

    form: Form
    baud: int
    rate: float
    range_limits: tuple[float, float]
    turn: tuple[float, float]
    number: int = 0
    one_channel: bool = False
    proof: str = "manual"


MODELS = {
    "F4": Model(samples.TRIANGLE, 115_200, 4000, (0.12, 12), (5, 12), 1),
    "X2": Model(samples.TRIANGLE, 115_200, 3000, (0.1, 8), (4, 8), one_channel=True, proof="vectors"),
    "X3": Model(samples.TRIANGLE, 115_200, 3000, (0.1, 8), (4, 8), one_channel=True, proof="vectors"),
    "X4": Model(samples.TRIANGLE, 128_000, 5000, (0.12, 10), (5, 12), 6, proof="vectors"),
    "X4 Pro": Model(samples.TRIANGLE_FLAGGED, 128_000, 5000, (0.12, 10), (5, 12), one_channel=True),
    "S2": Model(samples.TRIANGLE, 115_200, 3000, (0.1, 8), (4, 8), one_channel=True, proof="vectors"),
    "S4": Model(samples.TRIANGLE, 115_200, 4000, (0.1, 8), (5, 12), 4, proof="vectors"),
    "S4B": Model(samples.TRIANGLE_8, 153_600, 4000, (0.1, 8), (5, 12), 11),
    "G1": Model(samples.TRIANGLE, 230_400, 9000, (0.28, 16), (5, 12), 19, proof="vectors"),
    "G2": Model(samples.TRIANGLE_8, 230_400, 5000, (0.28, 16), (5, 12), 15),
    "G2A": Model(samples.TRIANGLE, 230_400, 5000, (0.12, 12), (5, 12), 14),
    "G2C": Model(samples.TRIANGLE, 115_200, 4000, (0.1, 12), (5, 12), 16),
    "G4": Model(samples.TRIANGLE, 230_400, 9000, (0.1, 16), (5, 12), 5, proof="vectors"),
    "G4B": Model(samples.TRIANGLE_10, 512_000, 10_000, (0.12, 16), (5, 12), 17, proof="vectors"),
    "G4C": Model(samples.TRIANGLE, 115_200, 4000, (0.1, 12), (5, 12), 18),
    "G4 Pro": Model(samples.TRIANGLE, 230_400, 9000, (0.1, 16), (5, 12), 7),
    "G5": Model(samples.TRIANGLE, 230_400, 9000, (0.1, 16), (5, 12), 20),
    "G6": Model(samples.HALF, 512_000, 18_000, (0.1, 25), (5, 12), 13),
    "G7": Model(samples.HALF, 512_000, 18_000, (0.1, 25), (5, 12), 21),
    "TX8": Model(samples.TOF, 115_200, 4000, (0.1, 8), (4, 8), one_channel=True),
    "TX20": Model(samples.TOF, 115_200, 4000, (0.1, 20), (4, 8), one_channel=True),
    "TG15": Model(samples.TOF, 512_000, 20_000, (0.05, 30), (3, 15.7), 100, proof="vectors"),
    "TG30": Model(samples.TOF, 512_000, 20_000, (0.05, 30), (3, 15.7), 101),
    "TG50": Model(samples.TOF, 512_000, 20_000, (0.05, 50), (3, 15.7), 102),
    "T-mini": Model(samples.TOF_8, 230_400, 4000, (0.02, 12), (6, 12), 140),
    "T-mini Pro": Model(samples.TOF_8, 230_400, 4000, (0.02, 12), (6, 12), 150, proof="capture"),
    "T-mini Plus": Model(samples.TOF_8, 230_400, 4000, (0.05, 12), (6, 12), 151),
    "T-mini Plus SH": Model(samples.TOF_16, 230_400, 4000, (0.05, 12), (6, 12), 152),
}
SPEED = 6.0  # turns a second of simulated sensors, which all models can


def sweep(i: int, rate: float) -> dict[str, float]:
    """Packet i: of each turn a zero packet, then full ones and a shorter one."""
    steps = int(rate / SPEED)
    packet = i % (1 + -(-(steps - 1) // FULL))
    first = 0 if packet == 0 else 1 + (packet - 1) * FULL
    count = 1 if packet == 0 else min(FULL, steps - first)
    return {
        "ct.frequency": SPEED if packet == 0 else 0.0,
        "ct.start": int(packet == 0),
        "lsn": count,
        "fsa.angle": first * 360 / steps,
        "lsa.angle": (first + count - 1) * 360 / steps,
    }


def slug(name: str) -> str:
    """The id of a model: "T-mini Pro" is "ydlidar-tmini-pro"."""
    return "ydlidar-" + name.lower().replace("t-mini", "tmini").replace(" ", "-")


def told_by(one: Model, other: Model) -> str:
    """What tells two models apart whose samples have one size."""
    if one.number and other.number:
        return "info.model"
    return "nothing in their packets: the baud rate, the label on the housing"


def relatives(name: str) -> dict[str, str]:
    """The models whose packets look like this one's; a CSPC sends the packet with three bytes a sample as well."""
    own = MODELS[name]
    found = {slug(other): told_by(own, model) for other, model in MODELS.items() if other != name and model.form.size == own.form.size}
    return found | (dict.fromkeys(("cspc-m1c1-mini", "cspc-coin-d4"), "info, which a CSPC sends when it is started") if own.form.size == 3 else {})


def lidar(name: str) -> Sensor:
    """One row of the table as a sensor."""
    model = MODELS[name]
    talks = not model.one_channel
    return Sensor(
        slug(name),
        vendor="YDLIDAR",
        model=name,
        frames={**ANSWERS, "stamp": STAMP, "data": data(model.form), "request": REQUEST} if talks else {"data": data(model.form)},
        points=partial(points, form=model.form),
        scan=OnFlag("ct.start"),
        links={"data": Serial(model.baud)},
        commands=COMMANDS if talks else {},
        simulation=Simulation(partial(sweep, rate=model.rate), answers={"get_info": (("info", {"model": model.number}),)} if talks else {}),
        on_open=("start_motor", "stop", "scan") if talks else (),
        on_close=("stop", "stop_motor") if talks else (),
        range_limits=model.range_limits,
        vendor_axes=("forward", "right", "up"),
        turn=model.turn,
        relatives=relatives(name),
        info={"serial": "info.serial", "model": "info.model"} if talks else {},
        aliases=(slug(name).removeprefix("ydlidar-"),) if name.startswith("T-") else (),
        status=model.proof,
        source="YDLIDAR SDK: communication protocol, data set of models; data sheet" + ", a unit's packets" * (model.proof == "capture"),
    )


#: every model as an attribute, by what its id has after the vendor: `SENSORS.tmini_pro`.
SENSORS = SimpleNamespace(**{slug(name).removeprefix("ydlidar-").replace("-", "_"): lidar(name) for name in MODELS})


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The YDLIDAR models."""
    return vars(SENSORS).values()
