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

from lidarspec.points.numba_kernels.checksums import compiled as compiled_sums
from lidarspec.points.numba_kernels.kernels import kernel_of, pays
from lidarspec.points.plan import Maker, Plan

__all__ = ["compile", "compiled_sums"]


def compile(plan: Plan, names: tuple[str, ...], frames: int | None = None) -> Maker | None:
    """What makes these columns of the plan's points, compiled; kept with the plan.

    Args:
        frames: how many are to be made, where a kernel is wanted only if it pays; else it is wanted
            in any case.

    Returns:
        None where a kernel does not pay, or Numba is missing.
    """
    if frames is not None and not pays(plan, names, frames):
        return None
    return kernel_of(plan, names)
