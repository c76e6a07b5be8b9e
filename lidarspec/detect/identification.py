"""Which installed sensor sent these bytes: each is tried, and what passes checksum and plausibility
is counted.

Sensors with the same frames are told apart by what they declare of their `relatives`: by packets
that only one of them sends, by how fast their clocks run, and by the model that their frames name,
in a text or by the author's remark on the value of a field ("0x22 NAME"). Where nothing of that was
seen, each may be it, and so may relatives that are not installed.

Bytes that were given to be looked at, frame by frame, and are exactly one frame of a sensor are
that sensor's (`fitting`). Where no sensor fits, the one whose frame they begin like is said to be
nearest.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.detect.heard import Heard
from lidarspec.detect.listen import LISTEN, hear, ignore
from lidarspec.detect.uninstalled import suggest_installation
from lidarspec.device.settings import named
from lidarspec.drafting.checksum_search import search
from lidarspec.errors import CommandError, LidarSpecError, UsageError, WireError, suggest
from lidarspec.expressions.columns import Fields
from lidarspec.frames.layout import Bytes2D, Seal, Sums
from lidarspec.frames.parse import identify
from lidarspec.frames.schema import schema
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import VALID, Found
from lidarspec.packets.packets import Packets
from lidarspec.plugins import registry, sensor as named_sensor, sensors
from lidarspec.simulation.simulator import simulate
from lidarspec.spec.description import Relative
from lidarspec.spec.links import Serial
from lidarspec.spec.sensor import Sensor
from lidarspec.spec.tree import FieldInfo
from lidarspec.transports.base import data_link
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.open_url import live_address, resolved, transport
from lidarspec.transports.protocol import no_bytes

#: share by which the pace of a clock may be off, frames of a type that are looked into for names,
#: and packets simulated.
OFF = 0.03
READ = 3
PACKETS = 64
_VALUE = re.compile(r"\b(0x[0-9a-fA-F]+|\d+)\s+([^,;:]+)")
#: bytes that an error shows.
SHOWN = 16
#: share of the bytes that has to be in a sensor's frames for it to fit, how close to the best
#: another is as good, and what is beyond doubt.
FITS = 0.2
AS_GOOD = 0.01
CLEAR = 0.9
#: data frames one after another that are no chance even where no checksum is right.
RHYTHM = 3


class Told(NamedTuple):
    """What frames say of the sensors that send such.

    Attributes:
        alike: those of the candidates that they may be of, by id, each with why; where it is one
            alone, what differs was seen.
        others: relatives of theirs that are not installed, and whose frames these may be; are,
            where `alike` is empty.
    """

    alike: dict[str, str]
    others: dict[str, str]


def told_apart(candidates: Sequence[Sensor], found: Mapping[str, Sequence[Found]]) -> Told:
    """What tells sensors with the same data frames apart: single packets that only one sends, then
    the pace of the clock, then names.

    Args:
        candidates: sensors whose data frames these are alike.
        found: frames as each of them reads the bytes, by id, in the order of their arrival.
    """
    ids = {sensor.id for sensor in candidates}
    shown = {sensor.id: _shown(sensor, found[sensor.id]) for sensor in candidates}
    left = [sensor for sensor in candidates if not shown[sensor.id]]
    if not left:
        return Told(
            {},
            {name: why for seen in shown.values() for name, why in seen.items() if name not in ids},
        )
    timed = _spoken_for(left, _by_clock, found)
    named_among = [sensor for sensor in left if sensor.id in timed] or left
    if len(timed) == 1:
        spoken_for = timed
    else:
        spoken_for = _spoken_for(named_among, _by_name, found) or timed
    if spoken_for:
        return Told(spoken_for, {})
    reasons = {name: why for seen in shown.values() for name, why in seen.items()}
    told = {
        name: text
        for sensor in left
        for name, text in sensor.relatives.items()
        if isinstance(text, str) and name not in ids
    }
    installed = registry()
    return Told(
        {sensor.id: reasons.get(sensor.id, "") for sensor in left},
        {name: text for name, text in told.items() if installed.find(name) is None},
    )


def contradiction(sensor: Sensor, found: Sequence[Found]) -> str:
    """That these frames are those of relatives and not the sensor's, with what says so, or name
    another model; "" where nothing does.
    """
    relatives = map(registry().find, sensor.relatives)  # loads their plugins alone
    alike = [sensor, *(relative for relative in relatives if relative is not None)]
    told = told_apart(alike, {one.id: found for one in alike})
    if sensor.id not in told.alike:
        return "the frames are those of " + " or ".join(
            f"{name} ({why})" for name, why in (told.alike or told.others).items()
        )
    names = _models(sensor, found)
    fits = any(
        _plain(part) in _plain(sensor.model)
        for name in names
        for part in re.split(r",| and ", name)
    )
    if fits or not names:
        return ""
    return f"{sensor.info['model']} says {names[0]}"


def _shown(sensor: Sensor, found: Sequence[Found]) -> dict[str, str]:
    """The relatives that most of the data frames can only be of, by id, each with what tells it."""
    single = {
        name: relative
        for name, relative in sensor.relatives.items()
        if isinstance(relative, Relative)
    }
    if single:
        data = [item.data for item in found if item.frame == sensor.data_frame]
    else:
        data = []
    if not data:
        return {}
    packets = sensor.decode(data)
    if not len(packets):
        return {}
    fields = Fields(packets.batch())
    return {
        name: relative.told_by
        for name, relative in single.items()
        if np.mean(np.asarray(relative.sends(fields))) > 0.5
    }


def _spoken_for(
    left: Sequence[Sensor],
    why: Callable[[Sensor, Sequence[Found]], str],
    found: Mapping[str, Sequence[Found]],
) -> dict[str, str]:
    """Those that the frames speak for in one way, by id, each with why; none where nothing does, or
    for all of several.
    """
    if len(left) == 1 and not left[0].relatives:
        return {}
    reasons = {sensor.id: reason for sensor in left if (reason := why(sensor, found[sensor.id]))}
    if len(left) == 1 or len(reasons) < len(left):
        return reasons
    return {}


def _by_clock(sensor: Sensor, found: Sequence[Found]) -> str:
    """Why the clock in the frames is this sensor's, "" where it is not."""
    data = [item for item in found if item.frame == sensor.data_frame]
    if sensor.clock is None or len(data) < 3:
        return ""
    packets = sensor.decode(
        list(
            dict.fromkeys(item.data for item in data)
            if sensor.datagrams
            else [item.data for item in data]
        )
    )
    if len(packets) < 3:
        return ""
    if sensor.clock.pace is None:
        expected = _pace(sensor.id, sensor)
    else:
        expected = _declared_pace(sensor.clock.pace, packets)
    if expected is None:
        return ""
    if sensor.datagrams:  # lost, doubled and swapped ones leave most steps as they were
        step = float(np.median(np.diff(np.sort(packets.time_ns))))
        grain = 0.0
    else:  # a clock may be coarse, and what is lost is seen
        follows = np.array(
            [
                after.offset == item.offset + len(item.data)
                for item, after in itertools.pairwise(data)
            ]
        )
        steps = np.diff(packets.time_ns)[follows]
        steps = steps[(steps >= 0) & (steps <= 10 * expected)]
        if len(steps) < 2:
            return ""
        step = float(steps.mean())
        grain = min(float(np.ptp(steps)), expected) / (
            2 * len(steps) ** 0.5
        )  # as uneven as its steps
    if abs(step - expected) > OFF * expected + grain:
        return ""
    return f"its clock advances by {step / 1e6:.3g} ms a packet"


@functools.lru_cache(maxsize=256)
def _pace(sensor_id: str, sensor: Sensor) -> float | None:
    """Nanoseconds by which the sensor's clock advances a packet in a simulation, None where it has
    none.
    """
    try:
        steps = np.diff(sensor.decode(simulate(sensor, PACKETS)).time_ns)
    except LidarSpecError:
        return None
    steps = steps[steps >= 0]
    if len(steps) and steps.mean() > 0:
        return float(steps.mean())
    return None


def _declared_pace(pace: Callable[[Any], Any], packets: Packets) -> float:
    """Nanoseconds by which the clock advances a packet, as most of the packets say."""
    return float(np.median(np.asarray(pace(Fields(packets.batch())), np.float64))) * 1e9


def _by_name(sensor: Sensor, found: Sequence[Found]) -> str:
    """Why the frames name this sensor as their model, "" where they do not."""
    return next(
        (
            f"{sensor.info['model']} says {text}"
            for text in _models(sensor, found)
            if _plain(text) == _plain(sensor.model)
        ),
        "",
    )


def _models(sensor: Sensor, found: Sequence[Found]) -> list[str]:
    """The models that the first frames name, as far as they name any; a relative may send another
    frame under the same name.
    """
    frame, _, field = sensor.info.get("model", "").partition(".")
    names = []
    for item in itertools.islice((item for item in found if item.frame == frame), READ):
        try:
            names.append(_text(*_field(sensor, item, field)))
        except WireError:
            continue
    return [name for name in names if name]


def said(sensor: Sensor, found: Iterable[Found]) -> dict[str, str]:
    """What the last of these frames say of the device itself, as the sensor's `info` declares: role
    -> text, a number with its unit.
    """
    last = {item.frame: item for item in found}
    told = dict[str, str]()
    for role, path in sensor.info.items():
        frame, _, field = path.partition(".")
        if frame in last:
            value, info = _field(sensor, last[frame], field)
            if isinstance(value, list):
                told[role] = ".".join(map(str, value))  # a version
            elif isinstance(value, bytes):
                text = value.rstrip(b"\0 ")
                if text.isascii() and text.decode("ascii").isprintable():
                    told[role] = text.decode("ascii")
                else:
                    told[role] = value.hex()
            else:
                told[role] = _text(value, info) or (
                    f"{info.physical(value):g} {info.unit}".rstrip()
                    if isinstance(value, int | float)
                    else f"{value}"
                )
    return {role: text for role, text in told.items() if text}


def _field(sensor: Sensor, item: Found, path: str) -> tuple[Any, FieldInfo]:
    """The raw value of a field of a frame, or of the first of its parts that has it ("" where none
    has), and what is known of the field.
    """
    fields = schema(sensor.frames[item.frame].tree)
    parsed = sensor.parse(item.data, item.frame)
    axis, _, rest = fields.within(path) or ("", "", path)
    if axis:
        wholes = [part for part in _at(parsed, axis) if rest.partition(".")[0] in part]
    else:
        wholes = [parsed]
    return next((_at(whole, rest) for whole in wholes), ""), fields.named[path]


def _at(parsed: Any, path: str) -> Any:
    return functools.reduce(lambda above, name: above[name], path.split("."), parsed)


def _text(value: Any, info: FieldInfo) -> str:
    """What a field says: its text, or the meaning of its number."""
    if isinstance(value, bytes):
        return value.split(b"\0")[0].decode("ascii", "replace")
    meanings = {int(number, 0): text.strip() for number, text in _VALUE.findall(info.docs)} | dict(
        info.labels
    )
    return str(meanings.get(value, ""))


def _plain(text: str) -> str:
    return re.sub(r"[\W_]", "", text).lower()


@dataclass(frozen=True)
class Score:
    """How well a sensor fits: the share of the bytes in its frames, the number of its data frames,
    and what else speaks for it.
    """

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
        alike: those that it may be.
        others: relatives of theirs, by id, each with what tells it apart, that are not installed:
            it may be one of them too; where `alike` is empty it is one.
        fault: what is wrong with frames that are a sensor's but for their checksums; "" where there
            are none.
    """

    heard: Heard
    scores: tuple[Score, ...] = ()
    alike: tuple[Score, ...] = ()
    others: Mapping[str, str] = field(default_factory=dict)
    fault: str = ""

    @property
    def sensor(self) -> Sensor | None:
        """The sensor, None where none fits or several do."""
        if len(self.alike) == 1 and not self.others:
            return self.alike[0].sensor
        return None

    @property
    def is_clear(self) -> bool:
        """Whether no other baud rate has to be tried."""
        return (
            bool(self.scores) and self.scores[0].share >= CLEAR and self.scores[0].data_frames > 1
        )


def scores(chunks: Sequence[bytes], *, datagrams: bool) -> list[Score]:
    """Every installed sensor of which a data frame was found, the best first."""
    known = _readable()
    found = _each(known, lambda sensor: _score(sensor, chunks, datagrams=datagrams))
    if not any(score.share >= FITS for score in found):
        found += _each(known, lambda sensor: _from_the_middle(sensor, chunks, datagrams=datagrams))
    return sorted(found, key=lambda score: (-score.share, score.sensor.id))


def _readable() -> list[Sensor]:
    """The installed sensors that have frames before they are configured."""
    return [sensor for sensor in sensors().values() if sensor.incoming]


def never_right(chunks: Sequence[bytes], *, datagrams: bool) -> str:
    """What to say of bytes that are the frames of a sensor but for their checksums, which are never
    right; "" of all others.
    """
    as_stored = _each(
        _readable(), lambda sensor: _score(sensor, chunks, datagrams=datagrams, sums=_stored)
    )
    found = [score for score in as_stored if score.share >= CLEAR and score.data_frames >= RHYTHM]
    if not found or _score(found[0].sensor, chunks, datagrams=datagrams) is not None:
        return ""
    kinds = [item.frame for item in found[0].found]
    most = max(set(kinds), key=kinds.count)
    frames = [item.data for item in found[0].found if item.frame == most]
    ids = " or ".join(score.sensor.id for score in found)
    text = (
        f"{len(frames)} {most} frames of {ids} by their constants, lengths and rhythm, and their"
        " checksums are never right"
    )
    match = next(iter(search(frames, quick=True)), None)
    if match is None:
        return f"{text}; no other checksum was found at the usual places"
    length = len(frames[0])
    covered = sum(last - first for first, last in match.span.ranges(match.place, length))
    where = (
        f"{match.algorithm.describe()} in {match.place} is right in {match.right} of {match.total}"
    )
    return (
        f"{text}: {where}, over {covered} of the {length - match.place.size} other bytes"
        f" ({match.span.told(match.place, length)})"
    )


def _stored(seal: Seal, rows: Bytes2D) -> NDArray[np.uint64]:
    """The checksums that stand in the frames, whatever they are, in place of those that should."""
    return seal.stored(rows)


def _each(known: Sequence[Sensor], scored: Callable[[Sensor], Score | None]) -> list[Score]:
    """The score of each sensor; those with the very same frames share one."""
    shared: dict[object, Score | None] = {}
    for sensor in known:
        frames = (
            sensor.fillers,
            *(
                (name, id(frame.struct), frame.plausible, frame.after)
                for name, frame in sensor.frames.items()
            ),
        )
        if frames not in shared:
            shared[frames] = scored(sensor)
        if (score := shared[frames]) is not None:
            shared[sensor.id] = replace(
                score,
                sensor=sensor.configure(**score.sensor.options) if score.sensor.options else sensor,
            )
    return [score for key, score in shared.items() if isinstance(key, str) and score is not None]


def _score(
    sensor: Sensor, chunks: Sequence[bytes], *, datagrams: bool, sums: Sums | None = None
) -> Score | None:
    if sensor.recognise is not None and datagrams and (options := sensor.recognise(tuple(chunks))):
        sensor = sensor.configure(**options)
    decoder = Decoder(sensor, stream=not datagrams, sums=sums)
    # All at once: chunk by chunk takes ten times as long.
    if datagrams:
        items = decoder.datagrams(chunks).found()
    else:
        items = decoder.feed(b"".join(chunks))
    items += decoder.finish()
    number = sum(decoder.stats.frames.get(name, 0) for name in sensor.data_frames)
    if number:
        return Score(
            sensor, 1 - decoder.stats.bytes_skipped / decoder.stats.bytes_in, number, tuple(items)
        )
    return None


def _from_the_middle(sensor: Sensor, chunks: Sequence[bytes], *, datagrams: bool) -> Score | None:
    """The best score of a sensor whose data frames come after others, configured as if one of those
    had been seen before.
    """
    answers = [name for name in sensor.data_frames if sensor.frames[name].after is not None]
    scored = [
        _score(sensor.configure(answer=name), chunks, datagrams=datagrams) for name in answers
    ]
    return max(
        (score for score in scored if score is not None),
        key=lambda score: score.share,
        default=None,
    )


def verdict(heard: Heard) -> Verdict:
    """Whose bytes were heard: by the frames, then by clocks and names in them, then by the baud
    rate.
    """
    fitting = [
        score for score in scores(heard.chunks, datagrams=heard.datagrams) if score.share >= FITS
    ]
    best = [score for score in fitting if score.share >= fitting[0].share - AS_GOOD]
    if not best:
        return Verdict(heard, fault=never_right(heard.chunks, datagrams=heard.datagrams))
    told = told_apart(
        [score.sensor for score in best], {score.sensor.id: score.found for score in best}
    )
    alike = [
        replace(score, why=told.alike[score.sensor.id])
        for score in best
        if score.sensor.id in told.alike
    ]
    if len(alike) > 1 and heard.baud is not None:
        why = f"it runs at {heard.baud} baud"
        links = [(score, data_link(score.sensor, Serial)) for score in alike]
        alike = [
            replace(score, why=why) for score, link in links if link and heard.baud in link.bauds
        ] or alike
    alike = [
        replace(
            score,
            why=score.why
            or ", ".join(f"{name}={value}" for name, value in score.sensor.options.items()),
        )
        for score in alike
    ]
    # Of many with the same frames, it is likelier one of the vendor that makes most of them.
    vendors = [score.sensor.vendor for score in alike]
    alike.sort(key=lambda score: (-vendors.count(score.sensor.vendor), score.sensor.id))
    ruled_out = [
        score for score in fitting if score.sensor.id not in {one.sensor.id for one in alike}
    ]
    return Verdict(heard, (*alike, *ruled_out), tuple(alike), told.others)


def verdicts(
    source: str | Path, *, seconds: float = LISTEN, tell: Callable[[str], None] = ignore
) -> list[Verdict]:
    """Whose bytes come from a source, one verdict for each sender; of a serial port, at the baud
    rate that fits best.

    Args:
        seconds: to listen for, at each baud rate.
        tell: called with what is being listened to, before each time.

    Raises:
        SourceError: where it cannot be opened.
    """
    tried: list[Verdict] = []
    for heard in hear(source, seconds=seconds, tell=tell):
        tried.append(verdict(heard))
        if heard.baud is not None and tried[-1].is_clear:
            break
    if len({one.heard.baud for one in tried}) > 1:
        return [best(tried)]
    return tried


def best(tried: Sequence[Verdict]) -> Verdict:
    """The verdict whose first sensor has the most of the bytes in its frames; of those without a
    sensor, the one on most bytes.
    """
    return max(tried, key=lambda one: (one.scores[0].share if one.scores else 0.0, one.heard.size))


def detected(source: str | Path) -> Sensor:
    """The one installed sensor whose frames come from a source; a recording says it itself, where
    it was made with one.

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
    if not any(one.alike for one in fitting):
        raise suggest(
            WireError(f"{source}: {others_named(fitting[0])}"),
            f"lidarspec detect {quote(str(source))}",
        )
    if len({one.sensor.id for one in fitting if one.sensor}) > 1:
        listed = ", ".join(f"{one.sensor.id} ({one.heard.sender})" for one in fitting if one.sensor)
        raise UsageError(
            f"{source}: several sensors send, {listed}; choose one with ?src=ADDRESS and -s"
        )
    if fitting[0].sensor is None:
        example = chosen(fitting[0].alike[0].sensor)
        raise UsageError(
            f"{source}: {', '.join(names(fitting[0]))} send the same frames; name one, as with"
            f" {example}"
        )
    return fitting[0].sensor


def chosen(sensor: Sensor) -> str:
    """What to type for a sensor and what it is configured with."""
    return " ".join(
        [
            f"-s {sensor.id}",
            *(f"-O {quote(f'{name}={value}')}" for name, value in sensor.options.items()),
        ]
    )


def names(found: Verdict) -> list[str]:
    """The ids of all that it may be, with a remark on those that are not installed."""
    return [
        *(score.sensor.id for score in found.alike),
        *(f"{name} (not installed)" for name in found.others),
    ]


def others_named(found: Verdict) -> str:
    """What to say of frames that are of a sensor that is recognised, and not installed."""
    return (
        " or ".join(f"these are frames of {name} ({why})" for name, why in found.others.items())
        + ", which no installed plugin reads"
    )


def declared(source: str | Path) -> Sensor | None:
    """The sensor that a source names itself: a device of `lidarspec.toml`, a recording, a simulated
    sensor; None for any other.

    Raises:
        UsageError: for standard input.
        SourceError: for a file that cannot be opened.
    """
    device = named(source)
    if device is not None:
        configured = device.configured()
    else:
        configured = None
    if configured is not None:
        return configured
    if str(source) == "-":
        raise UsageError("name the sensor with -s: standard input can be read only once")
    if (simulated := simulated_sensor(source)) is not None:
        return simulated
    address = live_address(source)
    if address is not None and address.scheme != "sim":
        return None
    opened = transport(source)
    opened.close()
    if isinstance(opened, RecordingTransport) and opened.header.sensor:
        return opened.known_sensor()
    return None


def simulated_sensor(source: str | Path) -> Sensor | None:
    """Return the sensor that a source simulates, as in "sim:ID"; None for any other source. Nothing
    is opened.
    """
    address = live_address(source)
    if address is None or address.scheme != "sim" or not address.place:
        return None
    return named_sensor(address.place)


def _nothing(source: str, found: Sequence[Verdict]) -> Exception:
    """What to say where no sensor fits."""
    heard = max((one.heard for one in found), key=lambda one: one.size, default=Heard(source))
    if fault := next((one.fault for one in found if one.fault), ""):
        return suggest(WireError(f"{source}: {fault}"), f"lidarspec crc {quote(str(source))}")
    if heard.size:
        kind = "this is text, and " if heard.is_text else ""
        error = WireError(
            f"{source}: {kind}no installed sensor's frames are in it", data=heard.chunks[0][:SHOWN]
        )
        return suggest_installation(error, heard)
    if live_address(source) is None:
        return WireError(no_bytes(source, heard.warnings))
    if heard.warnings:
        why = heard.warnings[0]
    else:
        why = f"{source}: nothing comes; a sensor that has to be started first is named with -s"
    return suggest(CommandError(why), f"lidarspec doctor {quote(source)}")


#: constant bits that make bytes look like a frame.
ALIKE = 8


def fitting(chunks: Sequence[bytes], *, datagrams: bool) -> list[Sensor]:
    """The installed sensors whose bytes these are, the best first; those with a type of exactly
    this frame before all others.
    """
    known = list(sensors().values())
    data = b"".join(chunks)
    whole = [
        sensor for sensor in known if any(_is_frame(sensor, name, data) for name in sensor.frames)
    ]
    if whole:
        return whole
    found = scores(chunks, datagrams=datagrams) if data else []
    return [score.sensor for score in found if score.share >= max(found[0].share - AS_GOOD, FITS)]


def nearest(data: bytes) -> WireError | None:
    """What the installed sensor that came farthest with some bytes says of them, with its id; None
    where none came far.
    """
    faults = []
    for sensor in sensors().values():
        try:
            identify(sensor, data)
        except LidarSpecError as fault:
            faults += [fault] if isinstance(fault, WireError) else []
    return max(
        (fault for fault in faults if _begins_alike(fault)),
        key=lambda fault: fault.offset,
        default=None,
    )


def _is_frame(sensor: Sensor, name: str, data: bytes) -> bool:
    """Whether the bytes are exactly one valid and plausible frame of a type."""
    frame = sensor.frames[name]
    if not 0 < len(data) <= frame.max_length:
        return False
    engine = codec(frame)
    if any(
        spot >= len(data) or data[spot] & mask != value
        for spot, (mask, value) in engine.prefix.items()
    ):
        return False
    survey = engine.survey(np.frombuffer(data, np.uint8), np.zeros(1, np.intp))
    return bool(survey.status[0] == VALID and survey.sizes[0] == len(data))


def _begins_alike(fault: WireError) -> bool:
    """Whether the bytes have the constants that the frame type begins with, and those are enough
    not to be chance.
    """
    if not fault.frame:
        return False
    prefix = codec(sensors()[fault.sensor].frames[fault.frame]).prefix
    there = [
        (fault.data[spot], mask, value)
        for spot, (mask, value) in prefix.items()
        if spot < len(fault.data)
    ]
    return (
        all(byte & mask == value for byte, mask, value in there)
        and sum(mask.bit_count() for _, mask, _ in there) >= ALIKE
    )
