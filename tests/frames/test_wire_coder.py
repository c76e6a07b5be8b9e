"""Tests of wire forms on single frames: values read, written and refused."""

from __future__ import annotations

import dataclasses
import math

import pytest
from construct import (
    Array,
    Bytes,
    Const,
    Float32l,
    Float64b,
    Int8ub,
    Int16sb,
    Int16ub,
    Int24ub,
    Int32ub,
    Struct,
    this,
)

from lidarspec import Sensor, SpecError, UsageError, WireError, explain, export
from lidarspec.spec import Echoes, Escaped, Frame, HexCheck, Lines, Scip, SixBits, Tokens
from tests.shapes import SHAPES

TOKENS, LINES, JOINED, ESCAPED = (
    SHAPES[f"shape-{name}"] for name in ("tokens", "lines", "joined", "escaped")
)


def sensor(struct: Struct, form: object, longest: int = 200) -> Sensor:
    """Return a sensor with one frame in this form."""
    frames = {"data": Frame(struct, data=True, max_length=longest, wire=form)}  # type: ignore[arg-type]
    return dataclasses.replace(TOKENS, frames=frames, clock=None, sequence=None)


NUMBERS = sensor(Struct("a" / Int16ub, "b" / Int16sb, "c" / Int32ub), Tokens(start=b"\x02"))


@pytest.mark.parametrize(
    "text", [b"10F FFFE 2710", b"010f fffe 00002710", b"+271 -2 +10000", b"10F -2 0000000000002710"]
)
def test_a_number_is_read_and_built_as_it_was_spelled(text: bytes) -> None:
    data = b"\x02" + text + b"\x03"
    values = NUMBERS.parse(data)
    assert (values.a, values.b, values.c) == (271, -2, 10_000)
    assert NUMBERS.build("data", values) == data
    assert NUMBERS.build("data", {**values, "a": 272}) == b"\x02110 FFFE 2710\x03"


@pytest.mark.parametrize(
    "text",
    [
        b"10000 1 1",
        b"1 +32768 1",
        b"-1 1 1",
        b"+F 1 1",
        b"1 1",
        b"1  1",
        b"1 1 1 1",
        b"G 1 1",
        b"1 1 1 ",
    ],
)
def test_an_invalid_number_makes_no_frame(text: bytes) -> None:
    data = b"\x02" + text + b"\x03"
    with pytest.raises(WireError):
        NUMBERS.parse(data)
    counters = NUMBERS.decode(data + b"\x021 1 1\x03").stats
    assert (counters.frames, counters.bytes_skipped, counters.bad_length) == (
        {"data": 1},
        len(data),
        1,
    )


def test_decimal_tokens_have_signs_and_a_width() -> None:
    decimal = sensor(
        Struct("a" / Int16ub, "b" / Int16sb),
        Tokens(start=b"$", sep=b",", end=b"\n", base=10, width=4),
    )
    assert decimal.build("data", a=65_535, b=-32_768) == b"$65535,-32768\n"
    assert decimal.build("data", a=7, b=-1) == b"$0007,-0001\n"
    assert decimal.parse(b"$7,-1\n") == decimal.parse(b"$0007,-0001\n")


LINE = sensor(
    Struct(
        "talker" / Bytes(2),
        "kind" / Const(b"RMC"),
        "time" / Float64b,
        "status" / Bytes(1),
        "speed" / Float32l,
        "number" / Int8ub,
        "mode" / Bytes(2),
        "extra" / Bytes(1),
    ),
    Tokens(
        start=b"$",
        sep=b",",
        end=b"\r\n",
        base=10,
        check=HexCheck(),
        formats={"time": "hhmmss.ss", "number": "00"},
        joined=2,
        padded=True,
        optional=1,
    ),
)


def line(content: bytes) -> bytes:
    """Return a sentence with its checksum, the XOR of the content."""
    check = 0
    for byte in content:
        check ^= byte
    return b"$%b*%02X\r\n" % (content, check)


@pytest.mark.parametrize(
    ("number", "value"),
    [
        (b"083559.00", 83559.0),
        (b"1", 1.0),
        (b"-12.5", -12.5),
        (b"+0.004", 0.004),
        (b".5", 0.5),
        (b"5.", 5.0),
        (b"4717.11437891", 4717.11437891),
    ],
)
def test_a_decimal_fraction_is_a_float(number: bytes, value: float) -> None:
    data = line(b"GPRMC,%b,A,0.25,07,D,V" % number)
    values = LINE.parse(data)
    assert (values.time, values.speed, values.number) == (value, 0.25, 7)
    assert LINE.build("data", values) == data


@pytest.mark.parametrize(
    "number", [b"1e5", b"nan", b"inf", b"1_0", b" 1", b"1.2.3", b"-", b".", b"0x1", b"1" * 41]
)
def test_other_texts_are_no_decimal_fraction(number: bytes) -> None:
    with pytest.raises(WireError, match="time"):
        LINE.parse(line(b"GPRMC,%b,A,0.25,07,D,V" % number))


def test_a_fraction_is_written_with_the_digits_of_its_format_and_more_if_it_has_more() -> None:
    values = {"talker": b"GP", "status": b"A", "speed": 0.1, "number": 7, "mode": b"D\0"}
    values |= {"extra": b"V"}
    data = LINE.build("data", values, time=61.5)
    assert data == line(b"GPRMC,000061.50,A,0.1,07,D,V")
    assert LINE.build("data", values, time=0.0625) == line(b"GPRMC,000000.0625,A,0.1,07,D,V")
    with pytest.raises(UsageError):
        LINE.build("data", values, time=float("inf"))
    with pytest.raises(UsageError):
        LINE.build("data", values | {"mode": b",,"}, time=1)


def test_empty_and_missing_tokens_are_nan_and_zero_bytes() -> None:
    for ending, extra in ((b",", b"\x00"), (b"", b"\x00"), (b",V", b"V")):
        data = line(b"GPRMC,,,,00,D" + ending)
        values = LINE.parse(data)
        assert math.isnan(values.time)
        assert math.isnan(values.speed)
        assert (values.status, values.mode, values.extra) == (b"\x00", b"D\x00", extra)
        assert LINE.build("data", values) == data
    for content in (b"GPRMC,,,,00", b"GPRMC,,,,,D,V", b"GPRMC,,AB,,00,D", b"GPRMC,,,,00,D,V,"):
        with pytest.raises(WireError):
            LINE.parse(line(content))


def test_a_wrong_checksum_in_digits_is_counted_as_one() -> None:
    good = line(b"GPRMC,1,A,0.25,07,D,V")
    assert LINE.parse(good.replace(good[-4:-2], good[-4:-2].lower())).number == 7
    for bad in (good.replace(b"0.25", b"0.24"), good.replace(b"*", b",")):
        with pytest.raises(WireError, match="checksum"):
            LINE.parse(bad)
        stats = LINE.decode(bad + good).stats
        assert (stats.bad_checksum, stats.frames, stats.bytes_skipped) == (1, {"data": 1}, len(bad))


def test_the_first_token_has_two_fields() -> None:
    assert LINE.parse(line(b"GNRMC,1,A,0.25,07,D,V")).talker == b"GN"
    for content in (b"GPGGA,1,A,0.25,07,D,V", b"G,RMC,1,A,0.25,07,D,V", b"GPSRMC,1,A,0.25,07,D,V"):
        with pytest.raises(WireError):
            LINE.parse(line(content))


def test_the_rest_of_a_frame_may_be_one_field() -> None:
    other = sensor(
        Struct("address" / Bytes(5), "content" / Bytes(20)),
        Tokens(
            start=b"$", sep=b",", end=b"\r\n", base=10, check=HexCheck(), padded=True, rest=True
        ),
    )
    data = line(b"PUBX,1,,two words")
    values = other.parse(data)
    assert (values.address, values.content) == (b"PUBX\x00", b"1,,two words".ljust(20, b"\x00"))
    assert other.build("data", values) == data


def test_characters_of_six_bits_are_those_of_the_specification() -> None:
    """SCIP 2.0, C-42-03320B, 6: "CB" is 1234, "1Dh" 5432, "m2@0" 16000000."""
    struct = Struct("kind" / Const(b"MD"), "two" / Int16ub, "three" / Int24ub, "four" / Int32ub)
    made = sensor(struct, Lines(64, head=(2,), bare=1, check=Scip()) | SixBits())
    data = made.build("data", two=1234, three=5432, four=16_000_000)
    assert data.startswith(b"MD\nCB1Dhm2@0")
    assert made.parse(data).three == 5432
    with pytest.raises(UsageError):
        made.build("data", two=4096, three=0, four=0)
    with pytest.raises(WireError, match="check"):
        made.parse(data.replace(b"1Dh", b"1Di"))
    assert made.decode(data.replace(b"1Dh", b"1Di")).stats.bad_checksum == 1


def test_a_status_of_scip_has_the_sum_of_the_specification() -> None:
    """SCIP 2.0: "00P", "99b", "0Ee"."""
    assert bytes(map(Scip(), (b"00", b"99", b"0E"))) == b"Pbe"


def make_joined_frame(steps: int, characters: bytes) -> bytes:
    """Return a frame of shape-joined with these characters, in lines with checksums."""
    lines = Lines(32, head=(4, 3), bare=1, check=Scip())
    return lines.encode(b"NE0%d000" % steps + characters, ())


def test_a_step_has_as_many_echoes_as_are_sent() -> None:
    data = make_joined_frame(4, b"1Dh055Dh05&1Dh07" + b"00000" + b"00001&00000&00002")
    values = JOINED.parse(data)
    echoes = [[(echo.range, echo.strength) for echo in step.echoes] for step in values.steps]
    assert echoes == [
        [(5432, 5), (0, 0), (0, 0)],
        [(21816, 5), (5432, 7), (0, 0)],
        [(0, 0)] * 3,
        [(0, 1), (0, 0), (0, 2)],
    ]
    assert JOINED.build("data", tens=0, ones=4, time=0, sector=0, steps=values.steps) == data
    spelled = make_joined_frame(1, b"1Dh05&00000")  # an echo of nothing, which would not be sent
    assert JOINED.build("data", JOINED.parse(spelled)) == spelled
    shown = str(explain(data, JOINED)).splitlines()
    assert next(line for line in shown if "strength 7" in line).startswith("0015  31 44 68 30 37")
    assert [line[:10].strip() for line in shown if "strength 2" in line or "(end)" in line] == [
        "002d  30 3",
        "0034  0a",
    ]


@pytest.mark.parametrize(
    ("steps", "characters", "place"),
    [
        (1, b"1Dh05&", 15),
        (1, b"&1Dh05", 10),
        (2, b"1Dh05&&1Dh05", 15),
        (1, b"1Dh&05", 13),
        (2, b"1Dh05&1Dh05&1Dh05&1Dh05", 27),
        (2, b"1Dh05&1Dh05", 24),
        (1, b"1Dh05&1Dh", 22),
        (1, b"1Dh051Dh05", 15),
    ],
    ids=[
        "behind all",
        "before all",
        "twice",
        "within",
        "too many",
        "too few steps",
        "cut",
        "too many steps",
    ],
)
def test_marks_that_join_no_echoes_make_no_frame(steps: int, characters: bytes, place: int) -> None:
    data = make_joined_frame(steps, characters)
    with pytest.raises(WireError) as fault:
        JOINED.parse(data)
    assert fault.value.offset == place
    good = make_joined_frame(1, b"1Dh05")
    assert JOINED.decode(data + good).stats.frames == {"data": 1}


def test_escapes_are_minimal_and_read_everywhere() -> None:
    made = sensor(Struct("count" / Int8ub, "bytes" / Array(this.count, Int8ub)), Escaped())
    data = made.build("data", bytes=[0x7E, 0x11, 0x7D])
    assert data == b"\x7e\x03\x7d\x5e\x11\x7d\x5d\x7e"
    other = data.replace(b"\x11", b"\x7d\x31")
    assert made.parse(other) == made.parse(data)
    assert made.build("data", made.parse(other)) == other
    assert made.decode(b"\x7e\x01\x7d\x7d\x5e\x7e" + data).stats.frames == {"data": 1}


def test_a_text_after_free_text_identifies_candidates() -> None:
    """Bytes that share only the first mark are no candidates, and are not counted."""
    made = sensor(
        Struct("kind" / Bytes(3), "none" / Bytes(0), "name" / Const(b"scan"), "value" / Int8ub),
        Tokens(start=b"\x02"),
    )
    frames = b"".join(b"\x02%s scan 7\x03" % kind for kind in (b"abc", b"a c", b"   "))
    decoder = made.decoder()
    stream = b"\x02 \x02\x02abc rest 1 2\x03" + frames + b"\x02abc sca"
    found = [frame for byte in stream for frame in decoder.feed(bytes([byte]))] + decoder.finish()
    assert [made.parse(frame.data).value for frame in found] == [7, 7, 7]
    assert decoder.stats.bad_length == 1  # of the last one, which has no end
    with pytest.raises(WireError) as fault:
        made.parse(b"\x02abc sCan 7\x03")
    assert (fault.value.path, fault.value.offset) == ("name", 5)


def test_a_fault_has_its_place_on_the_wire() -> None:
    with pytest.raises(WireError) as fault:
        NUMBERS.parse(b"\x0210F XY 1\x03")
    assert (fault.value.path, fault.value.offset, fault.value.expected) == (
        "b",
        5,
        "a 2-byte number",
    )
    with pytest.raises(WireError) as fault:
        ESCAPED.parse(ESCAPED.example("data")[:-3] + b"\x00\x00\x7e")
    assert fault.value.path == "fcs"


@pytest.mark.parametrize("kind", ["c", "wireshark", "ksy"])
def test_an_export_that_cannot_recode_says_what(kind: str) -> None:
    for each in (TOKENS, LINES, JOINED, ESCAPED):
        with pytest.raises(UsageError, match=r"Tokens|Lines|Escaped"):
            export(each, kind)


@pytest.mark.parametrize("kind", ["md", "svg", "pyi"])
def test_pictures_stubs_and_pages_show_the_slots(kind: str) -> None:
    assert "counter" in export(TOKENS, kind)


def test_declarations_that_cannot_be_are_refused() -> None:
    with pytest.raises(SpecError, match="differ"):
        Tokens(start=b" ", sep=b" ")
    with pytest.raises(SpecError, match="max_length"):
        Frame(Struct("a" / Int8ub), wire=Escaped())
    with pytest.raises(SpecError, match="digit"):
        SixBits(echoes=Echoes(3, 3, mark=b"A"))
    with pytest.raises(SpecError, match="head"):
        Lines(64) | SixBits(echoes=Echoes(3, 3))
    struct = Struct("kind" / Const(b"ND"), "echoes" / Array(2, Int24ub))
    with pytest.raises(SpecError, match="got 6"):
        sensor(struct, Lines(64, head=(2,)) | SixBits(echoes=Echoes(3, 3))).example("data")
    with pytest.raises(SpecError, match="differ"):
        Escaped(0x7E, 0x5E)


def test_the_first_byte_of_the_end_alone_ends_no_frame() -> None:
    data = line(b"GPRMC,1,\r,0.25,07,D,V")
    assert [item.data for item in LINE.split(data)] == [data]
    assert LINE.parse(data).status == b"\r"
