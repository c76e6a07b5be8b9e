"""Identify the installed sensor that sent some bytes.

`rate_sensors` decodes the bytes with each installed sensor, and rates a sensor by the share of the
bytes in frames with a valid checksum and plausible values. `identify_sample` selects the best
sensor.

`distinguish` compares related models with the same frames, by the differences that their
`relatives` declare: packets that only one of them sends, the pace of the clock in the packets, and
the model that a frame names, in a text or by a documented value ("0x22 NAME"). If none of these
differences is visible, all related models remain possible, also those that are not installed.

For a single frame, `find_fitting_sensors` returns the sensors with a frame type that matches it
exactly, and `find_nearest_fault` the error of the sensor that parsed most of it.
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

from lidarspec.detect.listen import LISTEN, ignore_progress, read_samples
from lidarspec.detect.sample_bytes import SampleBytes
from lidarspec.detect.uninstalled_sensors import suggest_installation
from lidarspec.device.named_devices import find_device
from lidarspec.drafting.checksum_search import search
from lidarspec.errors import CommandError, LidarSpecError, UsageError, WireError, suggest
from lidarspec.expressions.columns import Fields
from lidarspec.frames.layout import Bytes2D, Seal, Sums
from lidarspec.frames.parse import identify
from lidarspec.frames.schema import make_schema
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.results import VALID, Found
from lidarspec.packets.packets import Packets
from lidarspec.plugins import registry, sensor as named_sensor, sensors
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.simulator import simulate
from lidarspec.spec.description import Relative
from lidarspec.spec.links import Serial
from lidarspec.spec.tree import FieldInfo
from lidarspec.transports.base import data_link
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.open_url import live_address, open_transport, resolve
from lidarspec.transports.protocol import no_bytes

#: Relative tolerance of the pace of a clock.
PACE_TOLERANCE = 0.03
#: Number of frames of a type that are searched for the name of the model.
MAX_NAMED_FRAMES = 3
#: Number of packets that are simulated to find the pace of a sensor's clock.
SIMULATED_PACKETS = 64
#: A number and its meaning in the documentation of a field.
_VALUE = re.compile(r"\b(0x[0-9a-fA-F]+|\d+)\s+([^,;:]+)")
#: Number of bytes that an error shows.
SHOWN = 16
#: Smallest share of the bytes that has to be in a sensor's frames for the sensor to fit.
FITS = 0.2
#: A sensor is as good as the best one if its share is at most this much smaller.
AS_GOOD = 0.01
#: Share of the bytes that identifies a sensor without doubt.
CLEAR = 0.9
#: Number of data frames that are no coincidence even if all checksums are invalid.
MIN_UNCHECKED_FRAMES = 3


class Distinction(NamedTuple):
    """The result of a comparison of related models.

    Attributes:
        candidates: the candidates that may have sent the frames: id -> reason, "" if there is none.
        others: related models, not installed, that may have sent the frames: id -> difference. If
            `candidates` is empty, one of them did.
    """

    candidates: dict[str, str]
    others: dict[str, str]


def distinguish(candidates: Sequence[Sensor], frames: Mapping[str, Sequence[Found]]) -> Distinction:
    """Decide which of several sensors with the same data frames sent some frames.

    Packets that only one model sends decide first, then the pace of the clock, then model names.

    Args:
        candidates: sensors that decode the same data frames.
        frames: sensor id -> the frames that this sensor decoded, in the order of their arrival.
    """
    ids = {sensor.id for sensor in candidates}
    excluding = {
        sensor.id: _excluding_relatives(sensor, frames[sensor.id]) for sensor in candidates
    }
    left = [sensor for sensor in candidates if not excluding[sensor.id]]
    reasons = {name: why for relatives in excluding.values() for name, why in relatives.items()}
    if not left:
        return Distinction({}, {name: why for name, why in reasons.items() if name not in ids})
    timed = _keep_matching(left, _match_clock, frames)
    named_among = [sensor for sensor in left if sensor.id in timed] or left
    if len(timed) == 1:
        selected = timed
    else:
        selected = _keep_matching(named_among, _match_name, frames) or timed
    if selected:
        return Distinction(selected, {})
    differences = {
        name: text
        for sensor in left
        for name, text in sensor.relatives.items()
        if isinstance(text, str) and name not in ids
    }
    installed = registry()
    return Distinction(
        {sensor.id: reasons.get(sensor.id, "") for sensor in left},
        {name: text for name, text in differences.items() if installed.find(name) is None},
    )


def find_contradiction(sensor: Sensor, frames: Sequence[Found]) -> str:
    """Return the evidence that another model sent some frames, "" if there is none."""
    relatives = map(registry().find, sensor.relatives)  # loads only their plugins
    alike = [sensor, *(relative for relative in relatives if relative is not None)]
    result = distinguish(alike, {one.id: frames for one in alike})
    if sensor.id not in result.candidates:
        return "the frames are those of " + " or ".join(
            f"{name} ({why})" for name, why in (result.candidates or result.others).items()
        )
    names = _models(sensor, frames)
    fits = any(
        _plain(part) in _plain(sensor.model)
        for name in names
        for part in re.split(r",| and ", name)
    )
    if fits or not names:
        return ""
    return f"{sensor.info['model']} is {names[0]}"


def _excluding_relatives(sensor: Sensor, frames: Sequence[Found]) -> dict[str, str]:
    """Return the relatives that alone send most of these packets: id -> difference."""
    single = {
        name: relative
        for name, relative in sensor.relatives.items()
        if isinstance(relative, Relative)
    }
    if single and sensor.has_points:
        data = [item.data for item in frames if item.frame == sensor.data_frame]
    else:
        data = []
    if not data:
        return {}
    packets = sensor.decode(data)
    if not len(packets):
        return {}
    fields = Fields(packets.batch())
    return {
        name: relative.difference
        for name, relative in single.items()
        if np.mean(np.asarray(relative.sends(fields))) > 0.5
    }


def _keep_matching(
    left: Sequence[Sensor],
    why: Callable[[Sensor, Sequence[Found]], str],
    frames: Mapping[str, Sequence[Found]],
) -> dict[str, str]:
    """Select the sensors that match by one criterion: id -> reason.

    Args:
        why: returns the reason why a sensor matches, "" if it does not.

    Returns:
        An empty dict if no sensor matches, or if all of several match.
    """
    if len(left) == 1 and not left[0].relatives:
        return {}
    reasons = {sensor.id: reason for sensor in left if (reason := why(sensor, frames[sensor.id]))}
    if len(left) == 1 or len(reasons) < len(left):
        return reasons
    return {}


def _match_clock(sensor: Sensor, frames: Sequence[Found]) -> str:
    """Return a reason if the clock in the frames has the pace of this sensor, else ""."""
    if not sensor.has_points:
        return ""
    data = [item for item in frames if item.frame == sensor.data_frame]
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
    if sensor.datagrams:
        # Lost, repeated and reordered datagrams leave the median of the steps unchanged.
        step = float(np.median(np.diff(np.sort(packets.time_ns))))
        grain = 0.0
    else:
        # The clock may be coarse, which requires a mean. In a stream, gaps in the offsets show
        # where frames were lost, and these steps are left out.
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
        # The error of the mean, from the spread of the steps.
        grain = min(float(np.ptp(steps)), expected) / (2 * len(steps) ** 0.5)
    if abs(step - expected) > PACE_TOLERANCE * expected + grain:
        return ""
    return f"its clock advances by {step / 1e6:.3g} ms per packet"


@functools.lru_cache(maxsize=256)
def _pace(sensor_id: str, sensor: Sensor) -> float | None:
    """Return the simulated clock step per packet in ns, None if there is none.

    Args:
        sensor_id: not read; it is part of the key of the cache.
    """
    try:
        steps = np.diff(sensor.decode(simulate(sensor, SIMULATED_PACKETS)).time_ns)
    except LidarSpecError:
        return None
    steps = steps[steps >= 0]
    if len(steps) and steps.mean() > 0:
        return float(steps.mean())
    return None


def _declared_pace(pace: Callable[[Any], Any], packets: Packets) -> float:
    """Return the median of the declared clock steps per packet, ns."""
    return float(np.median(np.asarray(pace(Fields(packets.batch())), np.float64))) * 1e9


def _match_name(sensor: Sensor, frames: Sequence[Found]) -> str:
    """Return a reason if the frames name the model of this sensor, else ""."""
    return next(
        (
            f"{sensor.info['model']} is {text}"
            for text in _models(sensor, frames)
            if _plain(text) == _plain(sensor.model)
        ),
        "",
    )


def _models(sensor: Sensor, frames: Sequence[Found]) -> list[str]:
    """Return the models that the first frames with a model field name."""
    frame, _, path = sensor.info.get("model", "").partition(".")
    named_frames = (item for item in frames if item.frame == frame)
    names = []
    for item in itertools.islice(named_frames, MAX_NAMED_FRAMES):
        try:
            names.append(_text(*_field(sensor, item, path)))
        except WireError:
            continue  # a related model may use the same frame name for another frame
    return [name for name in names if name]


def read_info(sensor: Sensor, frames: Iterable[Found]) -> dict[str, str]:
    """Return the values of the sensor's `info` fields in the last frame of each type.

    Returns:
        Role -> text, such as "serial" -> "A1234"; numbers have a unit.
    """
    last = {item.frame: item for item in frames}
    texts = dict[str, str]()
    for role, path in sensor.info.items():
        frame, _, field_path = path.partition(".")
        if frame in last:
            value, info = _field(sensor, last[frame], field_path)
            if isinstance(value, list):
                texts[role] = ".".join(map(str, value))  # a version
            elif isinstance(value, bytes):
                content = value.rstrip(b"\0 ")
                if content.isascii() and content.decode("ascii").isprintable():
                    texts[role] = content.decode("ascii")
                else:
                    texts[role] = value.hex()
            else:
                texts[role] = _text(value, info) or (
                    f"{info.physical(value):g} {info.unit}".rstrip()
                    if isinstance(value, int | float)
                    else f"{value}"
                )
    return {role: text for role, text in texts.items() if text}


def _field(sensor: Sensor, item: Found, path: str) -> tuple[Any, FieldInfo]:
    """Return the raw value and the description of a field.

    For a field of repeated parts the value is that of the first part with the field, or "".
    """
    fields = make_schema(sensor.frames[item.frame].tree)
    parsed = sensor.parse(item.data, item.frame)
    axis, _, rest = fields.within(path) or ("", "", path)
    if axis:
        wholes = [part for part in _at(parsed, axis) if rest.partition(".")[0] in part]
    else:
        wholes = [parsed]
    return next((_at(whole, rest) for whole in wholes), ""), fields.scan_names[path]


def _at(parsed: Any, path: str) -> Any:
    return functools.reduce(lambda above, name: above[name], path.split("."), parsed)


def _text(value: Any, info: FieldInfo) -> str:
    """Return the text of a field, or the documented meaning of its number."""
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
    """The rating of a sensor for some bytes.

    Attributes:
        sensor: the sensor.
        share: the share of the bytes that are in its frames.
        data_frames: the number of its data frames.
        found: all of its frames.
        why: other evidence for this sensor.
    """

    sensor: Sensor
    share: float
    data_frames: int
    found: tuple[Found, ...] = ()
    why: str = ""


@dataclass(frozen=True)
class Verdict:
    """The sensors that may have sent some bytes.

    Attributes:
        sample: the bytes.
        scores: all sensors that fit, best first.
        candidates: the sensors that remain possible.
        others: related models, not installed, that are also possible: id -> difference. If
            `candidates` is empty, one of them sent the bytes.
        fault: a description of frames that fit a sensor except for their checksums, or "".
    """

    sample: SampleBytes
    scores: tuple[Score, ...] = ()
    candidates: tuple[Score, ...] = ()
    others: Mapping[str, str] = field(default_factory=dict)
    fault: str = ""

    @property
    def sensor(self) -> Sensor | None:
        """The sensor; None if no sensor or more than one is possible."""
        if len(self.candidates) == 1 and not self.others:
            return self.candidates[0].sensor
        return None

    @property
    def is_clear(self) -> bool:
        """Whether the result is certain, so that no other baud rate has to be tried."""
        return (
            bool(self.scores) and self.scores[0].share >= CLEAR and self.scores[0].data_frames > 1
        )


def rate_sensors(chunks: Sequence[bytes], *, datagrams: bool) -> list[Score]:
    """Return the scores of all installed sensors with at least one data frame, best first."""
    candidates = _sensors_with_frames()
    scores = _score_each(candidates, lambda sensor: _score(sensor, chunks, datagrams=datagrams))
    if not any(score.share >= FITS for score in scores):
        scores += _score_each(
            candidates, lambda sensor: _score_mid_stream(sensor, chunks, datagrams=datagrams)
        )
    return sorted(scores, key=lambda score: (-score.share, score.sensor.id))


def _sensors_with_frames() -> list[Sensor]:
    """Return the installed sensors that have incoming frames without any configuration."""
    return [sensor for sensor in sensors().values() if sensor.incoming]


def find_wrong_checksums(chunks: Sequence[bytes], *, datagrams: bool) -> str:
    """Describe frames that fit a sensor except for their checksums, all invalid.

    Returns:
        "" for all other bytes.
    """
    unchecked = _score_each(
        _sensors_with_frames(),
        lambda sensor: _score(sensor, chunks, datagrams=datagrams, sums=_stored_checksums),
    )
    matches = [
        score
        for score in unchecked
        if score.share >= CLEAR and score.data_frames >= MIN_UNCHECKED_FRAMES
    ]
    if not matches or _score(matches[0].sensor, chunks, datagrams=datagrams) is not None:
        return ""
    kinds = [item.frame for item in matches[0].found]
    most = max(set(kinds), key=kinds.count)
    frames = [item.data for item in matches[0].found if item.frame == most]
    ids = " or ".join(score.sensor.id for score in matches)
    text = (
        f"{len(frames)} {most} frames match {ids} in constants, lengths and rhythm, but all their"
        " checksums are wrong"
    )
    match = next(iter(search(frames, quick=True)), None)
    if match is None:
        return f"{text}; no other checksum found at the usual places"
    length = len(frames[0])
    covered = sum(last - first for first, last in match.span.ranges(match.place, length))
    where = (
        f"{match.algorithm.describe()} in {match.place} is correct in {match.right} of"
        f" {match.total}"
    )
    return (
        f"{text}: {where}, over {covered} of the {length - match.place.size} other bytes"
        f" ({match.span.describe(match.place, length)})"
    )


def _stored_checksums(seal: Seal, rows: Bytes2D) -> NDArray[np.uint64]:
    """Return the checksums in the frames instead of computed ones, so that all are valid."""
    return seal.load_stored(rows)


def _score_each(
    candidates: Sequence[Sensor], rate: Callable[[Sensor], Score | None]
) -> list[Score]:
    """Return the score of each sensor; sensors with identical frames are decoded only once."""
    shared: dict[object, Score | None] = {}
    for sensor in candidates:
        frames = (
            sensor.fillers,
            *(
                (name, id(frame.struct), frame.plausible, frame.after)
                for name, frame in sensor.frames.items()
            ),
        )
        if frames not in shared:
            shared[frames] = rate(sensor)
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
    # Decode all chunks in one call: one call per chunk takes ten times as long.
    if datagrams:
        items = decoder.datagrams(chunks).found()
    else:
        items = decoder.feed(b"".join(chunks))
    items += decoder.finish()
    number = sum(decoder.stats.frames.get(name, 0) for name in sensor.main_frames)
    if number:
        return Score(
            sensor, 1 - decoder.stats.bytes_skipped / decoder.stats.bytes_in, number, tuple(items)
        )
    return None


def _score_mid_stream(sensor: Sensor, chunks: Sequence[bytes], *, datagrams: bool) -> Score | None:
    """Score a sensor as if the frame that precedes its data frames had been seen already.

    This applies to data frames that are only valid after another frame, such as a reply. Returns
    the best score of all such data frames.
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


def identify_sample(sample: SampleBytes) -> Verdict:
    """Identify the sensor by frames, then by clocks and names, then by the baud rate."""
    fitting = [
        score
        for score in rate_sensors(sample.chunks, datagrams=sample.datagrams)
        if score.share >= FITS
    ]
    best = [score for score in fitting if score.share >= fitting[0].share - AS_GOOD]
    if not best:
        return Verdict(
            sample, fault=find_wrong_checksums(sample.chunks, datagrams=sample.datagrams)
        )
    result = distinguish(
        [score.sensor for score in best], {score.sensor.id: score.found for score in best}
    )
    alike = [
        replace(score, why=result.candidates[score.sensor.id])
        for score in best
        if score.sensor.id in result.candidates
    ]
    if len(alike) > 1 and sample.baud is not None:
        why = f"it runs at {sample.baud} baud"
        links = [(score, data_link(score.sensor, Serial)) for score in alike]
        alike = [
            replace(score, why=why) for score, link in links if link and sample.baud in link.bauds
        ] or alike
    alike = [
        replace(
            score,
            why=score.why
            or ", ".join(f"{name}={value}" for name, value in score.sensor.options.items()),
        )
        for score in alike
    ]
    # List the vendor first that makes most of these sensors: it is the most likely one.
    vendors = [score.sensor.vendor for score in alike]
    alike.sort(key=lambda score: (-vendors.count(score.sensor.vendor), score.sensor.id))
    ruled_out = [
        score for score in fitting if score.sensor.id not in {one.sensor.id for one in alike}
    ]
    return Verdict(sample, (*alike, *ruled_out), tuple(alike), result.others)


def identify_senders(
    source: str | Path, *, seconds: float = LISTEN, tell: Callable[[str], None] = ignore_progress
) -> list[Verdict]:
    """Identify the sensors that send to a source: one verdict for each sender.

    For a serial port, return the verdict of the baud rate that fits best.

    Args:
        seconds: time to listen at each baud rate.
        tell: called with a description of the source before each time of listening.

    Raises:
        SourceError: if the source cannot be opened.
    """
    tried: list[Verdict] = []
    for sample in read_samples(source, seconds=seconds, tell=tell):
        tried.append(identify_sample(sample))
        if sample.baud is not None and tried[-1].is_clear:
            break
    if len({one.sample.baud for one in tried}) > 1:
        return [select_best(tried)]
    return tried


def select_best(tried: Sequence[Verdict]) -> Verdict:
    """Return the verdict with the highest score, else the one on most bytes."""
    return max(tried, key=lambda one: (one.scores[0].share if one.scores else 0.0, one.sample.size))


def detect(source: str | Path) -> Sensor:
    """Return the installed sensor that sends to a source.

    A source that declares its sensor, such as a recording, is not searched for frames.

    Raises:
        CommandError: if a live source sends nothing.
        WireError: if no sensor fits.
        UsageError: if several sensors fit equally well.
        SourceError: if the source cannot be opened.
    """
    declared_sensor = find_declared_sensor(source)
    if declared_sensor is not None:
        return declared_sensor
    verdicts = identify_senders(resolve(source))
    fitting = [verdict for verdict in verdicts if verdict.scores]
    if not fitting:
        raise _no_sensor_error(str(source), verdicts)
    if not any(verdict.candidates for verdict in fitting):
        raise suggest(
            WireError(f"{source}: {describe_unsupported_models(fitting[0])}"),
            f"lidarspec detect {quote(str(source))}",
        )
    if len({verdict.sensor.id for verdict in fitting if verdict.sensor}) > 1:
        listed = ", ".join(
            f"{verdict.sensor.id} ({verdict.sample.sender})"
            for verdict in fitting
            if verdict.sensor
        )
        raise UsageError(
            f"{source}: several sensors send: {listed}; choose one with ?src=ADDRESS and -s"
        )
    if fitting[0].sensor is None:
        example = format_sensor_options(fitting[0].candidates[0].sensor)
        raise UsageError(
            f"{source}: {', '.join(list_candidates(fitting[0]))} send the same frames; name one,"
            f" such as {example}"
        )
    return fitting[0].sensor


def format_sensor_options(sensor: Sensor) -> str:
    """Return the command-line options that select a sensor and its configuration."""
    return " ".join(
        [
            f"-s {sensor.id}",
            *(f"-O {quote(f'{name}={value}')}" for name, value in sensor.options.items()),
        ]
    )


def verb_to_show(sensor: Sensor) -> str:
    """Return the verb of the command line that shows a sensor's data."""
    if sensor.has_points:
        return "view"
    return "stats"


def list_candidates(verdict: Verdict) -> list[str]:
    """Return the ids of all possible sensors, and mark those that are not installed."""
    return [
        *(score.sensor.id for score in verdict.candidates),
        *(f"{name} (not installed)" for name in verdict.others),
    ]


def describe_unsupported_models(verdict: Verdict) -> str:
    """Return a message for frames of models that are known but not installed."""
    return (
        " or ".join(f"these are frames of {name} ({why})" for name, why in verdict.others.items())
        + ", which no installed plugin supports"
    )


def find_declared_sensor(source: str | Path) -> Sensor | None:
    """Return the sensor that a source declares; None if it declares none.

    Sources that declare a sensor are devices of `lidarspec.toml`, recordings and simulated sensors.

    Raises:
        UsageError: for standard input.
        SourceError: if the file cannot be opened.
    """
    device = find_device(source)
    if device is not None:
        configured = device.configure()
    else:
        configured = None
    if configured is not None:
        return configured
    if str(source) == "-":
        raise UsageError("name the sensor with -s: standard input can be read only once")
    if (simulated := find_simulated_sensor(source)) is not None:
        return simulated
    address = live_address(source)
    if address is not None and address.scheme != "sim":
        return None
    opened = open_transport(source)
    opened.close()
    if isinstance(opened, RecordingTransport) and opened.header.sensor:
        return opened.known_sensor()
    return None


def find_simulated_sensor(source: str | Path) -> Sensor | None:
    """Return the sensor of a source "sim:ID", None for any other source."""
    address = live_address(source)
    if address is None or address.scheme != "sim" or not address.location:
        return None
    return named_sensor(address.location)


def _no_sensor_error(source: str, verdicts: Sequence[Verdict]) -> Exception:
    """Return the error for a source for which no sensor fits."""
    largest = max(
        (one.sample for one in verdicts), key=lambda one: one.size, default=SampleBytes(source)
    )
    if fault := next((one.fault for one in verdicts if one.fault), ""):
        return suggest(WireError(f"{source}: {fault}"), f"lidarspec crc {quote(str(source))}")
    if largest.size:
        kind = " in this text" if largest.is_text else ""
        error = WireError(
            f"{source}: no frame of an installed sensor{kind}", data=largest.chunks[0][:SHOWN]
        )
        return suggest_installation(error, largest)
    if live_address(source) is None:
        return WireError(no_bytes(source, largest.warnings))
    if largest.warnings:
        why = largest.warnings[0]
    else:
        why = f"{source}: no data received; if the sensor must be started first, name it with -s"
    return suggest(CommandError(why), f"lidarspec doctor {quote(source)}")


#: Smallest number of constant bits that have to be equal for bytes to resemble a frame type.
MIN_CONSTANT_BITS = 8


def find_fitting_sensors(chunks: Sequence[bytes], *, datagrams: bool) -> list[Sensor]:
    """Return the installed sensors that fit some bytes, best first.

    If all bytes together are exactly one frame of some sensors, only these are returned.
    """
    installed = list(sensors().values())
    data = b"".join(chunks)
    whole = [
        sensor
        for sensor in installed
        if any(_is_frame(sensor, name, data) for name in sensor.frames)
    ]
    if whole:
        return whole
    scores = rate_sensors(chunks, datagrams=datagrams) if data else []
    return [score.sensor for score in scores if score.share >= max(scores[0].share - AS_GOOD, FITS)]


def find_nearest_fault(data: bytes) -> WireError | None:
    """Return the error of the installed sensor that parsed most of an invalid frame.

    None if the bytes do not begin like a frame of any sensor.
    """
    faults = []
    for sensor in sensors().values():
        try:
            identify(sensor, data)
        except LidarSpecError as fault:
            faults += [fault] if isinstance(fault, WireError) else []
    return max(
        (fault for fault in faults if _begins_like_frame(fault)),
        key=lambda fault: fault.offset,
        default=None,
    )


def _is_frame(sensor: Sensor, name: str, data: bytes) -> bool:
    """Return whether the bytes are exactly one valid and plausible frame of a type."""
    frame = sensor.frames[name]
    if not 0 < len(data) <= frame.max_length:
        return False
    engine = get_codec(frame)
    if any(
        offset >= len(data) or data[offset] & mask != value
        for offset, (mask, value) in engine.prefix.items()
    ):
        return False
    survey = engine.survey(np.frombuffer(data, np.uint8), np.zeros(1, np.intp))
    return bool(survey.status[0] == VALID and survey.sizes[0] == len(data))


def _begins_like_frame(fault: WireError) -> bool:
    """Return whether invalid bytes have the constant bits at the start of a frame.

    At least `MIN_CONSTANT_BITS` are required, since fewer may be equal by coincidence.
    """
    if not fault.frame:
        return False
    prefix = get_codec(sensors()[fault.sensor].frames[fault.frame]).prefix
    constants = [
        (fault.data[offset], mask, value)
        for offset, (mask, value) in prefix.items()
        if offset < len(fault.data)
    ]
    return (
        all(byte & mask == value for byte, mask, value in constants)
        and sum(mask.bit_count() for _, mask, _ in constants) >= MIN_CONSTANT_BITS
    )
