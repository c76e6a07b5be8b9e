"""Damage to a stream, by seed: bytes dropped, flipped and put in, one by one or in bursts."""

from __future__ import annotations

import random

RATES = (0.0, 1e-5, 1e-4, 1e-3, 5e-3)
BURSTS = (8, 16, 64)


def damaged(data: bytes, rate: float, seed: int, *, burst: int = 1) -> bytes:
    """The stream with about this share of its bytes damaged, in runs of `burst`; at least one run, unless the rate is 0."""
    if not rate:
        return data
    source = random.Random(f"{seed} {rate} {burst}")
    number = max(1, round(len(data) * rate / burst))
    found = bytearray(data)
    for _ in range(number):
        spot = source.randrange(len(found) + 1)
        kind = source.choice(("drop", "flip", "insert"))
        noise = source.randbytes(burst)
        if kind == "drop":
            del found[spot : spot + burst]
        elif kind == "insert":
            found[spot:spot] = noise
        else:
            found[spot : spot + burst] = bytes(a ^ (1 << b % 8) for a, b in zip(found[spot : spot + burst], noise, strict=False))
    return bytes(found)
