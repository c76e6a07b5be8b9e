"""The framing rule as functions of a sensor that fail if it is broken.

Each function compares the decoder with the oracle, or with itself on other input, on data that has
broken other parsers. They are functions, not tests, so that they can also run on parsers with a
deliberate mistake. `length` is the size of the streams in bytes: the quick tier uses short streams,
the slow one `streams.LENGTH`.
"""

from __future__ import annotations

from lidarspec import Sensor
from lidarspec.testing import sensor_under_test as material
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.agreement import cuts
from tests.engine.oracle import Cut, Oracle
from tests.engine.streams import (
    LENGTH,
    MANY_HEADERS,
    Books,
    clean,
    cut_randomly,
    damage,
    decode_chunks,
    longest_example,
)

ERROR_RATES = (0.0, 1e-4, 1e-3, 5e-3)
BURST_BYTES = (8, 16, 64)
#: Offsets at which a short stream is split in two.
QUICK_SPLITS = 16


def assert_like_oracle(subject: SensorUnderTest, data: bytes, description: str) -> None:
    """Fail unless the decoder finds the same frames in a stream as the oracle."""
    frames = decode_chunks(subject.sensor, data)
    expected = Oracle(subject.sensor, data).frames()
    missed = [cut[:2] for cut in expected if cut not in frames]
    extra = [cut[:2] for cut in frames if cut not in expected]
    assert frames == expected, f"{description}: missed {missed}, extra {extra}"


def any_split_gives_the_same(subject: SensorUnderTest, length: int = LENGTH) -> None:
    """Check that 2-way splits, single bytes and random splits give the same frames and counters.

    Streams of `streams.LENGTH` are split at every byte, shorter ones at random places.
    """
    sensor = subject.sensor
    source = subject.make_random("splits")
    data = material.mutate(subject.stream(rounds=1), source) + subject.stream(seed=1, rounds=1)
    data = data[: max(length // 2, 2 * _longest_frame(sensor))]
    offsets = material.pick_offsets(len(data), source)
    if length < LENGTH:
        offsets = source.sample(range(len(data)), min(QUICK_SPLITS, len(data)))
    splits = [[data[:offset], data[offset:]] for offset in offsets]
    splits += [list(cut_randomly(data, source)) for _ in range(len(offsets) // 4)]
    splits.append([data[offset : offset + 1] for offset in range(len(data))])
    _assert_same_in_pieces(sensor, data, splits)


def _longest_frame(sensor: Sensor) -> int:
    return max(len(sensor.example(name)) for name in sensor.incoming)


def _assert_same_in_pieces(sensor: Sensor, data: bytes, splits: list[list[bytes]]) -> None:
    """Fail unless each split of a stream gives the frames and counters of the whole."""
    books = Books(sensor).feed(data)
    expected = books.finish()
    whole = books.decoder
    for split in splits:
        parts = Books(sensor)
        for chunk in split:
            parts.feed(chunk)
        assert parts.finish() == expected, (
            f"{len(split)} pieces, the first of {len(split[0])} bytes"
        )
        assert parts.decoder.stats == whole.stats, (
            f"{len(split)} pieces, the first of {len(split[0])} bytes"
        )


def every_recoverable_frame_is_recovered(subject: SensorUnderTest, length: int = LENGTH) -> None:
    """Check the frames against the oracle at every byte error rate, single bytes and bursts."""
    for rate in ERROR_RATES:
        data = damage(_part(subject, length, f"{rate:g}"), rate, 1)
        assert_like_oracle(subject, data, f"error rate {rate:g}")
    for burst in BURST_BYTES:
        data = damage(_part(subject, length, f"{burst}"), 0.05, 2, burst=burst)
        assert_like_oracle(subject, data, f"bursts of {burst} bytes")


def _part(subject: SensorUnderTest, length: int, purpose: str) -> bytes:
    """Return part of a conversation, from a random offset.

    A whole round is too long if a sensor has many frame types.
    """
    data = clean(subject, length=length)
    start = subject.make_random(purpose).randrange(max(len(data) - length, 1))
    return data[start : start + length]


def a_claimed_length_costs_no_frame(subject: SensorUnderTest, length: int = LENGTH) -> None:
    """Check that no valid frame is lost after a truncated or damaged frame."""
    whole = subject.stream(rounds=1)[:length]
    heads = 50 if length >= LENGTH else 12
    for frame in dict(subject.conversation(rounds=1)).values():
        assert_like_oracle(
            subject,
            frame[:-1] + bytes([frame[-1] ^ 1]) + whole,
            "behind a frame with a damaged end",
        )
        for end in range(1, min(len(frame), heads)):
            assert_like_oracle(
                subject, frame[:end] + whole, f"behind the first {end} bytes of a frame"
            )


def a_header_may_start_at_every_byte(subject: SensorUnderTest, length: int = LENGTH) -> None:
    """Check that stray bytes and repeated first bytes before a frame lose no frame."""
    frames = subject.conversation(rounds=3 if length >= LENGTH else 1)
    first = frames[0][1][:1]
    for stray in (b"\xfe", b"\xff", b"\x00", *(first * number for number in range(1, 5))):
        data = b"".join(stray + frame for _, frame in frames)
        assert_like_oracle(subject, data, f"{stray.hex(' ')} before each frame")


def noise_is_cut_by_the_rule(subject: SensorUnderTest, length: int = LENGTH) -> None:
    """Check constant lines, and noise made of headers, against the oracle."""
    source = subject.make_random("noise")
    whole = subject.stream(rounds=1)[:length]
    idle_bytes = length // 5
    for byte in (b"\x00", b"\xff"):
        assert_like_oracle(
            subject,
            byte * idle_bytes + whole + byte * idle_bytes,
            f"between {idle_bytes} bytes {byte.hex()}",
        )
    starts = {frame[:size] for _, frame in subject.conversation(rounds=1) for size in (1, 2, 3, 4)}
    for start in sorted(starts):
        assert_like_oracle(
            subject, start * (length // 8 // len(start)), f"headers of {len(start)} bytes alone"
        )
    heads = [frame[: source.randint(1, 6)] for _, frame in subject.conversation(rounds=2)] + [
        b"\x00",
        b"\xff",
        b"\xfe",
    ]
    weights = [*[9] * len(heads), 2 * len(heads)]
    data = b"".join(source.choices([*heads, whole], weights, k=60))[:length]
    assert_like_oracle(subject, data, "noise made of headers")


def announcements_may_change_with_every_frame(
    subject: SensorUnderTest, length: int = LENGTH
) -> None:
    """Check frames after their own announcement and after other announcements.

    Announcements and frames come in any order. Some frames are truncated or damaged.
    """
    sensor = subject.sensor
    source = subject.make_random("changes")
    announcing = sorted({frame.after for frame in sensor.incoming.values() if frame.after})
    if not announcing:
        return
    data = b""
    while len(data) < length:
        name = source.choice([*sensor.incoming, *announcing, *announcing])
        frame = subject.example(name, seed=source.randrange(6)) * source.choice(
            (1, sensor.frames[name].confirm)
        )
        data += source.choice(
            (frame, frame, frame[: source.randint(1, 5)], material.mutate(frame, source))
        )
    assert_like_oracle(subject, data, "announcements in any order")
    _assert_same_in_pieces(sensor, data, [list(cut_randomly(data, source)) for _ in range(10)])


def the_longest_frame_is_a_frame(subject: SensorUnderTest, length: int = LENGTH) -> None:
    """Check that the longest of many examples is found in a stream."""
    for name in subject.sensor.incoming:
        frame = subject.sensor.frames[name]
        if frame.after is None and frame.confirm == 1:
            longest = longest_example(subject, name, MANY_HEADERS if length >= LENGTH else 20)
            assert_like_oracle(subject, longest * 2, f"a {name} frame of {len(longest)} bytes")


def idle_gives_up_pending_bytes(subject: SensorUnderTest, length: int = LENGTH) -> None:
    """Check that pending bytes are released when the input falls silent.

    They are never joined to later bytes.
    """
    frames = subject.conversation(rounds=2)
    whole = b"".join(data for _, data in frames)
    _, last = frames[-1]
    for end in sorted({1, 2, 3, len(last) // 2, len(last) - 1} - {0, len(last)}):
        books = Books(subject.sensor).feed(whole + last[:end])
        books.finish()
        assert books.decoder.stats.pending == 0
        count = len(books.found)
        books.feed(last[end:])
        later = [data for _, _, data in books.finish()[count:]]
        assert last not in later, f"its first {end} bytes came before the line fell silent"


def decoders_are_independent(subject: SensorUnderTest, length: int = LENGTH) -> None:
    """Check that two decoders that are fed in turn give the same as each alone."""
    inputs = [damage(clean(subject, seed=seed, length=length // 2), 1e-3, seed) for seed in (3, 4)]
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
    assert together == alone


RULES = (
    any_split_gives_the_same,
    every_recoverable_frame_is_recovered,
    a_claimed_length_costs_no_frame,
    a_header_may_start_at_every_byte,
    noise_is_cut_by_the_rule,
    announcements_may_change_with_every_frame,
    the_longest_frame_is_a_frame,
    idle_gives_up_pending_bytes,
    decoders_are_independent,
)
