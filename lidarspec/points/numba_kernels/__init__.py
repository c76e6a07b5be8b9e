"""Points and checksums by compiled code: an optional back end, which needs Numba.

In: a `points.plan.Plan`. Out: what fills its columns, by `compile`; and what computes the checksums
of a decoder, by `compiled_sums`. Nobody needs to know more of this package, and nothing breaks
without it but ``backend="jit"``. Numba is imported with the first kernel
that runs, not with this package. Modules in reading order:

* `arithmetic`: what kernels are written with; the only module that imports Numba as it is imported.
* `writer`: fields, tables and places as text, each in the loop in which it varies.
* `source`: expressions as text, and the whole of a kernel.
* `cache`: compiled code on disk, between runs.
* `kernels`: the text compiled, and called by one thread or several.
* `checksums`: kernels of their own for checksums that are XORed byte by byte.
"""

from __future__ import annotations

from lidarspec.points.numba_kernels.checksums import compile_sums as compiled_sums
from lidarspec.points.numba_kernels.kernels import is_available, kernel_of as compile

__all__ = ["compile", "compiled_sums", "is_available"]
