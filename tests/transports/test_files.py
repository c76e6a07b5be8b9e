"""Hexadecimal text, in the ways that people print it; what could mean something else is refused by name."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.errors import WireError
from lidarspec.transports.files import BLOCK, unhexed
from lidarspec.transports.open_url import transport


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
    assert unhexed(text) == b"\x8b\x13\x5a"
    (tmp_path / "a.hex").write_text(text, encoding="ascii")
    with contextlib.closing(transport(tmp_path / "a.hex")) as opened:
        assert b"".join(chunk.data for chunk in opened.chunks()) == b"\x8b\x13\x5a"


@pytest.mark.parametrize("form", ["8b135a", "8B 13 5a ", "0x8B,0x13,0x5A,", "8b:13:5a:", r"\x8b\x13\x5a", "  8b 135a\t"])
def test_a_line_without_end_is_read_in_pieces(form: str, tmp_path: Path) -> None:
    line = form * (3 * BLOCK // len(form))
    (tmp_path / "a.hex").write_text(f"0000: {line}# {line}\n{line}\n{line[: BLOCK // len(form) * len(form)]}", encoding="ascii")
    with contextlib.closing(transport(tmp_path / "a.hex")) as opened:
        found = [chunk.data for chunk in opened.chunks()]
    assert b"".join(found) == unhexed(line) * 2 + unhexed(form) * (BLOCK // len(form))
    assert max(map(len, found)) <= BLOCK


def test_a_single_digit_is_a_byte_where_it_says_so_alone() -> None:
    assert unhexed("0xa, 0x5") == b"\x0a\x05"
    assert unhexed("") == b""
    for text, reason in (("a 5", "'a' makes no whole bytes"), ("0x", "makes no whole bytes"), ("a5 z1", "'z' is no digit"), ("a5|", "'|'")):
        with pytest.raises(ValueError, match=reason.replace("|", r"\|")):
            unhexed(text)


def test_the_line_of_a_file_that_is_no_hexadecimal_text_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.hex").write_text("54 2c\n54 2g\n", encoding="ascii")
    with (
        ls.open(tmp_path / "a.hex", "ldrobot-stl27l") as device,
        pytest.raises(WireError, match="line 2: not hexadecimal: 'g' is no digit"),
    ):
        list(device.packets())
