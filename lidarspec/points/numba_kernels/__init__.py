"""Compute points and checksums by compiled code: a back end that needs Numba.

`compile` returns an object that computes columns of a `points.plan.Plan`. `compile_sums` returns
the function that computes the checksums for a decoder. Modules in reading order:

* `arithmetic`: the functions that kernels call. Importing this module imports Numba.
* `writer`: writes the source of fields, tables and indices.
* `source`: writes the source of expressions and of a whole kernel.
* `cache`: stores compiled code on disk.
* `kernels`: compiles kernels, and calls them in one or more threads.
* `checksums`: kernels for checksums that are an XOR of one value for each byte.
"""

from __future__ import annotations

from lidarspec.points.numba_kernels.checksums import compile_sums
from lidarspec.points.numba_kernels.kernels import get_kernel as compile, is_available

__all__ = ["compile", "compile_sums", "is_available"]
