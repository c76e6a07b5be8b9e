"""Tests of reading hexadecimal text in all common notations, and refusing ambiguity."""

from __future__ import annotations

import contextlib
import gzip
import io
import re
import shutil
import subprocess
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.errors import WireError
from lidarspec.transports import hex_text
from lidarspec.transports.hex_text import HexText, parse_hex
from lidarspec.transports.open_url import open_transport
from tests.cli.running import ran


@pytest.mark.parametrize(
    "text",
    [
        "8b135a",
        "8B 13 5a",
        "0x8B 0x13 0x5A",
        "0x8b,0x13,0x5a,",
        "{0x8b, 0x13, 0x5a};",
        "8b:13:5a",
        r"\x8b\x13\x5a",
        "8b 13  # sync\n5a // the rest",
        "0000: 8b 13\n0x0002: 5a",
        "\t8b13\n\n  5a\n",
    ],
)
def test_bytes_are_read_as_people_print_them(text: str, tmp_path: Path) -> None:
    assert parse_hex(text) == b"\x8b\x13\x5a"
    (tmp_path / "a.hex").write_text(text, encoding="ascii")
    with contextlib.closing(open_transport(tmp_path / "a.hex")) as opened:
        assert b"".join(chunk.data for chunk in opened.chunks()) == b"\x8b\x13\x5a"


@pytest.mark.parametrize(
    "form", ["8b135a", "8B 13 5a ", "0x8B,0x13,0x5A,", "8b:13:5a:", r"\x8b\x13\x5a", "  8b 135a\t"]
)
def test_a_line_without_end_is_read_in_pieces(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    block = 1 << 13
    monkeypatch.setattr(hex_text, "BLOCK_BYTES", block)
    line = form * (3 * block // len(form))
    (tmp_path / "a.hex").write_text(
        f"0000: {line}# {line}\n{line}\n{line[: block // len(form) * len(form)]}", encoding="ascii"
    )
    with contextlib.closing(open_transport(tmp_path / "a.hex")) as opened:
        found = [chunk.data for chunk in opened.chunks()]
    assert b"".join(found) == parse_hex(line) * 2 + parse_hex(form) * (block // len(form))
    assert max(map(len, found)) <= block


@pytest.mark.parametrize("comment", ["//", "///", "//a/b", "#a//b"])
@pytest.mark.parametrize("digits", range(0, 18, 2))
def test_a_comment_at_the_end_of_a_piece_is_a_comment(
    comment: str, digits: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hex_text, "BLOCK_BYTES", 16)
    for noise in range(4):
        line = io.BytesIO(f"{'8b' * (digits // 2)}{comment}{'x' * (20 + noise)}\n5a\n".encode())
        found = [chunk.data for chunk in hex_text.iter_hex_chunks("a.hex", line.readline)]
        assert b"".join(found) == b"\x8b" * (digits // 2) + b"\x5a"


def test_a_single_digit_is_a_byte_only_with_a_prefix() -> None:
    assert parse_hex("0xa, 0x5") == b"\x0a\x05"
    assert parse_hex("") == b""
    for text, reason in (
        ("a 5", "'a' is not a whole number of bytes"),
        ("0x", "'0x' is not a whole number of bytes"),
        ("a5 z1", "'z' is not a hexadecimal digit"),
        ("a5|", "'|'"),
    ):
        with pytest.raises(ValueError, match=reason.replace("|", r"\|")):
            parse_hex(text)


def test_the_line_of_a_file_that_is_no_hexadecimal_text_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.hex").write_text("54 2c\n54 2g\n", encoding="ascii")
    with (
        ls.open(tmp_path / "a.hex", "ldrobot-stl27l") as device,
        pytest.raises(WireError, match=("line 2: not hexadecimal: 'g' is not a hexadecimal digit")),
    ):
        list(device.packets())


EVERY = bytes(range(256)) + b" ab |ef  12 34  #//abc/*"


@pytest.mark.parametrize(
    "command",
    [
        "xxd",
        "xxd -g1",
        "xxd -u -g4 -c32",
        "xxd -p",
        "xxd -i",
        "hexdump -C",
        "od -An -tx1",
        "od -tx1",
    ],
)
def test_dumps_are_read_as_their_tools_print_them(command: str, tmp_path: Path) -> None:
    (tmp_path / "it.bin").write_bytes(EVERY)
    program, *options = command.split()
    if shutil.which(program) is None:
        pytest.skip(f"there is no {program} here")
    done = subprocess.run(
        [program, *options, "it.bin"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert parse_hex(done.stdout) == EVERY
    # A dump begins again where its offset does.
    assert parse_hex(done.stdout * 2) == EVERY * 2 or command == "xxd -p"


def test_frames_are_read_as_analysers_and_terminals_print_them() -> None:
    wireshark = (
        "0000   54 2c 10 0e 54 2c 41 20 2e 2e 2e 2e 61 62 20 63   T,..T,A ....ab c\n"
        "0010   64 2c                                             d,\n"
    )
    older = (
        "0000  54 2c 10 0e 54 2c 41 20  2e 2e 2e 2e 61 62 20 63   T,..T,A ....ab c\n"
        "0010  64 2c   d,"
    )
    tcpdump = (
        "\t0x0000:  542c 100e 542c 4120 2e2e 2e2e 6162 2063  T,..T,A.....ab.c\n"
        "\t0x0010:  642c                                     d,\n"
    )
    for text in (wireshark, older, tcpdump):
        assert parse_hex(text) == b"T,\x10\x0eT,A ....ab cd,", text


CAN = b"\x11\x22\x33\x44\x55\x66\x77\x88"
TIMED = {
    "(1436509052.249713) vcan0 044#1122334455667788": (CAN, 1436509052_249713000),
    "(1436509052.249713) can1 12345678##11122334455667788 R": (CAN, 1436509052_249713000),
    "  can0  123   [8]  11 22 33 44 55 66 77 88   '.\"3DUfw.'": (CAN, None),
    " (001.000250)  can0  123   [8]  11 22 33 44 55 66 77 88": (CAN, 1_000250000),
    "  can0  123   [0]  remote request": (b"", None),
    "1250-1430 UART: RX data: 54": (b"\x54", None),
    "uart-1: 54": (b"\x54", None),
    "[12:00:01.123] 54 2C": (b"\x54\x2c", 43201_123000000),
    "12:00:01,5 -> 542C": (b"\x54\x2c", 43201_500000000),
    "[12:00:01] 54 2C  # sync": (b"\x54\x2c", 43201_000000000),
    "2023-11-14T22:13:20.000000001Z: 0x54, 0x2C": (b"\x54\x2c", 1_700_000_000_000_000_001),
    "[1700000000.25] 54:2c": (b"\x54\x2c", 1_700_000_000_250_000_000),
    "[12:00:01] 0010: 54 2c  T,": (b"\x54\x2c", 43201_000000000),
    "[9999999999.5] 54 2c": (b"\x54\x2c", None),
    "12.5 54:2c": (b"\x54\x2c", 12_500_000_000),
}


@pytest.mark.parametrize("text", TIMED)
def test_times_before_the_bytes_are_when_they_came(text: str) -> None:
    chunk = HexText().read_line(text)
    assert (chunk.data, chunk.at) == TIMED[text]


SALEAE = "Time [s],Value,Parity Error,Framing Error\n0.000012500000000,0x54,,\n1.5,0x2C,Error,\n"
LOGIC = (
    "name,type,start_time,duration,data\n"
    '"Async Serial","data",0.0000125,8.6e-05,0x54\n'
    '"Async Serial","data",1.5,8.6e-05,0x2C\n'
)


@pytest.mark.parametrize("table", [SALEAE, LOGIC])
def test_tables_of_logic_analysers_are_read_with_their_times(table: str, tmp_path: Path) -> None:
    for name in ("it.csv", "it.hex", "it.hex.gz"):
        (tmp_path / name).write_bytes(
            gzip.compress(table.encode()) if name.endswith("gz") else table.encode()
        )
        with contextlib.closing(open_transport(tmp_path / name)) as opened:
            assert [(chunk.data, chunk.at) for chunk in opened.chunks() if chunk.data] == [
                (b"\x54", 12500),
                (b"\x2c", 1_500_000_000),
            ]
    (tmp_path / "raw.log").write_bytes(b"\x54\x2c\xff")
    with contextlib.closing(open_transport(tmp_path / "raw.log")) as opened:
        assert [chunk.data for chunk in opened.chunks()] == [b"\x54\x2c\xff"]


@pytest.mark.parametrize(
    "text",
    [
        (
            "static const uint8_t frame[3] = { 0x8b, /* sync\n of it */ 0x13,\n 0x5A };\n"
            "unsigned int frame_len = 3;\n"
        ),
        "unsigned char it[] =\n{\n  0x8B, 0x13, 0x5a\n};",
        "frame = [0x8b, 0x13,\n0x5a]",
        "[0x8b, 0x13, 0x5a]",
        r"b'\x8b\x13\x5a'",
        '"\\x8b\\x13"\n"\\x5a"',
        "/* one */ 8b /* two */ 13 // three\n5a",
    ],
)
def test_arrays_and_strings_of_programs_are_read(text: str) -> None:
    assert parse_hex(text) == b"\x8b\x13\x5a"


REFUSED = {
    "12:00:01 54 2c": "12:00:01 may be a time of day or three bytes",
    "uint8_t frame[] = {84, 44};": "expected bytes such as 0x54 in an array, got '84'",
    "uint16_t frame[] = {0x542c};": "expected bytes such as 0x54 in an array, got '0x542c'",
    ":10010000214601360121470136007EFE09D2190140": "the text is Intel HEX",
    "0000000 2c54 0e10 0868": "words in host byte order",
    "000000 54 2c 10 0e 54 2c 41 20": "the first zeros may be an offset or data",
    "00000000: 0e102c54 20412c54  T,..T,A ": (
        "'T,..T,A': the text at the end of the line does not match the bytes"
    ),
    "00000000  54 2c 10 0e  |T,..|\n*\n00000020": "stands for repeated lines",
    "00000000  54 2c 10 0e  |T,..|\n00000020  54": "offset 00000020 follows 0x4 bytes",
    "00000000  54 2c 10 0e  |T,..|\n54 2c": "the lines before it have offsets",
    "can0 123 [2] 11 22\ncan0 124 [2] 11 22": "CAN frames come from can0 123 and can0 124",
    "can0 123 [3] 11 22": "a CAN frame declares 3 bytes, but has 2",
    "Time [s],Value\n0.1,84": "expected a hexadecimal byte such as 0x54 in a table, got '84'",
    "; CSV generated by libsigrok 0.5.2": "the levels of signal lines",
    "54 2c /* and": "a comment begins with /* but does not end",
    r"b'T,\x10'": "is not a hexadecimal digit",
}


@pytest.mark.parametrize("text", REFUSED)
def test_ambiguous_hex_text_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(REFUSED[text])):
        parse_hex(text)


def test_the_command_line_takes_text_in_every_place(tmp_path: Path) -> None:
    frame = ls.sensor("ldrobot-stl27l").example("data")
    dump = "\n".join(
        f"{start:08x}  {frame[start : start + 16].hex(' ')}" for start in range(0, len(frame), 16)
    )
    log = "".join(
        f"(1700000000.{number:06d}) can0 003#{frame[number : number + 8].hex()}\n"
        for number in range(0, len(frame), 8)
    )
    (tmp_path / "it.log").write_text(log * 3, encoding="ascii")
    plain = ran("parse", frame.hex(), "-s", "ldrobot-stl27l").stdout
    assert ran("parse", "-", "-s", "ldrobot-stl27l", given=dump.encode()).stdout == plain
    assert ran("parse", "-", "-s", "ldrobot-stl27l", given=log.encode()).stdout == plain
    assert (
        ran("parse", *(f"0x{byte:02X}," for byte in frame), "-s", "ldrobot-stl27l").stdout == plain
    )
    assert "ldrobot-" in ran("detect", tmp_path / "it.log").output
    said = ran(
        "parse",
        "-",
        "-s",
        "ldrobot-stl27l",
        given=(log + log.replace("003#", "004#")).encode(),
        code=4,
    ).stderr
    assert (
        "standard input, line 7: not hexadecimal: the CAN frames come from can0 003 and can0 004:"
        " select one interface with grep"
    ) in said
