"""The verb that finds out which checksum it is."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import click

from lidarspec.catalogue import CRCS
from lidarspec.checksums import Crc
from lidarspec.cli.failures import FINDINGS, suggest
from lidarspec.cli.inputs import read
from lidarspec.cli.output import emit, emit_json, note, output_options
from lidarspec.detection.hearing import hear
from lidarspec.detection.structure import cut, structure
from lidarspec.errors import UsageError
from lidarspec.searching.checksums import search
from lidarspec.searching.samples import Match

#: doubt below which a match may well be chance.
WEAK = 12
#: matches that are printed, and the texts that read as hexadecimal.
PRINTED = 4
HEX = (".hex", ".txt")


@click.command()
@click.argument("words", metavar="HEX...|FILE|-", nargs=-1, required=True)
@click.option("--period", type=click.IntRange(min=3), help="The length of the frames, for a file in which they follow each other.")
@click.option("--offset", type=click.IntRange(min=0), default=0, help="Where the first of them begins.")
@output_options
def crc(words: Sequence[str], period: int | None, offset: int, as_json: bool, output: str | None) -> None:
    """Which checksum seals some sample frames: XOR, sums, or a CRC of 8, 16 or 32 bits.

    Frames are words of hexadecimal digits, one each; a text file with a frame in each line (.hex, .txt); or a capture. Of raw
    bytes the frames are found out, or --period says how long they are. The more frames, the surer the answer: a dozen is plenty.
    """
    frames = _frames(words, period, offset)
    found = search(frames)
    if as_json:
        emit_json({"frames": len(frames), "matches": [told(match) for match in found]}, output)
    elif found:
        shown = [match for match in found if match.open == found[0].open][:PRINTED]
        emit("\n\n".join(_text(match, len(frames[0])) for match in shown), output)
    if not found:
        note(
            f"no checksum of {len(frames)} frame{'s' * (len(frames) != 1)} was found: are they whole, and do they begin where they should?"
        )
        raise click.exceptions.Exit(FINDINGS)
    if found[0].doubt < WEAK:
        note("this may be chance: give more frames")


def _frames(words: Sequence[str], period: int | None, offset: int) -> list[bytes]:
    """The sample frames."""
    if len(words) == 1 and (words[0] == "-" or os.path.exists(words[0])):
        return _of_file(words[0], period, offset)
    whole = read(words).data
    if period is not None:
        return cut(whole, period, offset)
    each = [read([word]).data for word in words]
    return each if min(map(len, each)) > 2 else [whole]


def _of_file(path: str, period: int | None, offset: int) -> list[bytes]:
    if path != "-" and not path.endswith(HEX):
        heard = max(hear(path), key=lambda one: one.size)
        chunks, datagrams = heard.chunks, heard.datagrams
    else:
        given = read([path])
        chunks, datagrams = tuple(chunk for chunk in given.chunks if chunk), len(given.chunks) > 1
    if period is not None:
        return cut(b"".join(chunks), period, offset)
    if datagrams and path.endswith(HEX):
        return list(chunks)
    found = structure(chunks, datagrams=datagrams, seal=False)
    if found is None:
        raise suggest(UsageError(f"{path}: where its frames begin cannot be seen"), f"lidarspec crc {path} --period BYTES --offset BYTES")
    length = f"{found.period} bytes" if found.period else f"{found.length} bytes"
    note(f"{len(found.frames)} frames that begin with {found.sync.hex(' ')}, {length} long")
    return list(found.frames)


def told(match: Match) -> dict[str, Any]:
    """A match for JSON."""
    return {
        "checksum": match.algorithm.describe(),
        "name": match.name,
        "paste": match.paste,
        "field": {"offset": match.place.offset, "size": match.place.size, "order": match.order},
        "over": {"part": match.span.part, "head": match.span.head, "tail": match.span.tail},
        "right": match.right,
        "frames": match.total,
        "evidence_bits": round(match.doubt, 1),
        "remarks": list(match.remarks),
    }


def _text(match: Match, length: int) -> str:
    order = f", {match.order}-endian" if match.place.size > 1 else ""
    name = f" ({match.name})" if match.name else ""
    chance = f"one wrong guess in {match.odds} would be" if match.doubt >= WEAK else "which may be chance"
    lines = [
        f"{match.algorithm.describe()}{name}: right in {match.right} of {match.total} frames; {chance}",
        f"  field: {match.place}{order}",
        f"  over:  {match.span.told(match.place, length)}",
        *(f"  note:  {remark}" for remark in match.remarks),
    ]
    known = isinstance(match.algorithm, Crc) and match.algorithm in CRCS.values()
    lines += (
        [f"  paste: {match.paste}"]
        if "\n" not in match.paste or known
        else ["  paste:", *("    " + line for line in match.paste.splitlines())]
    )
    return "\n".join(lines)
