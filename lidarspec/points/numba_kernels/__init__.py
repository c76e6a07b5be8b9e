"""Compute points and checksums by compiled code: an optional back end, which needs Numba.

In: a `points.plan.Plan`. Out: an object that fills its columns, returned by `compile`; and
the function that computes the checksums of a decoder, returned by `compile_sums`. Only
``backend="jit"`` requires this package. Numba is imported with the first kernel that runs. Modules
in reading order:

* `arithmetic`: the functions that kernels call; the only module that imports Numba on import.
* `writer`: the source text of fields, tables and indices.
* `source`: the source text of expressions and of a whole kernel.
* `cache`: compiled code on disk.
* `kernels`: compiles kernels, and calls them in one or more threads.
* `checksums`: kernels for checksums that are an XOR of the contributions of bytes.
"""

from __future__ import annotations

from lidarspec.points.numba_kernels.checksums import compile_sums
from lidarspec.points.numba_kernels.kernels import get_kernel as compile, is_available

__all__ = ["compile", "compile_sums", "is_available"]
