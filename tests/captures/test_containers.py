"""Tests of captures and recordings in compressed files, also truncated and damaged."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import importlib
import lzma
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.captures.pcap import CaptureReader
from lidarspec.simulation.simulator import simulate
from lidarspec.transports.files import CaptureTransport
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.protocol import Chunk
from tests import made_captures as made
from tests.captures.test_memory import CHILD, SENSOR, write_repeated_capture
from tests.cli.running import process, ran

ZSTD = "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd"


def zstd(data: bytes) -> bytes:
    """Compress data as the command line of zstd does, with a checksum."""
    library = importlib.import_module(ZSTD)
    packed: bytes = library.compress(data, options={library.CompressionParameter.checksum_flag: 1})
    return packed


def zip_bytes(data: bytes, *names: str) -> bytes:
    path = Path("made.zip")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names or ("drives/", "drives/a"):
            archive.writestr(
                name, b"" if name.endswith("/") else b"no capture" if name.endswith(".md") else data
            )
    return path.read_bytes()


PACKED: dict[str, Callable[[bytes], bytes]] = {
    "gzip": gzip.compress,
    "bzip2": bz2.compress,
    "xz": lzma.compress,
    "zstd": zstd,
    "zip": zip_bytes,
    "two gzip members": lambda data: gzip.compress(data[:5000]) + gzip.compress(data[5000:]),
    "gzip in zip": lambda data: zip_bytes(gzip.compress(data)),
}


#: one in the quick tier: what follows the decompression is the same for all.
COMPRESSIONS = [
    "gzip",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("bzip2", "xz", "zstd")),
]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def capture(number: int = 40, form: str = "pcap") -> bytes:
    frames = [made.frame(data) for data in simulate(ls.sensor(SENSOR), number)]
    if form == "pcap":
        return made.pcap(*frames)
    return made.section() + made.interface() + b"".join(map(made.packet, frames))


def read(source: Path | str) -> list[Chunk]:
    with contextlib.closing(open_transport(source)) as opened:
        return list(opened.chunks())


@pytest.mark.parametrize("packing", PACKED)
def test_compressed_files_are_read_unchanged(packing: str) -> None:
    if packing == "zstd":
        pytest.importorskip(ZSTD)
    Path("plain.pcap").write_bytes(capture())
    Path("plain.pcapng").write_bytes(capture(form="pcapng"))
    ran("record", "plain.pcap", "-o", "plain.lsr", "-s", SENSOR)
    Path("plain.bin").write_bytes(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 500)))
    for plain in map(Path, ("plain.pcap", "plain.pcapng", "plain.lsr", "plain.bin")):
        Path("it.x").write_bytes(PACKED[packing](plain.read_bytes()))
        chunks = read("it.x")
        if plain.suffix == ".bin":
            assert b"".join(chunk.data for chunk in chunks) == plain.read_bytes()
        else:
            assert chunks == read(plain)
        with contextlib.closing(open_transport("it.x")) as opened:
            if isinstance(opened, CaptureTransport):
                assert [
                    batch.data(number) for batch in opened.batches() for number in range(len(batch))
                ] == [item.data for item in chunks]
    Path("it.x").write_bytes(PACKED[packing](capture()))
    assert [datagram.data for datagram in CaptureReader("it.x")] == simulate(ls.sensor(SENSOR), 40)


@pytest.mark.slow
def test_verbs_take_compressed_files_and_pipes() -> None:
    Path("a.pcap").write_bytes(capture())
    Path("a.pcap.gz").write_bytes(gzip.compress(capture()))
    for name in ("a.pcap", "a.pcap.gz"):
        ran("convert", name, f"{name}.csv", "-s", SENSOR)
    assert Path("a.pcap.csv").read_bytes() == Path("a.pcap.gz.csv").read_bytes()
    assert SENSOR in ran("detect", "a.pcap.gz").output
    piped = process(
        "read", "-", "--packets", "--json", "-s", SENSOR, given=gzip.compress(capture())
    )
    assert (
        piped.stdout.decode() == ran("read", "a.pcap", "--packets", "--json", "-s", SENSOR).stdout
    )
    refused = process("read", "-", "--packets", "-s", SENSOR, given=zip_bytes(capture()))
    assert (refused.returncode, b"which cannot be read from a pipe" in refused.stderr) == (3, True)


@pytest.mark.slow
def test_one_of_several_captures_in_an_archive_is_named() -> None:
    Path("one.zip").write_bytes(
        zip_bytes(capture(), "read.md", "__MACOSX/drives/a.pcap", "drives/a.pcap", "notes.md")
    )
    assert len(read("one.zip")) == 40
    Path("two.zip").write_bytes(zip_bytes(capture(), "read.md", "drives/a b.pcap", "drives/b.pcap"))
    said = ran("convert", "two.zip", "out.csv", "-s", SENSOR, code=2).stderr
    assert "two.zip contains 2 captures: drives/a b.pcap, drives/b.pcap" in said
    assert "next: repeat with 'two.zip?file=drives/a b.pcap'" in said
    assert len(read("two.zip?file=drives/a b.pcap")) == 40
    ran("convert", "two.zip?file=drives/b.pcap", "out.csv", "-s", SENSOR)
    assert SENSOR in ran("detect", "two.zip?file=drives/b.pcap").output
    assert (
        "unknown name 'drives/c.pcap'; did you mean 'drives/b.pcap'"
        in ran("read", "two.zip?file=drives/c.pcap", code=2).stderr
    )
    Path("none.zip").write_bytes(zip_bytes(capture(), "read.md", "notes.md"))
    said = ran("read", "none.zip", "-s", SENSOR, code=3).stderr
    assert "the zip archive none.zip contains no capture, only read.md, notes.md" in said
    Path("cut.zip").write_bytes(zip_bytes(capture())[:3000])
    said = ran("read", "cut.zip", "-s", SENSOR, code=3).stderr
    assert (
        "cannot read the zip archive cut.zip: File is not a zip file\n  next: zip -FF"
        " cut.zip --out repaired.zip" in said
    )
    locked = bytearray(zip_bytes(capture()))
    for place in (locked.rindex(b"PK\x03\x04") + 6, locked.rindex(b"PK\x01\x02") + 8):
        locked[place] |= 1  # the flag of a file with a password
    Path("locked.zip").write_bytes(locked)
    said = ran("read", "locked.zip", "-s", SENSOR, code=3).stderr
    assert "is encrypted, password required" in said
    assert "next: unzip locked.zip" in said
    Path("it.pcap").write_bytes(capture())
    assert (
        "it.pcap is not a zip archive, so it does not contain a.pcap"
        in ran("read", "it.pcap?file=a.pcap", "-s", SENSOR, code=2).stderr
    )


@pytest.mark.parametrize("packing", COMPRESSIONS)
def test_a_truncated_compressed_file_is_read_to_its_end(packing: str) -> None:
    if packing == "zstd":
        pytest.importorskip(ZSTD)
    sent = [np.random.default_rng(number).bytes(1200) for number in range(2000)]
    whole = PACKED[packing](made.pcap(*map(made.frame, sent)))
    Path("it.pcap.x").write_bytes(whole[: len(whole) * 3 // 4])
    with contextlib.closing(open_transport("it.pcap.x")) as opened:
        packets = [chunk.data for chunk in opened.chunks()]
        assert packets == sent[: len(packets)]
        assert 900 < len(packets) < 1501  # of bzip2, its last block is lost
        assert len(opened.warnings) == 1
        assert opened.warnings[0].startswith("it.pcap.x is truncated: only the ")
        assert opened.unread == 0


@pytest.mark.parametrize("packing", COMPRESSIONS)
def test_data_before_damage_is_read_with_one_warning(packing: str) -> None:
    if packing == "zstd":
        pytest.importorskip(ZSTD)
    sent = [np.random.default_rng(number).bytes(1200) for number in range(2000)]
    whole = bytearray(PACKED[packing](made.pcap(*map(made.frame, sent))))
    middle = len(whole) * 3 // 4
    whole[middle : middle + 4000] = b"\xff" * 4000
    Path("it.pcap.x").write_bytes(whole)
    with contextlib.closing(open_transport("it.pcap.x")) as opened:
        packets = [chunk.data for chunk in opened.chunks()]
        assert packets[:900] == sent[:900]
        assert (
            sum(said.startswith("it.pcap.x is corrupt before byte") for said in opened.warnings)
            == 1
        )
        assert opened.unread > 0
    recorded = ran("record", "it.pcap.x", "-o", "it.lsr", code=1)
    assert "it.pcap.x is corrupt before byte" in recorded.stderr


OTHERS = {
    "a Python pickle": [pickle.dumps({"points": [1.0]}, protocol) for protocol in range(2, 6)],
    "a NumPy array": [b"\x93NUMPY\x01\0"],
    "JSON": [b'{\n  "sensor": 1}', b'[{"a": 1}]'],
    "an executable file": [b"\x7fELF\x02\x01"],
    "an image or a video": [b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0"],
    "an HDF5 file": [b"\x89HDF\r\n\x1a\n"],
    "a point cloud file": [b"LASF", b"# .PCD v0.7\n", b"ply\n", b"ASTM-E57"],
    "an XML or HTML page": [b"<!DOCTYPE html>", b"<?xml version='1.0'?>"],
    "a Git LFS pointer instead of the file": [b"version https://git-lfs.github.com/spec/v1\n"],
    "compressed more than once by gzip": [gzip.compress(gzip.compress(gzip.compress(b"packets")))],
}


@pytest.mark.parametrize("what", OTHERS)
def test_files_of_other_kinds_are_named_whatever_they_are_called_and_packed_in(what: str) -> None:
    for data in OTHERS[what]:
        for name, held in (("it.bin", data), ("it.hex", data), ("it.bin.gz", gzip.compress(data))):
            if "more than once" not in what or name == "it.bin":
                Path(name).write_bytes(held)
                assert (
                    f"{name} is {what}: expected a capture"
                    in ran("convert", name, "out.csv", "-s", SENSOR, code=3).stderr
                )


def test_a_missing_library_is_reported_with_its_installation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    Path("it.zst").write_bytes(b"\x28\xb5\x2f\xfd")
    monkeypatch.setitem(sys.modules, ZSTD, None)
    assert (
        "next: pip install 'lidarspec[zstd]'" in ran("read", "it.zst", "-s", SENSOR, code=2).stderr
    )


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_compressed_capture_is_decoded_in_bounded_memory(tmp_path: Path) -> None:
    write_repeated_capture(tmp_path / "long.pcap", 60)
    subprocess.run(["gzip", "-1", "long.pcap"], check=True)
    done = subprocess.run(
        [sys.executable, "-c", CHILD, "long.pcap.gz", SENSOR],
        capture_output=True,
        text=True,
        check=True,
        timeout=500,
    )
    count, first, most = map(int, done.stdout.split())
    assert count > 5_000_000
    assert most - first < 40_000, f"from {first} to {most} KiB"
