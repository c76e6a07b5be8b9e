"""Recognize the layout of packets from their content.

Packets do not declare their layout. Several layouts have the same packet length, for example 32
pixels of 16 bytes, 64 pixels of 8 bytes and 128 pixels of 4 bytes. If the tried layout has too many
pixels, some of the ranges are read from another field, so the mean ranges of adjacent rows differ.
Some layouts cannot be distinguished.

In LEGACY, the number of columns per revolution is determined from the encoder. In other profiles,
it is estimated from the largest column number and the time between columns. The estimate assumes
ten revolutions a second, which is the factory setting.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec_ouster.packets import COLUMNS, ENCODER_COUNTS_PER_TURN, PROFILES, VALID, packet_bytes

ROW_COUNTS = (16, 32, 64, 128)
COLUMNS_PER_TURN = (512, 1024, 2048, 4096)
MAX_EXAMINED_PACKETS = 256
FACTORY_TURN_NS = 100_000_000  # ten revolutions a second
#: The maximum share of pixels in which unused bits may be set. In a capture of an OS2, the share is
#: lower.
MAX_UNUSED_SHARE = 0.1
Bytes2D = NDArray[np.uint8]


def recognise(datagrams: Sequence[bytes]) -> dict[str, Any]:
    """Return the layout of most of the datagrams, as options of `configure`.

    Returns:
        "profile", "rows" and "turn" -> the most likely values; empty if no layout fits.
    """
    lengths = [len(data) for data in datagrams]
    layouts = {
        (profile, rows): packet_bytes(profile, rows) for profile in PROFILES for rows in ROW_COUNTS
    }
    known_lengths = [length for length in lengths if length in layouts.values()]
    if not known_lengths:
        return {}
    most_frequent = max(set(known_lengths), key=known_lengths.count)
    sample = [data for data in datagrams if len(data) == most_frequent][:MAX_EXAMINED_PACKETS]
    packets = np.frombuffer(b"".join(sample), np.uint8).reshape(len(sample), most_frequent)
    finest_first = sorted(
        (layout for layout, length in layouts.items() if length == most_frequent),
        key=lambda layout: -layout[1],
    )
    columns = {
        layout: body
        for layout in finest_first
        if (body := split_columns(packets, layout[0])) is not None
    }
    similarities = {layout: row_similarity(body, *layout) for layout, body in columns.items()}
    if not similarities:
        return {}
    candidates = next(
        layouts_above
        for min_similarity in (0.5, 0, -1)
        if (
            layouts_above := [
                layout for layout in similarities if similarities[layout] >= min_similarity
            ]
        )
    )
    profile, rows = candidates[0]
    return {
        "profile": profile,
        "rows": rows,
        "turn": estimate_turn(columns[candidates[0]], profile),
    }


def estimate_turn(columns: Bytes2D, profile: str) -> int:
    """Return the most likely number of columns per revolution."""
    numbers = read_numbers(columns, 8, 2)
    times = read_numbers(columns, 0, 8)
    if profile == "LEGACY" and numbers.any():
        guess = float(
            np.median(
                ENCODER_COUNTS_PER_TURN
                * numbers[numbers > 0]
                / np.maximum(read_numbers(columns, 12, 4)[numbers > 0], 1)
            )
        )
    else:
        guess = FACTORY_TURN_NS / max(float(np.median(np.diff(times))), 1.0)
    return min(
        (turn for turn in COLUMNS_PER_TURN if turn > numbers.max()),
        key=lambda turn: abs(np.log(turn / guess)),
    )


def split_columns(packets: Bytes2D, profile: str) -> Bytes2D | None:
    """Return the columns of packets, (n * 16, bytes); None if a header is invalid."""
    has_header = profile != "LEGACY"
    if has_header and not (packets[:, 0] == 1).all():
        return None
    # byte 1 is the high byte of the type, 0; with FUSA it is the low byte of `init_id`
    is_byte_1_zero = bool((packets[:, 1] == 0).all())
    if has_header and is_byte_1_zero == profile.startswith("FUSA"):
        return None
    body = packets[:, 32:-32] if has_header else packets
    columns = body.reshape(len(packets) * COLUMNS, -1)
    numbers = read_numbers(columns, 8, 2).reshape(-1, COLUMNS)
    is_plausible = (np.diff(numbers, axis=1) == 1).all() and numbers.max() < COLUMNS_PER_TURN[-1]
    if not has_header:
        status = read_numbers(columns, columns.shape[1] - 4, 4)
        is_plausible = is_plausible and bool(
            ((status == VALID) | (status == 0)).all()
            and (read_numbers(columns, 12, 4) < ENCODER_COUNTS_PER_TURN).all()
        )
    return columns if is_plausible else None


def row_similarity(columns: Bytes2D, profile: str, rows: int) -> float:
    """Return how similar the mean ranges of adjacent rows are if columns have this layout.

    Returns:
        -1 if unused bits are set in many pixels, which means that the layout is probably wrong.
        Otherwise a number from 0 to 1. The rows are divided into four groups of every fourth row,
        so that adjacent rows are in different groups. The number is the smallest mean range of a
        group, divided by the largest.
    """
    start = 16 if profile == "LEGACY" else 12
    bits = PROFILES[profile]
    step = sum(bits.values()) // 8
    bit_offset = 0
    pixels = columns[:, start : start + rows * step].reshape(len(columns), rows, step)
    for name, width in bits.items():
        if name[0] == "_" and (read_bits(pixels, bit_offset, width) != 0).mean() > MAX_UNUSED_SHARE:
            return -1.0
        bit_offset += width
    means = read_bits(pixels, 0, bits["range"]).reshape(len(columns), -1, 4).mean(axis=(0, 1))
    return float(means.min() / max(means.max(), 1e-9))


def read_bits(rows: NDArray[Any], bit_offset: int, width: int) -> NDArray[np.int64]:
    """Return `width` bits of each little-endian number in the last axis.

    `bit_offset` is the number of the lowest of these bits.
    """
    return read_numbers(
        rows, bit_offset // 8, -(-(bit_offset % 8 + width) // 8)
    ) >> bit_offset % 8 & ((1 << width) - 1)


def read_numbers(rows: NDArray[Any], start: int, count: int) -> NDArray[np.int64]:
    """Return the little-endian numbers in `count` bytes of the last axis.

    `start` is the index of the first byte.
    """
    numbers: NDArray[np.int64] = (
        rows[..., start : start + count].astype(np.int64) << (8 * np.arange(count))
    ).sum(axis=-1)
    return numbers
