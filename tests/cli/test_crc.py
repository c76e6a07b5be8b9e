"""Tests of `crc` with sample frames in every text form."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.simulation.simulator import simulate
from tests.cli.running import EXAMPLE, ran, run_json

FRAMES = simulate(ls.sensor("ldrobot-stl27l"), 20)
PASTE = "Crc(width=8, poly=0x4D)"


@pytest.mark.slow
def test_words() -> None:
    told = run_json("crc", *(frame.hex() for frame in FRAMES))
    best = told["matches"][0]
    assert (told["frames"], best["paste"], best["field"]["offset"], best["right"]) == (
        20,
        PASTE,
        -1,
        20,
    )
    assert best["over"] == {"part": "all", "head": 0, "tail": 0}
    assert best["evidence_bits"] > 80


def test_one_frame_with_spaces_is_one_frame() -> None:
    assert (
        "no checksum found in 1 frame:"
        in ran("crc", *(f"{byte:02x}" for byte in EXAMPLE), code=1).stderr
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("frames.hex",),
        ("raw.bin",),
        ("raw.bin", "--period", "47"),
        ("cut.bin", "--period", "47", "--offset", "5"),
    ],
)
def test_files(tmp_path: Path, words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("frames.hex").write_text(
        "".join(f"# a frame\n{frame.hex(' ')}\n" for frame in FRAMES), encoding="ascii"
    )
    Path("raw.bin").write_bytes(b"".join(FRAMES))
    Path("cut.bin").write_bytes(FRAMES[0][-5:] + b"".join(FRAMES[1:]))
    text = ran("crc", *words).stdout
    assert f"  paste:  {PASTE}" in text.splitlines()
    assert "  field:  the last byte" in text.splitlines()
    assert "  covers: all other bytes" in text.splitlines()
    assert text.count("paste:") == 1


def test_an_unnamed_checksum_is_printed_as_a_class() -> None:
    source = random.Random(1)
    bodies = [b"\x5a" + source.randbytes(9) for _ in range(12)]
    text = ran("crc", *((body + bytes([~sum(body) & 0xFF])).hex() for body in bodies)).stdout
    assert "8-bit sum, complemented" in text
    assert "    class Check(Checksum):" in text


@pytest.mark.slow
def test_few_frames_are_weak() -> None:
    assert (
        "the match may be a coincidence: repeat with more frames"
        in ran("crc", *(frame.hex() for frame in FRAMES[:2])).stderr
    )


@pytest.mark.slow
def test_input_without_frames_and_empty_input(tmp_path: Path) -> None:
    source = random.Random(2)
    assert (
        "no checksum found in 9 frames"
        in ran("crc", *(source.randbytes(14).hex() for _ in range(9)), code=1).stderr
    )
    ran("crc", code=2)
    ran("crc", "xyz", code=2)
    ran("crc", tmp_path / "none.bin", code=3)
    (tmp_path / "noise.bin").write_bytes(source.randbytes(5000))
    found = ran("crc", tmp_path / "noise.bin", code=2)
    assert "--period BYTES" in found.stderr


@pytest.mark.slow
def test_many_frames_prove_more_than_a_float_can_hold() -> None:
    frames = simulate(ls.sensor("ldrobot-stl27l"), 250)
    assert "1 in 1e+" in ran("crc", *(frame.hex() for frame in frames)).stdout
