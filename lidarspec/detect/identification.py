"""Identify the installed sensor that sent some bytes.

The bytes are decoded with each installed sensor. `rate_sensors` returns the share of the bytes that
are in valid frames of a sensor. `identify_sample` selects the sensor with the largest share.

Related models have the same frames. `distinguish` looks for packets that only one of the models
sends, for the clock step per packet of one model, and for a model name in the frames. If none of
these decides, all related models remain possible, including models that are not installed.

`find_fitting_sensors` and `find_nearest_fault` examine a single frame.
"""

from __future__ import annotations

import functools
import itertools
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.detect.listen import LISTEN_S, ignore_progress, read_samples
from lidarspec.detect.sample_bytes import SampleBytes
from lidarspec.detect.uninstalled_sensors import suggest_installation
from lidarspec.device.named_devices import find_device
from lidarspec.drafting.checksum_search import search
from lidarspec.errors import (
    CommandError,
    LidarSpecError,
    SpecError,
    UsageError,
    WireError,
    suggest,
)
from lidarspec.expressions.columns import Batch, Fields
from lidarspec.frames.layout import Bytes2D, FrameChecksum, Sums
from lidarspec.frames.number_format import find_number_format
from lidarspec.frames.parse import identify
from lidarspec.frames.schema import make_schema
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.results import VALID, Found, Frames, pack_found
from lidarspec.packets.packets import Packets
from lidarspec.plugins import registry, sensor as named_sensor, sensors
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.simulator import simulate
from lidarspec.spec.description import Relative, Reported
from lidarspec.spec.enum_values import UNKNOWN_CODE, format_code
from lidarspec.spec.links import Serial
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.tree import FieldInfo
from lidarspec.transports.base import find_data_link
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.open_url import live_address, open_transport, resolve_device_name
from lidarspec.transports.protocol import no_bytes_message

#: The relative tolerance of the clock step per packet.
PACE_TOLERANCE = 0.03
#: The maximum number of frames to read the model name from.
MAX_NAMED_FRAMES = 3
#: The number of packets to simulate, to find the clock step per packet of a sensor.
SIMULATED_PACKETS = 64
#: The maximum number of bytes to show in an error.
MAX_SHOWN_BYTES = 16
#: A sensor fits if at least this share (0 to 1) of the bytes is in its frames.
FITTING_SHARE = 0.2
#: Shares that differ by at most this value are equally good.
EQUAL_SHARE_TOLERANCE = 0.01
#: A sensor is certain if at least this share (0 to 1) of the bytes is in its frames.
CLEAR_SHARE = 0.9
#: The minimum number of data frames for a match of frames with invalid checksums. Fewer frames may
#: match by coincidence.
MIN_UNCHECKED_FRAMES = 3


class Distinction(NamedTuple):
    """The result of a comparison of related models.

    Attributes:
        candidates: the installed models that may have sent the frames: id -> evidence, or "".
        others: the models that are not installed, but may have sent the frames: id -> difference
            from the installed models.
    """

    candidates: dict[str, str]
    others: dict[str, str]


def distinguish(candidates: Sequence[Sensor], frames: Mapping[str, Sequence[Found]]) -> Distinction:
    """Decide which of several sensors with equal data frames sent the frames.

    Args:
        frames: sensor id -> the frames that this sensor decoded, in the order of arrival.
    """
    ids = {sensor.id for sensor in candidates}
    excluding = {
        sensor.id: _find_relatives_that_sent(sensor, frames[sensor.id]) for sensor in candidates
    }
    left = [sensor for sensor in candidates if not excluding[sensor.id]]
    reasons = {name: why for relatives in excluding.values() for name, why in relatives.items()}
    if not left:
        return Distinction({}, {name: why for name, why in reasons.items() if name not in ids})
    timed = _select_by_criterion(left, _match_clock, frames)
    named_among = [sensor for sensor in left if sensor.id in timed] or left
    if len(timed) == 1:
        selected = timed
    else:
        selected = _select_by_criterion(named_among, _match_name, frames) or timed
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
    """Return the evidence that another model sent some frames; "" if there is none."""
    relatives = map(registry().find, sensor.relatives)  # loads only the plugins of these models
    models = [sensor, *(relative for relative in relatives if relative is not None)]
    result = distinguish(models, {model.id: frames for model in models})
    if sensor.id not in result.candidates:
        return "the frames are those of " + " or ".join(
            f"{name} ({why})" if why else name
            for name, why in (result.candidates or result.others).items()
        )
    names = _read_model_names(sensor, frames)
    fits = any(
        _normalise(part) in _normalise(sensor.model)
        for name in names
        for part in _split_names(name)
    )
    if fits or not names:
        return ""
    return f"{sensor.reported['model'].paths[0]} is {names[0]}"


def _find_relatives_that_sent(sensor: Sensor, frames: Sequence[Found]) -> dict[str, str]:
    """Return the models that must have sent the frames, instead of `sensor`.

    A related model is returned if more than half of the packets are packets that only this model
    sends, and `sensor` never sends.

    Returns:
        Id of the related model -> its difference from the sensor; {} if the sensor itself may have
        sent the frames.
    """
    distinct_relatives = {
        name: relative
        for name, relative in sensor.relatives.items()
        if isinstance(relative, Relative)
    }
    if not distinct_relatives or not sensor.has_points:
        return {}
    data = [item.data for item in frames if item.frame == sensor.data_frame]
    if not data:
        return {}
    packets = sensor.decode(data)
    if not len(packets):
        return {}
    fields = Fields(packets.batch())
    return {
        name: relative.difference
        for name, relative in distinct_relatives.items()
        # more than half of the packets must have a property that the sensor's packets never have
        if np.mean(np.asarray(relative.sends(fields))) > 0.5
    }


def _select_by_criterion(
    candidates: Sequence[Sensor],
    match: Callable[[Sensor, Sequence[Found]], str],
    frames: Mapping[str, Sequence[Found]],
) -> dict[str, str]:
    """Return the sensors that one criterion selects, with the evidence.

    Returns:
        Id of each matching sensor -> evidence; empty if the criterion cannot decide.
    """
    if len(candidates) == 1 and not candidates[0].relatives:
        return {}
    matching = {
        sensor.id: evidence
        for sensor in candidates
        if (evidence := match(sensor, frames[sensor.id]))
    }
    if len(candidates) == 1 or len(matching) < len(candidates):
        return matching
    return {}


def _match_clock(sensor: Sensor, frames: Sequence[Found]) -> str:
    """Return the evidence that the clock in the frames matches a sensor; "" if none."""
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
        expected = _simulate_pace(sensor.id, sensor)
    else:
        expected = _evaluate_pace(sensor.clock.pace, packets)
    if expected is None:
        return ""
    if sensor.datagrams:
        # Lost, repeated and reordered datagrams hardly change the median of the steps.
        step = float(np.median(np.diff(np.sort(packets.time_ns))))
        uncertainty = 0.0
    else:
        # The clock may be coarse, so the mean of the steps is used. Steps over gaps in the stream
        # are omitted, because frames were lost there.
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
        # The error of the mean, estimated from the deviations of the steps.
        uncertainty = min(float(np.ptp(steps)), expected) / (2 * len(steps) ** 0.5)
    if abs(step - expected) > PACE_TOLERANCE * expected + uncertainty:
        return ""
    return f"the clock advances by {step / 1e6:.3g} ms per packet"


@functools.lru_cache(maxsize=256)
def _simulate_pace(sensor_id: str, sensor: Sensor) -> float | None:
    """Return the clock step per packet of the simulated sensor, ns; None if unknown."""
    try:
        steps = np.diff(sensor.decode(simulate(sensor, SIMULATED_PACKETS)).time_ns)
    except LidarSpecError:
        return None
    steps = steps[steps >= 0]
    if len(steps) and steps.mean() > 0:
        return float(steps.mean())
    return None


def _evaluate_pace(pace: Callable[[Any], Any], packets: Packets) -> float:
    """Return the median of the times per packet that `pace` calculates, in ns."""
    return float(np.median(np.asarray(pace(Fields(packets.batch())), np.float64))) * 1e9


def _match_name(sensor: Sensor, frames: Sequence[Found]) -> str:
    """Return the evidence that the frames name the model of a sensor; "" if none."""
    return next(
        (
            f"{sensor.reported['model'].paths[0]} is {text}"
            for text in _read_model_names(sensor, frames)
            if _normalise(sensor.model) in map(_normalise, _split_names(text))
        ),
        "",
    )


def _read_model_names(sensor: Sensor, frames: Sequence[Found]) -> list[str]:
    """Return the model names in the first frames that contain a model name."""
    if "model" not in sensor.reported:
        return []
    frame, _, path = sensor.reported["model"].paths[0].partition(".")
    named_frames = (item for item in frames if item.frame == frame)
    names = []
    for item in itertools.islice(named_frames, MAX_NAMED_FRAMES):
        try:
            names.append(_describe_value(*_read_field(sensor, item, path)))
        except WireError:
            continue  # a related model may use the same frame name for another frame
    return [name for name in names if name]


def read_info(sensor: Sensor, frames: Iterable[Found]) -> dict[str, str]:
    """Return the values of the sensor's `info` fields in the last frame of each type.

    Returns:
        Name in `info` -> value as text with its unit, for example {"serial": "A1234"}.
    """
    items = sorted(frames, key=lambda item: item.offset)
    texts = dict[str, str]()
    for role, fact in sensor.reported.items():
        reporting = [item for item in items if _is_fact_in_frame(sensor, fact, item)]
        if reporting:
            item = reporting[-1]
            texts[role] = _describe_fact(fact, *_read_field(sensor, item, fact.path_in(item.frame)))
    return {role: text for role, text in texts.items() if text}


def _is_fact_in_frame(sensor: Sensor, fact: Reported, item: Found) -> bool:
    """Return whether a frame reports a fact, such as the model name."""
    if not fact.path_in(item.frame):
        return False
    return bool(find_reporting_frames(sensor, fact, item.frame, pack_found([item]))[0])


def find_reporting_frames(
    sensor: SensorDescription, fact: Reported, name: str, frames: Frames
) -> NDArray[np.bool_]:
    """Return a mask (n,) of the frames that report a fact, such as the model name."""
    if fact.where is None or not len(frames):
        return np.ones(len(frames), np.bool_)
    table = get_codec(sensor.frames[name]).gather(frames)
    batch = Batch(table, np.zeros(len(frames), np.bool_), {}, sensor.state)
    with np.errstate(all="ignore"):
        mask = np.asarray(fact.where(Fields(batch)), np.bool_)
    return np.broadcast_to(mask.reshape(-1), (len(frames),))


def _describe_fact(fact: Reported, value: Any, info: FieldInfo) -> str:
    """Return a reported value as text."""
    if fact.text is not None:
        return fact.text(value)
    if isinstance(value, list):
        return ".".join(map(str, value))  # a version
    if isinstance(value, bytes):
        content = value.rstrip(b"\0 ")
        if content.isascii() and content.decode("ascii").isprintable():
            return content.decode("ascii")
        return value.hex()
    meaning = _describe_value(value, info)
    if meaning:
        return meaning
    if info.labels and isinstance(value, int):
        return format_code(value, UNKNOWN_CODE)
    if isinstance(value, int | float):
        physical = info.physical(value)
        if isinstance(physical, float):
            text = find_number_format(info).format(physical)
        else:
            text = str(physical)  # all digits, for example of a serial number
        return f"{text} {info.unit}".rstrip()
    return f"{value}"


def _read_field(sensor: Sensor, item: Found, path: str) -> tuple[Any, FieldInfo]:
    """Return the raw value and the description of a field.

    The raw value is "" if the frame has no part that contains the field.
    """
    fields = make_schema(sensor.frames[item.frame].tree)
    parsed = sensor.parse(item.data, item.frame)
    axis, _, rest = fields.split_part_path(path) or ("", "", path)
    if axis:
        parts = [part for part in _get_nested(parsed, axis) if rest.partition(".")[0] in part]
    else:
        parts = [parsed]
    return next((_get_nested(part, rest) for part in parts), ""), fields.scan_names[path]


def _get_nested(parsed: Any, path: str) -> Any:
    return functools.reduce(lambda container, name: container[name], path.split("."), parsed)


def _describe_value(value: Any, info: FieldInfo) -> str:
    """Return the text of a bytes field, or the name of a code; "" for other values."""
    if isinstance(value, bytes):
        return value.split(b"\0")[0].decode("ascii", "replace")
    return info.labels.get(value, "")


def _split_names(text: str) -> list[str]:
    """Return the model names in a text, which may name several models."""
    return re.split(r",| and ", text)


def _normalise(text: str) -> str:
    return re.sub(r"[\W_]", "", text).lower()


@dataclass(frozen=True)
class Score:
    """The rating of a sensor for some bytes.

    Attributes:
        evidence: further evidence for this sensor; "" if there is none.
    """

    sensor: Sensor
    share: float
    data_frames: int
    frames: tuple[Found, ...] = ()
    evidence: str = ""


@dataclass(frozen=True)
class Verdict:
    """The sensors that may have sent some bytes.

    Attributes:
        scores: all sensors with at least `FITTING_SHARE` of the bytes in their frames: first the
            candidates, then the sensors that were ruled out.
        candidates: the sensors that may have sent the bytes; more than one if nothing
            distinguishes them.
        others: the models that are not installed, but may have sent the bytes: id -> difference
            from the installed models.
        fault: a message if frames of a sensor have wrong checksums; else "".
    """

    sample: SampleBytes
    scores: tuple[Score, ...] = ()
    candidates: tuple[Score, ...] = ()
    others: Mapping[str, str] = field(default_factory=dict)
    fault: str = ""

    @property
    def sensor(self) -> Sensor | None:
        """The only possible sensor; None if no sensor or several sensors are possible."""
        if len(self.candidates) == 1 and not self.others:
            return self.candidates[0].sensor
        return None

    @property
    def is_clear(self) -> bool:
        """Whether nearly all bytes are in frames, so that the baud rate is certain."""
        if not self.scores:
            return False
        best = self.scores[0]
        return best.share >= CLEAR_SHARE and best.data_frames > 1


def rate_sensors(chunks: Sequence[bytes], *, datagrams: bool) -> list[Score]:
    """Return the scores of the sensors whose data frames are found, best first."""
    candidates = _list_sensors_with_frames()
    scores = _score_each(candidates, lambda sensor: _score(sensor, chunks, datagrams=datagrams))
    if not any(score.share >= FITTING_SHARE for score in scores):
        scores += _score_each(
            candidates, lambda sensor: _score_mid_stream(sensor, chunks, datagrams=datagrams)
        )
    return sorted(scores, key=lambda score: (-score.share, score.sensor.id))


def _list_sensors_with_frames() -> list[Sensor]:
    """Return the installed sensors whose frames are known without configuration."""
    return [sensor for sensor in sensors().values() if sensor.incoming]


def find_wrong_checksums(chunks: Sequence[bytes], *, datagrams: bool) -> str:
    """Return a message about frames of a sensor with wrong checksums.

    Returns:
        The message; "" if no such frames are found.
    """
    unchecked = _score_each(
        _list_sensors_with_frames(),
        lambda sensor: _score(sensor, chunks, datagrams=datagrams, sums=_read_stored_checksums),
    )
    matches = [
        score
        for score in unchecked
        if score.share >= CLEAR_SHARE and score.data_frames >= MIN_UNCHECKED_FRAMES
    ]
    if not matches or _score(matches[0].sensor, chunks, datagrams=datagrams) is not None:
        return ""
    names = [item.frame for item in matches[0].frames]
    name = max(set(names), key=names.count)
    frames = [item.data for item in matches[0].frames if item.frame == name]
    ids = " or ".join(score.sensor.id for score in matches)
    text = (
        f"{len(frames)} {name} frames have the constants and lengths of {ids}, but all have wrong"
        " checksums"
    )
    match = next(iter(search(frames, quick=True)), None)
    if match is None:
        return f"{text}; no other checksum algorithm was found"
    length = len(frames[0])
    covered = sum(last - first for first, last in match.span.ranges(match.place, length))
    return (
        f"{text}. In {match.right} of {match.total} frames, the checksum field ({match.place})"
        f" contains {match.algorithm.describe()}, computed over {covered} of {length} bytes"
        f" ({match.span.describe(match.place, length)})"
    )


def _read_stored_checksums(checksum: FrameChecksum, rows: Bytes2D) -> NDArray[np.uint64]:
    """Return the checksums that frames contain, (n,).

    A decoder that uses this function instead of computing the checksums accepts every checksum.

    Args:
        checksum: the checksum as the struct of the frame declares it.
        rows: the bytes of the frames, one row per frame.
    """
    return checksum.load_stored(rows)


def _score_each(
    candidates: Sequence[Sensor], rate: Callable[[Sensor], Score | None]
) -> list[Score]:
    """Return the scores of the sensors for which `rate` returns a score.

    Sensors with the same frames are rated only once. A sensor with a faulty description is ignored
    with a warning.
    """
    shared: dict[object, Score | None] = {}  # key: identity of the frames, and id of the sensor
    for sensor in candidates:
        frames = (
            sensor.fillers,
            *(
                (name, id(frame.struct), frame.plausible, frame.after)
                for name, frame in sensor.frames.items()
            ),
        )
        if frames not in shared:
            try:
                shared[frames] = rate(sensor)
            except SpecError as error:
                warnings.warn(f"{sensor.id} is ignored: {error}", stacklevel=2)
                shared[frames] = None
        if (score := shared[frames]) is not None:
            shared[sensor.id] = replace(
                score,
                sensor=sensor.configure(**score.sensor.options) if score.sensor.options else sensor,
            )
    return [score for key, score in shared.items() if isinstance(key, str) and score is not None]


def _score(
    sensor: Sensor, chunks: Sequence[bytes], *, datagrams: bool, sums: Sums | None = None
) -> Score | None:
    """Return the score of a sensor; None if the bytes contain no data frame."""
    if sensor.recognise is not None and datagrams and (options := sensor.recognise(tuple(chunks))):
        sensor = sensor.configure(**options)
    decoder = Decoder(sensor, stream=not datagrams, sums=sums)
    # Decode all chunks in one call: one call per chunk takes ten times as long.
    if datagrams:
        items = decoder.datagrams(chunks).to_found()
    else:
        items = decoder.feed(b"".join(chunks))
    items += decoder.finish()
    count = sum(decoder.stats.frames.get(name, 0) for name in sensor.main_frames)
    if not count:
        if failure := decoder.stats.failure(sensor.id):
            warnings.warn(str(failure), stacklevel=2)
        return None
    share = 1 - decoder.stats.bytes_skipped / decoder.stats.bytes_in
    return Score(sensor, share, count, tuple(items))


def _score_mid_stream(sensor: Sensor, chunks: Sequence[bytes], *, datagrams: bool) -> Score | None:
    """Return the score of a sensor that was already sending; None if it does not fit."""
    names = [name for name in sensor.data_frames if sensor.frames[name].after is not None]
    scores = [_score(sensor.configure(answer=name), chunks, datagrams=datagrams) for name in names]
    return max(
        (score for score in scores if score is not None),
        key=lambda score: score.share,
        default=None,
    )


def identify_sample(sample: SampleBytes) -> Verdict:
    """Identify the sensor that sent some bytes."""
    fitting = [
        score
        for score in rate_sensors(sample.chunks, datagrams=sample.datagrams)
        if score.share >= FITTING_SHARE
    ]
    best = [score for score in fitting if score.share >= fitting[0].share - EQUAL_SHARE_TOLERANCE]
    if not best:
        return Verdict(
            sample, fault=find_wrong_checksums(sample.chunks, datagrams=sample.datagrams)
        )
    result = distinguish(
        [score.sensor for score in best], {score.sensor.id: score.frames for score in best}
    )
    possible = [
        replace(score, evidence=result.candidates[score.sensor.id])
        for score in best
        if score.sensor.id in result.candidates
    ]
    if len(possible) > 1 and sample.baud is not None:
        why = f"the sensor sends at {sample.baud} baud"
        links = [(score, find_data_link(score.sensor, Serial)) for score in possible]
        possible = [
            replace(score, evidence=why)
            for score, link in links
            if link and sample.baud in link.bauds
        ] or possible
    possible = [
        replace(
            score,
            evidence=score.evidence
            or ", ".join(f"{name}={value}" for name, value in score.sensor.options.items()),
        )
        for score in possible
    ]
    # Sensors of the vendor with the most candidates are first, because it is the likeliest vendor.
    vendors = [score.sensor.vendor for score in possible]
    possible.sort(key=lambda score: (-vendors.count(score.sensor.vendor), score.sensor.id))
    possible_ids = {score.sensor.id for score in possible}
    excluded = [score for score in fitting if score.sensor.id not in possible_ids]
    return Verdict(sample, (*possible, *excluded), tuple(possible), result.others)


def identify_senders(
    source: str | Path,
    *,
    seconds: float = LISTEN_S,
    on_progress: Callable[[str], None] = ignore_progress,
) -> list[Verdict]:
    """Identify the sensors of a source; return one verdict for each sender.

    For a serial port, returns the verdict for the baud rate that fits best.

    Args:
        seconds: the time to listen at each baud rate.

    Raises:
        SourceError: if the source cannot be opened.
    """
    verdicts: list[Verdict] = []
    for sample in read_samples(source, seconds=seconds, on_progress=on_progress):
        verdicts.append(identify_sample(sample))
        if sample.baud is not None and verdicts[-1].is_clear:
            break
    if len({verdict.sample.baud for verdict in verdicts}) > 1:
        return [select_best(verdicts)]
    return verdicts


def select_best(verdicts: Sequence[Verdict]) -> Verdict:
    """Return the verdict with the highest share, or with the most bytes if none fits."""

    def key(verdict: Verdict) -> tuple[float, int]:
        share = verdict.scores[0].share if verdict.scores else 0.0
        return share, verdict.sample.size

    return max(verdicts, key=key)


def detect(source: str | Path) -> Sensor:
    """Return the installed sensor that sends to a source.

    If the source declares its sensor, as a recording does, no bytes are examined.

    Raises:
        CommandError: if a live source sends nothing.
        WireError: if no sensor fits.
        UsageError: if several sensors fit equally well.
        SourceError: if the source cannot be opened.
    """
    declared_sensor = find_declared_sensor(source)
    if declared_sensor is not None:
        return declared_sensor
    verdicts = identify_senders(resolve_device_name(source))
    fitting = [verdict for verdict in verdicts if verdict.scores]
    if not fitting:
        raise _make_no_sensor_error(str(source), verdicts)
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
            f"{source}: received data from several sensors: {listed}; choose one with ?src=ADDRESS"
            " and -s"
        )
    if fitting[0].sensor is None:
        example = format_sensor_options(fitting[0].candidates[0].sensor)
        raise UsageError(
            f"{source}: {', '.join(list_candidates(fitting[0]))} send the same frames: choose one,"
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
    """Return the subcommand that shows a sensor's data."""
    if sensor.has_points:
        return "view"
    return "stats"


def list_candidates(verdict: Verdict) -> list[str]:
    """Return the ids of all possible sensors, marked if they are not installed."""
    return [
        *(score.sensor.id for score in verdict.candidates),
        *(f"{name} (not installed)" for name in verdict.others),
    ]


def describe_unsupported_models(verdict: Verdict) -> str:
    """Return a message for frames of models without an installed plugin."""
    return (
        " or ".join(f"these are frames of {name} ({why})" for name, why in verdict.others.items())
        + ", which no installed plugin supports"
    )


def find_declared_sensor(source: str | Path) -> Sensor | None:
    """Return the sensor that a source declares; None if it declares no sensor.

    Devices in `lidarspec.toml`, recordings and simulations can declare a sensor.

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
    """Return the sensor of a source "sim:ID"; None for any other source."""
    address = live_address(source)
    if address is None or address.scheme != "sim" or not address.location:
        return None
    return named_sensor(address.location)


def _make_no_sensor_error(source: str, verdicts: Sequence[Verdict]) -> Exception:
    """Return the error for a source that no installed sensor fits."""
    largest = max(
        (verdict.sample for verdict in verdicts),
        key=lambda sample: sample.size,
        default=SampleBytes(source),
    )
    if fault := next((verdict.fault for verdict in verdicts if verdict.fault), ""):
        return suggest(WireError(f"{source}: {fault}"), f"lidarspec crc {quote(str(source))}")
    if largest.size:
        kind = " in this text" if largest.is_text else ""
        error = WireError(
            f"{source}: found no frame of an installed sensor{kind}",
            data=largest.chunks[0][:MAX_SHOWN_BYTES],
        )
        return suggest_installation(error, largest)
    if live_address(source) is None:
        return WireError(no_bytes_message(source, largest.warnings))
    if largest.warnings:
        why = largest.warnings[0]
    else:
        why = f"{source}: no data received; if the sensor must be started first, name it with -s"
    return suggest(CommandError(why), f"lidarspec doctor {quote(source)}")


#: The minimum number of equal constant bits for bytes to resemble a frame type.
MIN_CONSTANT_BITS = 8


def find_fitting_sensors(chunks: Sequence[bytes], *, datagrams: bool) -> list[Sensor]:
    """Return the installed sensors that fit some bytes, best first.

    If the bytes are exactly one frame, returns only sensors with this frame.
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
    return [
        score.sensor
        for score in scores
        if score.share >= max(scores[0].share - EQUAL_SHARE_TOLERANCE, FITTING_SHARE)
    ]


def find_nearest_fault(data: bytes) -> WireError | None:
    """Return the error of the installed sensor that parsed most of an invalid frame.

    Returns None if no frame type begins like the data.
    """
    errors = []
    for sensor in sensors().values():
        try:
            identify(sensor, data)
        except WireError as error:
            errors.append(error)
        except LidarSpecError:
            continue
    return max(
        (error for error in errors if _begins_like_frame(error)),
        key=lambda error: error.offset,
        default=None,
    )


def _is_frame(sensor: Sensor, name: str, data: bytes) -> bool:
    """Return whether the bytes are exactly one valid and plausible frame of a type."""
    frame = sensor.frames[name]
    if not 0 < len(data) <= frame.max_length:
        return False
    try:
        codec = get_codec(frame)
        if not _has_prefix(codec, data):
            return False
        survey = codec.survey(np.frombuffer(data, np.uint8), np.zeros(1, np.intp))
    except SpecError:
        return False
    return bool(survey.status[0] == VALID and survey.sizes[0] == len(data))


def _has_prefix(codec: Codec, data: bytes) -> bool:
    """Return whether bytes begin with the constants of a frame type."""
    return not any(
        offset >= len(data) or data[offset] & mask != value
        for offset, (mask, value) in codec.prefix.items()
    )


def _begins_like_frame(fault: WireError) -> bool:
    """Return whether the invalid bytes that caused an error begin like a frame.

    The bytes must have the constants at the start of the frame type, as far as the bytes reach, and
    these constants must have at least `MIN_CONSTANT_BITS` bits.
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
