"""The framing rule as functions of a sensor that fail where it is broken: against the oracle, and for whatever has broken other parsers.

They are functions, not tests, so that parsers with a mistake put in on purpose can be held to them too, and be caught.
"""

from __future__ import annotations

from lidarspec import Sensor
from lidarspec.testing import subject as material
from lidarspec.testing.agreement import cuts
from lidarspec.testing.subject import Subject
from tests.engine.oracle import Cut, Oracle
from tests.engine.streams import LENGTH, Books, clean, damaged, decoded, longest_example

RATES = (0.0, 1e-4, 1e-3, 5e-3)  # the first that damages anything damages one run
BURSTS = (8, 16, 64)


def hold(subject: Subject, data: bytes, what: str) -> None:
    """Fail unless the decoder finds in a stream what the oracle finds."""
    found, wanted = decoded(subject.sensor, data), Oracle(subject.sensor, data).frames()
    missed, extra = [cut for cut in wanted if cut not in found], [cut for cut in found if cut not in wanted]
    assert found == wanted, f"{what}: missed {[cut[:2] for cut in missed]}, found besides {[cut[:2] for cut in extra]}"


def any_split_gives_the_same(subject: Subject) -> None:
    """Every 2-way split, byte by byte, and random splits give the same frames and counters."""
    sensor, source = subject.sensor, subject.source("splits")
    data = material.mutated(subject.stream(rounds=1), source) + subject.stream(seed=1, rounds=1)
    splits = [[data[:spot], data[spot:]] for spot in material.places(len(data), source)]
    splits += [list(material.pieces(data, source)) for _ in range(20)]
    _same_in_pieces(sensor, data, [*splits, [data[spot : spot + 1] for spot in range(len(data))]])


def _same_in_pieces(sensor: Sensor, data: bytes, splits: list[list[bytes]]) -> None:
    """Fail unless each split of a stream gives the frames and counters of the whole."""
    books = Books(sensor).feed(data)
    expected, whole = books.finish(), books.decoder
    for split in splits:
        parts = Books(sensor)
        for chunk in split:
            parts.feed(chunk)
        assert parts.finish() == expected, f"{len(split)} pieces, the first of {len(split[0])} bytes"
        assert parts.decoder.stats == whole.stats, f"{len(split)} pieces, the first of {len(split[0])} bytes"


def every_recoverable_frame_is_recovered(subject: Subject, length: int = LENGTH) -> None:
    """At every byte error rate, single and in bursts, the frames are those of the oracle."""
    for rate in RATES:
        hold(subject, damaged(_part(subject, length, f"{rate:g}"), rate, 1), f"of the bytes {rate:g} damaged")
    for burst in BURSTS:
        hold(subject, damaged(_part(subject, length, f"{burst}"), 0.05, 2, burst=burst), f"bursts of {burst} damaged bytes")


def _part(subject: Subject, length: int, purpose: str) -> bytes:
    """So many bytes of a conversation, which begins anywhere in it: one round of a sensor with many frame types is long."""
    data = clean(subject, length=length)
    start = subject.source(purpose).randrange(max(len(data) - length, 1))
    return data[start : start + length]


def a_claimed_length_is_not_believed(subject: Subject) -> None:
    """The head of a frame in front of frames, and a frame with a bad end, cost none of those behind."""
    whole = subject.stream(rounds=1)
    for frame in dict(subject.conversation(rounds=1)).values():
        hold(subject, frame[:-1] + bytes([frame[-1] ^ 1]) + whole, "behind a frame with a damaged end")
        for end in range(1, min(len(frame), 50)):
            hold(subject, frame[:end] + whole, f"behind the first {end} bytes of a frame")


def the_start_of_a_header_is_looked_for_at_every_byte(subject: Subject) -> None:
    """Stray bytes and repeated first bytes between frames cost none of them."""
    frames = subject.conversation()
    first = frames[0][1][:1]
    for stray in (b"\xfe", b"\xff", b"\x00", *(first * number for number in range(1, 5))):
        hold(subject, b"".join(stray + frame for _, frame in frames), f"with {stray.hex(' ')} before each frame")


def noise_is_cut_as_the_rule_says(subject: Subject) -> None:
    """Constant lines, and noise made of headers, give the frames of the oracle and no others."""
    source = subject.source("noise")
    whole = subject.stream(rounds=1)
    for byte in (b"\x00", b"\xff"):
        hold(subject, byte * 300 + whole + byte * 300, f"between 300 bytes {byte.hex()}")
    for head in sorted({frame[:size] for _, frame in subject.conversation(rounds=1) for size in (1, 2, 3, 4)}):
        hold(subject, head * (200 // len(head)), f"headers of {len(head)} bytes alone")
    heads = [data[: source.randint(1, 6)] for _, data in subject.conversation(rounds=2)] + [b"\x00", b"\xff", b"\xfe"]
    data = b"".join(source.choices([*heads, whole], [*[9] * len(heads), 2 * len(heads)], k=60))[:6000]
    hold(subject, data, "noise made of headers")


def what_is_looked_for_may_change_with_every_frame(subject: Subject, length: int = LENGTH) -> None:
    """Announcements in any order, frames behind their own and behind others', whole, cut off and damaged, in one piece and in many."""
    sensor, source = subject.sensor, subject.source("changes")
    named = sorted({frame.after for frame in sensor.incoming.values() if frame.after})
    parts, size = list[bytes](), 0
    while named and size < length:
        name = source.choice([*sensor.incoming, *named, *named])
        frame = subject.example(name, seed=source.randrange(6)) * source.choice((1, sensor.frames[name].confirm))
        parts.append(source.choice((frame, frame, frame[: source.randint(1, 5)], material.mutated(frame, source))))
        size += len(parts[-1])
    data = b"".join(parts)
    hold(subject, data, "announcements in any order")
    _same_in_pieces(sensor, data, [list(material.pieces(data, source)) for _ in range(10)])


def the_longest_frame_is_a_frame(subject: Subject) -> None:
    """The longest of many examples is found in a stream."""
    for name in subject.sensor.incoming:
        frame = subject.sensor.frames[name]
        if frame.after is None and frame.confirm == 1:
            longest = longest_example(subject, name)
            hold(subject, longest * 2, f"a {name} frame of {len(longest)} bytes")


def idle_gives_up_what_waits(subject: Subject) -> None:
    """What waits when the line falls silent is given up, looked at again, and never joined to what comes later."""
    frames = subject.conversation(rounds=2)
    whole = b"".join(data for _, data in frames)
    _, last = frames[-1]
    for end in sorted({1, 2, 3, len(last) // 2, len(last) - 1} - {0, len(last)}):
        books = Books(subject.sensor).feed(whole + last[:end])
        books.finish()
        assert books.decoder.stats.pending == 0
        known = len(books.found)
        books.feed(last[end:])
        assert last not in [data for _, _, data in books.finish()[known:]], f"its first {end} bytes came before the line fell silent"


def decoders_do_not_know_of_each_other(subject: Subject) -> None:
    """Two decoders fed in turn give what each gives alone."""
    inputs = [damaged(clean(subject, seed=seed, length=1000), 1e-3, seed) for seed in (3, 4)]
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
    a_claimed_length_is_not_believed,
    the_start_of_a_header_is_looked_for_at_every_byte,
    noise_is_cut_as_the_rule_says,
    what_is_looked_for_may_change_with_every_frame,
    the_longest_frame_is_a_frame,
    idle_gives_up_what_waits,
    decoders_do_not_know_of_each_other,
)
