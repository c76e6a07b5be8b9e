"""Polynomials over GF(2) as integers, bit k the coefficient of x**k: what a search for the polynomial of a CRC needs.

A CRC is the remainder of a message by its polynomial. So the polynomial divides the message with its checksum behind it, and
of two frames of one length it divides the XOR of both, whatever register the CRC begins with and whatever is XORed onto it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

#: how much larger than sought a common divisor may be, where its divisors are tried one by one.
SPARE = 11


def remainder(a: int, b: int) -> int:
    """a modulo b; b is not 0."""
    size = b.bit_length()
    while (shift := a.bit_length() - size) >= 0:
        a ^= b << shift
    return a


def quotient(a: int, b: int) -> int:
    """a divided by b, without the remainder; b is not 0."""
    size, found = b.bit_length(), 0
    while (shift := a.bit_length() - size) >= 0:
        a ^= b << shift
        found |= 1 << shift
    return found


def common_divisor(polynomials: Iterable[int], *, floor: int = 0) -> int:
    """The largest polynomial that divides all of them; 0 for none but zeros, and early where its degree falls below `floor`."""
    found = 0
    for polynomial in polynomials:
        other = polynomial
        while other:
            found, other = other, remainder(found, other) if found else 0
        if found and found.bit_length() <= floor:
            break
    return found


def divisors(polynomial: int, degree: int) -> list[int]:
    """The divisors of this degree whose constant term is 1, as those of CRCs have; [] where there are too many to try."""
    if polynomial == 0:
        return []
    polynomial >>= (polynomial & -polynomial).bit_length() - 1
    spare = polynomial.bit_length() - 1 - degree
    if spare < 0:
        return []
    if spare <= SPARE:
        found = (quotient(polynomial, small) for small in range((1 << spare) | 1, 2 << spare, 2) if remainder(polynomial, small) == 0)
        return sorted(found) if spare else [polynomial]
    return _tried(polynomial, degree) if degree <= 16 else []


def _tried(polynomial: int, degree: int) -> list[int]:
    """The divisors of a small degree: every polynomial of it at once."""
    candidates = np.arange((1 << degree) | 1, 2 << degree, 2, dtype=np.uint32)
    rest, top = np.zeros(len(candidates), np.uint32), np.uint32(degree)
    for bit in range(polynomial.bit_length() - 1, -1, -1):
        rest = rest << np.uint32(1) | np.uint32(polynomial >> bit & 1)
        rest ^= candidates * (rest >> top)
    return [int(one) for one in candidates[rest == 0]]


def solve(equations: Sequence[tuple[int, int]], width: int) -> tuple[int, list[int]] | None:
    """A solution of linear equations over GF(2), and what can be added to it; None where there is none.

    Args:
        equations: (mask, bit) each: the XOR of the unknown's bits under the mask is the bit.
        width: bits of the unknown.
    """
    rows: dict[int, int] = {}
    for mask, bit in equations:
        row = mask | bit << width
        for lead, other in rows.items():
            if row >> lead & 1:
                row ^= other
        lead = (row & ((1 << width) - 1)).bit_length() - 1
        if lead < 0:
            if row:
                return None
            continue
        rows = {place: other ^ row if other >> lead & 1 else other for place, other in rows.items()}
        rows[lead] = row
    solution = sum(1 << lead for lead, row in rows.items() if row >> width & 1)
    free = [bit for bit in range(width) if bit not in rows]
    return solution, [1 << bit | sum(1 << lead for lead, row in rows.items() if row >> bit & 1) for bit in free]
