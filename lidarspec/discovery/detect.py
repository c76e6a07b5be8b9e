"""Which installed sensor sent these bytes: each is tried, and what passes checksum and plausibility is counted.

Sensors with the same frames are told apart by how fast their clocks run, and by the names that their frames hold. A clock that advances
from packet to packet as the sensor's own `sweep` says tells models apart that differ in speed. A name is what a field of text holds, or
what the author's remark calls the value of a field ("0x22 NAME"). The clock comes first: bytes that name a model are not always true.

Bytes that were given to be looked at, frame by frame, and are exactly one frame of a sensor are that sensor's (`fitting`). Where no
sensor fits, the one whose frame they begin like is said to be nearest.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.device.settings import named
from lidarspec.discovery.listen import Heard, hear
from lidarspec.errors import CommandError, LidarSpecError, UsageError, WireError, suggest
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import VALID, Found
from lidarspec.plugins import sensors
from lidarspec.simulation.simulator import simulate
from lidarspec.spec.construct_layer import leaves
from lidarspec.spec.links import Serial
from lidarspec.spec.sensor import Sensor
from lidarspec.spec.tree import FieldInfo
from lidarspec.transports.base import data_link
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.open_url import live_address, resolved, transport
from lidarspec.transports.protocol import no_bytes
from lidarspec.transports.simulated import SimulatedTransport
from lidarspec.wire.parse import parse_typed
from lidarspec.wire.schema import schema

#: share by which the pace of a clock may be off, frames of a type that are looked into for names, and packets simulated.
OFF, READ, PACKETS = 0.03, 3, 64
_VALUE = re.compile(r"\b(0x[0-9a-fA-F]+|\d+)\s+([^,;:]+)")
#: bytes that an error shows.
SHOWN = 16
#: share of the bytes that has to be in a sensor's frames for it to fit, how close to the best another is as good, and what is beyond doubt.
FITS, AS_GOOD, CLEAR = 0.2, 0.01, 0.9


def told_apart(candidates: Sequence[Sensor], found: Sequence[Found]) -> dict[str, str]:
    """The candidates that the frames speak for, by id, each with why; empty where the frames say nothing.

    Args:
        candidates: sensors whose frames these are alike.
        found: frames in the order of their arrival.
    """
    by_clock = {sensor.id: why for sensor in candidates if (why := _by_clock(sensor, found))}
    if by_clock and len(by_clock) < len(candidates):
        return by_clock
    by_name = {sensor.id: why for sensor in candidates if (why := _by_name(sensor, found))}
    return by_name if len(by_name) < len(candidates) else {}


def _by_clock(sensor: Sensor, found: Sequence[Found]) -> str:
    """Why the clock in the frames is this sensor's, "" where it is not."""
    expected = _pace(sensor.id, sensor) if sensor.clock is not None else None
    data = [item for item in found if item.frame == sensor.data_frame]
    if expected is None or len(data) < 3:
        return ""
    follows = np.array([after.offset == item.offset + len(item.data) for item, after in itertools.pairwise(data)])
    steps = _steps(sensor, [item.data for item in data])[follows]
    steps = steps[(steps >= 0) & (steps <= 10 * expected)]
    if len(steps) < 2 or steps.mean() <= 0:
        return ""
    step, grain = float(steps.mean()), min(float(np.ptp(steps)), expected)  # a coarse clock is as uneven as its steps
    if abs(step - expected) > OFF * expected + grain / (2 * len(steps) ** 0.5):
        return ""
    return f"its clock advances by {step / 1e6:.3g} ms a packet"


@functools.lru_cache(maxsize=256)
def _pace(sensor_id: str, sensor: Sensor) -> float | None:
    """Nanoseconds by which the sensor's clock advances a packet, None where nobody knows."""
    try:
        steps = _steps(sensor, simulate(sensor, PACKETS))
    except LidarSpecError:
        return None
    steps = steps[steps >= 0]
    return float(steps.mean()) if len(steps) and steps.mean() > 0 else None


def _steps(sensor: Sensor, data: Sequence[bytes]) -> NDArray[np.int64]:
    """By how many ns the clock advances from packet to packet."""
    return np.diff(sensor.decode(list(data)).time_ns)


def _by_name(sensor: Sensor, found: Sequence[Found]) -> str:
    """Why the frames name this sensor, "" where they do not."""
    model, read = _plain(sensor.model), dict.fromkeys(sensor.frames, 0)
    for item in found:
        if read.get(item.frame, READ) >= READ:
            continue
        read[item.frame] += 1
        for path, text in _texts(sensor.parse(item.data, item.frame), schema(sensor.frames[item.frame].tree).fields):
            if _plain(text) == model:
                return f"{item.frame}.{path} says {text}"
    return ""


def _texts(parsed: Any, fields: Mapping[str, FieldInfo]) -> Iterator[tuple[str, str]]:
    """The fields outside arrays that hold a text, or a number with a meaning, and what they say."""
    for keys, value in leaves(parsed):
        path = ".".join(map(str, keys))
        if isinstance(value, bytes) and path in fields:
            text = value.split(b"\0")[0].decode("ascii", "replace")
            if text.isprintable() and text:
                yield path, text
        elif isinstance(value, int) and path in fields:
            info = fields[path]
            meanings = {int(number, 0): text.strip() for number, text in _VALUE.findall(info.docs)} | dict(info.labels)
            if value in meanings:
                yield path, str(meanings[value])


def _plain(text: str) -> str:
    return re.sub(r"[\W_]", "", text).lower()


@dataclass(frozen=True)
class Score:
    """How well a sensor fits: the share of the bytes in its frames, the number of its data frames, and what else speaks for it."""

    sensor: Sensor
    share: float
    data_frames: int
    found: tuple[Found, ...] = ()
    why: str = ""


@dataclass(frozen=True)
class Verdict:
    """Whose bytes were heard.

    Attributes:
        heard: the bytes.
        scores: every sensor that fits, the best first.
        alike: those that cannot be told apart from the first one; one alone is it.
    """

    heard: Heard
    scores: tuple[Score, ...]
    alike: tuple[Score, ...]

    @property
    def sensor(self) -> Sensor | None:
        """The sensor, None where none fits or several do."""
        return self.alike[0].sensor if len(self.alike) == 1 else None

    @property
    def is_clear(self) -> bool:
        """Whether no other baud rate has to be tried."""
        return bool(self.scores) and self.scores[0].share >= CLEAR and self.scores[0].data_frames > 1


def scores(chunks: Sequence[bytes], *, datagrams: bool) -> list[Score]:
    """Every installed sensor of which a data frame was found, the best first."""
    known = [sensor for sensor in sensors().values() if any(frame.direction == "in" for frame in sensor.frames.values())]
    found = _each(known, lambda sensor: _score(sensor, chunks, datagrams=datagrams))
    if not any(score.share >= FITS for score in found):
        found += _each(known, lambda sensor: _from_the_middle(sensor, chunks, datagrams=datagrams))
    return sorted(found, key=lambda score: (-score.share, score.sensor.id))


def _each(known: Sequence[Sensor], scored: Callable[[Sensor], Score | None]) -> list[Score]:
    """The score of each sensor; those with the very same frames share one."""
    shared: dict[object, Score | None] = {}
    for sensor in known:
        frames = (sensor.fillers, *((name, id(frame.struct), frame.plausible, frame.after) for name, frame in sensor.frames.items()))
        if frames not in shared:
            shared[frames] = scored(sensor)
        if (score := shared[frames]) is not None:
            shared[sensor.id] = replace(score, sensor=sensor)
    return [score for key, score in shared.items() if isinstance(key, str) and score is not None]


def _score(sensor: Sensor, chunks: Sequence[bytes], *, datagrams: bool) -> Score | None:
    decoder = sensor.decoder(stream=not datagrams)
    items = [item for chunk in chunks for item in decoder.feed(chunk)] + decoder.finish()
    number = sum(decoder.stats.frames.get(name, 0) for name in sensor.data_frames)
    return Score(sensor, 1 - decoder.stats.bytes_skipped / decoder.stats.bytes_in, number, tuple(items)) if number else None


def _from_the_middle(sensor: Sensor, chunks: Sequence[bytes], *, datagrams: bool) -> Score | None:
    """The best score of a sensor whose data frames come after others, as if one of those had been seen before."""
    answers = [name for name in sensor.data_frames if sensor.frames[name].after is not None]
    scored = [_score(sensor.configure(answer=name), chunks, datagrams=datagrams) for name in answers]
    best = max((score for score in scored if score is not None), key=lambda score: score.share, default=None)
    return None if best is None else replace(best, sensor=sensor)


def verdict(heard: Heard) -> Verdict:
    """Whose bytes were heard: by the frames, then by clocks and names in them, then by the baud rate."""
    fitting = [score for score in scores(heard.chunks, datagrams=heard.datagrams) if score.share >= FITS]
    best = [score for score in fitting if score.share >= fitting[0].share - AS_GOOD]
    alike = best
    if len(best) > 1:
        reasons = told_apart([score.sensor for score in best], best[0].found)
        alike = [replace(score, why=reasons[score.sensor.id]) for score in best if score.sensor.id in reasons] or best
        if len(alike) > 1 and heard.baud is not None:
            why = f"it runs at {heard.baud} baud"
            links = [(score, data_link(score.sensor, Serial)) for score in alike]
            alike = [replace(score, why=why) for score, link in links if link and heard.baud in link.bauds] or alike
    others = [score for score in fitting if score.sensor.id not in {one.sensor.id for one in alike}]
    return Verdict(heard, (*alike, *others), tuple(alike))


def verdicts(source: str | Path, *, seconds: float | None = None) -> list[Verdict]:
    """Whose bytes come from a source, one verdict for each sender; of a serial port, at the baud rate that fits best.

    Raises:
        SourceError: where it cannot be opened.
    """
    tried: list[Verdict] = []
    for heard in hear(source) if seconds is None else hear(source, seconds=seconds):
        tried.append(verdict(heard))
        if heard.baud is not None and tried[-1].is_clear:
            break
    if len({one.heard.baud for one in tried}) > 1:
        return [best(tried)]
    return tried


def best(tried: Sequence[Verdict]) -> Verdict:
    """The verdict whose first sensor has the most of the bytes in its frames; of those without a sensor, the one on most bytes."""
    return max(tried, key=lambda one: (one.scores[0].share if one.scores else 0.0, one.heard.size))


def detected(source: str | Path) -> Sensor:
    """The one installed sensor whose frames come from a source; a recording says it itself, where it was made with one.

    Raises:
        CommandError: where nothing comes from a live source.
        WireError: where none fits.
        UsageError: where several fit equally well: they are listed.
        SourceError: where it cannot be opened.
    """
    told = declared(source)
    if told is not None:
        return told
    found = verdicts(resolved(source))
    fitting = [one for one in found if one.scores]
    if not fitting:
        raise _nothing(str(source), found)
    if len({one.sensor.id for one in fitting if one.sensor}) > 1:
        listed = ", ".join(f"{one.sensor.id} ({one.heard.sender})" for one in fitting if one.sensor)
        raise UsageError(f"{source}: several sensors send, {listed}; choose one with ?src=ADDRESS and -s")
    alike = fitting[0].alike
    if len(alike) > 1:
        raise UsageError(f"{source}: {', '.join(one.sensor.id for one in alike)} send the same frames; name the sensor with -s")
    return alike[0].sensor


def declared(source: str | Path) -> Sensor | None:
    """The sensor that a source names itself: a device of `lidarspec.toml`, a recording, a simulated sensor; None for any other.

    Raises:
        UsageError: for standard input.
        SourceError: for a file that cannot be opened.
    """
    device = named(source)
    configured = device.configured() if device is not None else None
    if configured is not None:
        return configured
    if str(source) == "-":
        raise UsageError("name the sensor with -s: standard input can be read only once")
    address = live_address(source)
    if address is not None and address.scheme != "sim":
        return None
    opened = transport(source)
    opened.close()
    if isinstance(opened, RecordingTransport) and opened.header.sensor:
        return opened.header.known_sensor()
    return opened.sensor if isinstance(opened, SimulatedTransport) else None


def _nothing(source: str, found: Sequence[Verdict]) -> Exception:
    """What to say where no sensor fits."""
    heard = max((one.heard for one in found), key=lambda one: one.size, default=Heard(source))
    if heard.size:
        return WireError(f"{source}: no installed sensor's frames are in it", data=heard.chunks[0][:SHOWN])
    if live_address(source) is None:
        return WireError(no_bytes(source, heard.warnings))
    error = CommandError(f"{source}: nothing comes; a sensor that has to be started first is named with -s")
    return suggest(error, f"lidarspec doctor {source}")


#: constant bits that make bytes look like a frame.
ALIKE = 8


def fitting(chunks: Sequence[bytes], *, datagrams: bool) -> list[Sensor]:
    """The installed sensors whose bytes these are, the best first; those with a type of exactly this frame before all others."""
    known = list(sensors().values())
    data = b"".join(chunks)
    whole = [sensor for sensor in known if any(_is_frame(sensor, name, data) for name in sensor.frames)]
    if whole:
        return whole
    found = scores(chunks, datagrams=datagrams) if data else []
    return [score.sensor for score in found if score.share >= found[0].share - AS_GOOD]


def nearest(data: bytes) -> WireError | None:
    """What the installed sensor that came farthest with some bytes says of them, with its id; None where none came far."""
    faults = []
    for sensor in sensors().values():
        try:
            parse_typed(sensor, data)
        except LidarSpecError as fault:
            faults += [fault] if isinstance(fault, WireError) else []
    return max((fault for fault in faults if _begins_alike(fault)), key=lambda fault: fault.offset, default=None)


def _is_frame(sensor: Sensor, name: str, data: bytes) -> bool:
    """Whether the bytes are exactly one valid and plausible frame of a type."""
    frame = sensor.frames[name]
    if not 0 < len(data) <= frame.max_length:
        return False
    engine = codec(frame)
    if any(spot >= len(data) or data[spot] & mask != value for spot, (mask, value) in engine.prefix.items()):
        return False
    survey = engine.survey(np.frombuffer(data, np.uint8), np.zeros(1, np.intp))
    return bool(survey.status[0] == VALID and survey.sizes[0] == len(data))


def _begins_alike(fault: WireError) -> bool:
    """Whether the bytes have the constants that the frame type begins with, and those are enough not to be chance."""
    if not fault.frame:
        return False
    prefix = codec(sensors()[fault.sensor].frames[fault.frame]).prefix
    there = [(fault.data[spot], mask, value) for spot, (mask, value) in prefix.items() if spot < len(fault.data)]
    return all(byte & mask == value for byte, mask, value in there) and sum(mask.bit_count() for _, mask, _ in there) >= ALIKE
