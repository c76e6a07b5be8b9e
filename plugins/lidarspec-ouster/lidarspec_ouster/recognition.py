"""Which layout packets have, that do not say it: by their length, the bits that nobody uses, and
neighbours that are alike.

Several layouts have one length: 32 pixels of 16 bytes, 64 of 8 and 128 of 4. In one that is too
fine, every other or every fourth range is some other number, so that their means are far apart. Of
layouts that are as fine, the first of `PROFILES` is taken whose unused bits are 0 in most pixels:
some cannot be told apart by anything in them. How many columns a turn has is told by the encoder of
LEGACY; of others by the largest number seen, and by the time from column to column at ten turns a
second, as they leave the factory.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec_ouster.packets import COLUMNS, ENCODER, PROFILES, VALID, size

ROWS = (16, 32, 64, 128)
TURNS = (512, 1024, 2048, 4096)
#: packets that are looked into; nanoseconds of a turn as they leave the factory.
LOOKED_AT = 256
TEN_TURNS = 100_000_000
#: share of the pixels in which a captured OS2 sets bits that have no name stays below it.
SET = 0.1
Bytes2D = NDArray[np.uint8]


def recognise(datagrams: Sequence[bytes]) -> dict[str, Any]:
    """The options of `configure` under which most of the datagrams are lidar packets; {} where they
    are none.
    """
    lengths = [len(data) for data in datagrams]
    layouts = {(profile, rows): size(profile, rows) for profile in PROFILES for rows in ROWS}
    known = [length for length in lengths if length in layouts.values()]
    if not known:
        return {}
    usual = max(set(known), key=known.count)
    some = [data for data in datagrams if len(data) == usual][:LOOKED_AT]
    packets = np.frombuffer(b"".join(some), np.uint8).reshape(len(some), usual)
    finest_first = sorted(
        (layout for layout, length in layouts.items() if length == usual),
        key=lambda layout: -layout[1],
    )
    columns = {
        layout: body
        for layout in finest_first
        if (body := _columns(packets, layout[0])) is not None
    }
    fitting = {layout: _likeness(body, *layout) for layout, body in columns.items()}
    if not fitting:
        return {}
    likely = next(
        found
        for least in (0.5, 0, -1)
        if (found := [layout for layout in fitting if fitting[layout] >= least])
    )
    profile, rows = likely[0]
    return {"profile": profile, "rows": rows, "turn": _turn(columns[likely[0]], profile)}


def _turn(columns: Bytes2D, profile: str) -> int:
    """Columns of a turn, as far as they tell it."""
    number = _word(columns, 8, 2)
    time = _word(columns, 0, 8)
    if profile == "LEGACY" and number.any():
        guess = float(
            np.median(
                ENCODER * number[number > 0] / np.maximum(_word(columns, 12, 4)[number > 0], 1)
            )
        )
    else:
        guess = TEN_TURNS / max(float(np.median(np.diff(time))), 1.0)
    return min(
        (turn for turn in TURNS if turn > number.max()), key=lambda turn: abs(np.log(turn / guess))
    )


def _columns(packets: Bytes2D, profile: str) -> Bytes2D | None:
    """The columns of packets, (n * 16, bytes), where their headers can be those of a profile."""
    framed = profile != "LEGACY"
    if framed and not (packets[:, 0] == 1).all():
        return None
    if framed and (packets[:, 1] == 0).all() == profile.startswith(
        "FUSA"
    ):  # of the type, or of the number of the start
        return None
    body = packets[:, 32:-32] if framed else packets
    columns = body.reshape(len(packets) * COLUMNS, -1)
    numbers = _word(columns, 8, 2).reshape(-1, COLUMNS)
    steady = (np.diff(numbers, axis=1) == 1).all() and numbers.max() < TURNS[-1]
    if not framed:
        status = _word(columns, columns.shape[1] - 4, 4)
        steady = steady and bool(
            ((status == VALID) | (status == 0)).all() and (_word(columns, 12, 4) < ENCODER).all()
        )
    return columns if steady else None


def _likeness(columns: Bytes2D, profile: str, rows: int) -> float:
    """The mean range of every fourth row, the least by the largest of the four; -1 where unused
    bits are set in many pixels.
    """
    start = 16 if profile == "LEGACY" else 12
    bits = PROFILES[profile]
    step = sum(bits.values()) // 8
    spot = 0
    pixels = columns[:, start : start + rows * step].reshape(len(columns), rows, step)
    for name, width in bits.items():
        if name[0] == "_" and (_bits(pixels, spot, width) != 0).mean() > SET:
            return -1.0
        spot += width
    means = _bits(pixels, 0, bits["range"]).reshape(len(columns), -1, 4).mean(axis=(0, 1))
    return float(means.min() / max(means.max(), 1e-9))


def _bits(rows: NDArray[Any], spot: int, width: int) -> NDArray[np.int64]:
    """Return the bits of the little-endian numbers in the last axis from `spot` on."""
    return _word(rows, spot // 8, -(-(spot % 8 + width) // 8)) >> spot % 8 & ((1 << width) - 1)


def _word(rows: NDArray[Any], start: int, count: int) -> NDArray[np.int64]:
    """Little-endian numbers out of the last axis."""
    found: NDArray[np.int64] = (
        rows[..., start : start + count].astype(np.int64) << (8 * np.arange(count))
    ).sum(axis=-1)
    return found
