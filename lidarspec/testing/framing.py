"""Damage to a stream, by seed: bytes dropped, flipped and put in, one by one or in bursts.

What the framing rule of the documentation says, byte by byte and by brute force; it shares no code with the engine's framing.

construct parses the author's own struct at one offset, the frame's own test of plausibility judges what came out, and
nothing is done in bulk, so that the engine's bulk work has something to be held against.

The framing rule, held against the brute-force oracle: damaged streams, any split of them, and what has broken other parsers.

Linear time: how much longer twice the worst input takes, as a ratio within one run.
"""

from __future__ import annotations

import contextlib
import io
import random
import time
from typing import Any

import numpy as np
from construct import ConstructError

from lidarspec.columns.columns import Batch, Fields
from lidarspec.errors import SpecError
from lidarspec.framing.frame_engine import CompiledCodec, InterpretedCodec, codec
from lidarspec.framing.results import Counters
from lidarspec.simulation.frame_maker import examples
from lidarspec.spec.description import Frame
from lidarspec.spec.sensor import Sensor
from lidarspec.testing import subject as material
from lidarspec.testing.comparisons import cuts
from lidarspec.testing.findings import Violation, require
from lidarspec.testing.subject import MANY, Subject

RATES = (0.0, 1e-5, 1e-4, 1e-3, 5e-3)
BURSTS = (8, 16, 64)


def damaged(data: bytes, rate: float, seed: int, *, burst: int = 1) -> bytes:
    """The stream with about this share of its bytes damaged, in runs of `burst`; at least one run, unless the rate is 0."""
    if not rate:
        return data
    source = random.Random(f"{seed} {rate} {burst}")
    number = max(1, round(len(data) * rate / burst))
    found = bytearray(data)
    for _ in range(number):
        spot = source.randrange(len(found) + 1)
        kind = source.choice(("drop", "flip", "insert"))
        noise = source.randbytes(burst)
        if kind == "drop":
            del found[spot : spot + burst]
        elif kind == "insert":
            found[spot:spot] = noise
        else:
            found[spot : spot + burst] = bytes(a ^ (1 << b % 8) for a, b in zip(found[spot : spot + burst], noise, strict=False))
    return bytes(found)


#: (name, offset, bytes) of a frame.
Cut = tuple[str, int, bytes]


class Oracle:
    """The frames of one stream, found by trying every type at every offset."""

    def __init__(self, sensor: Sensor, data: bytes) -> None:
        self._frames = {name: frame for name, frame in sensor.frames.items() if frame.direction == "in"}
        self._codecs = {name: InterpretedCodec(frame) for name, frame in self._frames.items()}
        self._named = {frame.after for frame in self._frames.values()} - {None}
        answer = sensor.options.get("answer")
        self._mode = self._frames[answer].after if answer else None
        self._data = data
        self._known: dict[tuple[str, int], int] = {}

    def frames(self) -> list[Cut]:
        """The leftmost valid candidate, then on after its last byte; one byte further where there is none."""
        found: list[Cut] = []
        spot, run = 0, ("", -1)
        while spot < len(self._data):
            name = next((name for name in self._frames if self._accepted(name, spot, run)), None)
            if name is None:
                spot += 1
                continue
            size = self._valid(name, spot)
            found.append((name, spot, self._data[spot : spot + size]))
            self._mode = name if name in self._named else self._mode
            spot += size
            run = (name, spot)
        return found

    def _accepted(self, name: str, spot: int, run: tuple[str, int]) -> bool:
        """Whether a type stands here: valid, and if it is weak, within a long enough run of its kind."""
        for _ in range(1 if run == (name, spot) else self._frames[name].confirm):
            if not self._valid(name, spot) or self._earlier(name, spot, run):
                return False
            spot += self._valid(name, spot)
        return True

    def _earlier(self, name: str, spot: int, run: tuple[str, int]) -> bool:
        before = list(self._frames)[: list(self._frames).index(name)]
        return any(self._accepted(other, spot, run) for other in before)

    def _valid(self, name: str, spot: int) -> int:
        """The size of the valid candidate of this type at this offset, 0 if there is none."""
        if self._frames[name].after not in (None, self._mode):
            return 0
        if (name, spot) not in self._known:
            self._known[name, spot] = self._size(name, self._frames[name], spot)
        return self._known[name, spot]

    def _size(self, name: str, frame: Frame, spot: int) -> int:
        stream = io.BytesIO(self._data[spot : spot + frame.max_length])
        try:
            frame.prepared.parse_stream(stream)
        except ConstructError:
            return 0
        size = stream.tell()
        return size if frame.plausible is None or self._sensible(name, frame.plausible, self._data[spot : spot + size]) else 0

    def _sensible(self, name: str, plausible: Any, data: bytes) -> bool:
        with np.errstate(all="ignore"):
            return bool(np.all(np.asarray(plausible(Fields(Batch(self._codecs[name].table([data]), np.zeros(1, np.bool_)))))))


#: about so many bytes to a stream: the oracle takes its time.
LENGTH = 2500


class Books:
    """A decoder whose books are checked after every call: each byte is in a frame, skipped or pending."""

    def __init__(self, sensor: Sensor, *, backend: str = "auto") -> None:
        self.decoder = sensor.decoder(backend=backend)
        self.found: list[Cut] = []

    def feed(self, chunk: bytes) -> Books:
        """Enter what a chunk brings."""
        return self._entered(cuts(self.decoder.feed(chunk)))

    def finish(self) -> list[Cut]:
        """All frames, after the end of the input."""
        return self._entered(cuts(self.decoder.finish())).found

    def _entered(self, found: list[Cut]) -> Books:
        self.found += found
        stats: Counters = self.decoder.stats
        known = sum(len(data) for _, _, data in self.found)
        require(
            stats.bytes_in == known + stats.bytes_skipped + stats.pending,
            "LS412",
            f"{stats.bytes_in} bytes came in; {known} are in frames, {stats.bytes_skipped} skipped, {stats.pending} pending",
        )
        require(
            sum(stats.frames.values()) == len(self.found), "LS412", f"{len(self.found)} frames came out, and {stats.frames} are counted"
        )
        return self


def decoded(sensor: Sensor, data: bytes) -> list[Cut]:
    """The frames of a stream that comes in chunks of random sizes."""
    books = Books(sensor)
    for chunk in material.pieces(data, random.Random(len(data))):
        books.feed(chunk)
    return books.finish()


def hold(subject: Subject, data: bytes, code: str, what: str) -> None:
    """Raise the violation of a rule unless the decoder finds in a stream what the oracle finds.

    Raises:
        Violation: with the first frame that differs.
    """
    found, wanted = decoded(subject.sensor, data), Oracle(subject.sensor, data).frames()
    if found == wanted:
        return
    missed, extra = [one for one in wanted if one not in found], [one for one in found if one not in wanted]
    name, offset, frame = (missed or extra or wanted)[0]
    kind = "is missed" if missed else "is not one"
    raise Violation(code, f"{what}: the frame at byte {offset} ({len(frame)} bytes) {kind}", name)


def long_stream(subject: Subject, *, seed: int = 0, length: int = LENGTH) -> bytes:
    """A clean conversation of about this length."""
    rounds = max(length // max(len(subject.stream(rounds=1)), 1), 1)
    return subject.stream(seed=seed, rounds=rounds)


def any_split_of_a_stream_gives_the_same(subject: Subject) -> None:
    """Every 2-way split, byte by byte, and random splits give the same frames and counters."""
    sensor, source = subject.sensor, subject.source("splits")
    data = material.mutated(subject.stream(rounds=1), source) + subject.stream(seed=1, rounds=1)
    books = Books(sensor).feed(data)
    expected, whole = books.finish(), books.decoder
    few = len(sensor.frames) > MANY
    places = material.places(len(data), source)
    splits = [[data[:spot], data[spot:]] for spot in (places[:: len(places) // 60 + 1] if few else places)]
    splits += [list(material.pieces(data, source)) for _ in range(6 if few else 20)]
    for split in [*splits, [data[spot : spot + 1] for spot in range(len(data))]]:
        parts = Books(sensor)
        for chunk in split:
            parts.feed(chunk)
        found = parts.finish()
        if found != expected:
            lost = next((one for one in expected if one not in found), (found or expected)[0])
            first = len(split[0]) if len(split) == 2 else 1
            raise Violation("LS405", f"split at byte {first}, the frame at byte {lost[1]} is not found as in one piece", lost[0])
        require(parts.decoder.stats == whole.stats, "LS405", "the counters depend on the split")


def every_recoverable_frame_is_recovered(subject: Subject) -> None:
    """At every byte error rate, single and in bursts, the frames are those of the oracle."""
    for rate in RATES:
        hold(subject, damaged(long_stream(subject), rate, 1), "LS406", f"of the bytes {rate:g} damaged")
    for burst in BURSTS:
        hold(subject, damaged(long_stream(subject, seed=1), 0.05, 2, burst=burst), "LS406", f"bursts of {burst} damaged bytes")


def a_claimed_length_is_not_believed(subject: Subject) -> None:
    """The head of a frame in front of frames, and a frame with a bad end, cost none of those behind."""
    whole = subject.stream(rounds=1)
    for frame in dict(subject.conversation(rounds=1)).values():
        hold(subject, frame[:-1] + bytes([frame[-1] ^ 1]) + whole, "LS407", "behind a frame with a damaged end")
        for end in range(1, min(len(frame), 50), 1 if len(subject.sensor.frames) <= MANY else 7):
            hold(subject, frame[:end] + whole, "LS407", f"behind the first {end} bytes of a frame")


def the_start_of_a_header_is_looked_for_at_every_byte(subject: Subject) -> None:
    """Stray bytes and repeated first bytes between frames cost none of them."""
    frames = subject.conversation()
    first = frames[0][1][:1]
    for stray in (b"\xfe", b"\xff", b"\x00", *(first * number for number in range(1, 5))):
        hold(subject, b"".join(stray + frame for _, frame in frames), "LS408", f"with {stray.hex(' ')} before each frame")


def noise_is_cut_as_the_rule_says(subject: Subject) -> None:
    """Constant lines, and noise made of headers, give the frames of the oracle and no others."""
    source = subject.source("noise")
    one = subject.stream(rounds=1)
    for byte in (b"\x00", b"\xff"):
        hold(subject, byte * 300 + one + byte * 300, "LS406", f"between 300 bytes {byte.hex()}")
    for head in sorted({frame[:size] for _, frame in subject.conversation(rounds=1) for size in (1, 2, 3, 4)}):
        hold(subject, head * (200 // len(head)), "LS406", f"headers of {len(head)} bytes alone")
    heads = [data[: source.randint(1, 6)] for _, data in subject.conversation(rounds=2)] + [b"\x00", b"\xff", b"\xfe"]
    data = b"".join(source.choices([*heads, one], [*[9] * len(heads), 2 * len(heads)], k=60))[:6000]
    hold(subject, data, "LS406", "noise made of headers")


def the_longest_frame_is_a_frame(subject: Subject) -> None:
    """The longest of many examples is found in a stream."""
    for name in material.incoming(subject.sensor):
        frame = subject.sensor.frames[name]
        if frame.after is None and frame.confirm == 1:
            longest = longest_example(subject, name)
            found = decoded(subject.sensor, longest * 2)
            wanted = Oracle(subject.sensor, longest * 2).frames()
            require(found == wanted, "LS409" if len(longest) == frame.max_length else "LS406", f"a frame of {len(longest)} bytes", name)


def longest_example(subject: Subject, name: str) -> bytes:
    """The longest of many examples, and of the longest header among many."""
    found = [subject.example(name, seed=seed) for seed in range(20)]
    engine, source = codec(subject.sensor.frames[name]), subject.source(f"longest {name}")
    if isinstance(engine, CompiledCodec) and engine.size is None:
        with contextlib.suppress(SpecError):
            _, header = max((engine.tree.choose(source, subject.drawers(name)) for _ in range(200)), key=lambda one: one[0].size)
            drawn = {path: (lambda _, value=value: value) for path, value in header.items()}
            found += examples(subject.sensor, name, source, subject.drawers(name) | drawn)
    return max(found, key=len)


def idle_gives_up_what_waits(subject: Subject) -> None:
    """What waits when the line falls silent is given up, looked at again, and never joined to what comes later."""
    frames = subject.conversation(rounds=2)
    whole = b"".join(data for _, data in frames)
    name, last = frames[-1]
    for end in sorted({1, 2, 3, len(last) // 2, len(last) - 1} - {0, len(last)}):
        books = Books(subject.sensor).feed(whole + last[:end])
        books.finish()
        require(books.decoder.stats.pending == 0, "LS411", f"{books.decoder.stats.pending} bytes are still held after idle", name)
        known = len(books.found)
        books.feed(last[end:])
        joined = [one for one in books.finish()[known:] if one[2] == last]
        require(not joined, "LS411", f"a frame is made of its first {end} bytes before idle and the rest after it", name)


def decoders_do_not_know_of_each_other(subject: Subject) -> None:
    """Two decoders fed in turn give what each gives alone."""
    inputs = [damaged(long_stream(subject, seed=seed, length=1000), 1e-3, seed) for seed in (3, 4)]
    alone = []
    for data in inputs:
        decoder = subject.sensor.decoder()
        alone.append(cuts(decoder.feed(data) + decoder.finish()))
    decoders = [subject.sensor.decoder() for _ in inputs]
    together: list[list[Cut]] = [[], []]
    for start in range(0, max(map(len, inputs)), 13):
        for index, decoder in enumerate(decoders):
            together[index] += cuts(decoder.feed(inputs[index][start : start + 13]))
    for index, decoder in enumerate(decoders):
        together[index] += cuts(decoder.finish())
    require(together == alone, "LS410", "fed in turn, two decoders give other frames than each alone")


#: bytes of the whole input, and of that of a sensor that is not compiled.
GROWN_LENGTH, SHORT = 240_000, 12_000
#: how many times as long twice the input may take, and how often it is tried.
RATIO, TRIES = 3.0, 5
#: CPU seconds below which a difference says nothing.
LEAST = 0.05


def worst(subject: Subject, length: int) -> bytes:
    """Headers that claim the longest frame, and two random bytes: candidates without end, as long as they can be."""
    source = random.Random(subject.sensor.id)
    longest = max((subject.example(subject.sensor.data_frame, seed=seed) for seed in range(40)), key=len)
    unit = b"".join(longest[: source.randint(3, 8)] + source.randbytes(2) for _ in range(64))
    return (unit * (length // len(unit) + 1))[:length]


def time_grows_with_the_input_and_no_faster(subject: Subject) -> None:
    """Twice the garbage, or the worst stream, takes about twice the time."""
    compiled = all(isinstance(codec(frame), CompiledCodec) for frame in subject.sensor.frames.values())
    length = GROWN_LENGTH if compiled else SHORT
    for kind, data in (("noise", random.Random(1).randbytes(length)), ("headers that claim the longest frame", worst(subject, length))):
        _fed(subject.sensor, data[: length // 16])
        shortest = longest = float("inf")
        for _ in range(TRIES):
            shortest = min(shortest, _seconds(subject.sensor, data[: length // 2]))
            longest = min(longest, _seconds(subject.sensor, data))
            if longest <= max(2.2 * shortest, LEAST):
                break
        require(
            longest <= max(RATIO * shortest, LEAST), "LS413", f"twice as many bytes of {kind} take {longest / shortest:.1f} times as long"
        )


def _seconds(sensor: Sensor, data: bytes) -> float:
    """CPU seconds of one run."""
    start = time.process_time()
    _fed(sensor, data)
    return time.process_time() - start


def _fed(sensor: Sensor, data: bytes, chunk: int = 1 << 20) -> None:
    decoder = sensor.decoder()
    for start in range(0, len(data), chunk):
        decoder.feed(data[start : start + chunk])
    decoder.finish()
