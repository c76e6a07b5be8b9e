"""Choose the back end that computes columns: NumPy or compiled kernels.

Loading Numba and compiling a kernel take about a second. The back end "auto" therefore begins with
NumPy. It changes to a kernel when so many points have been computed that a kernel saves time.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

from lidarspec.points import numpy_plan
from lidarspec.points.plan import ColumnMaker, Plan, PointsFunction

#: The number of points from which a kernel saves time: a cached kernel (warm), or a kernel that has
#: to be compiled first (cold).
MIN_WARM_KERNEL_POINTS = 1 << 26
MIN_COLD_KERNEL_POINTS = 1 << 28
#: A count of points that never reaches these limits. It is set if no kernel works.
_NEVER = -(1 << 62)

#: The numbers of points computed so far, by the names of the computed columns.
_POINT_COUNTS: WeakKeyDictionary[PointsFunction, dict[tuple[str, ...], int]] = WeakKeyDictionary()


def compile_columns(plan: Plan, names: tuple[str, ...], backend: str, frames: int) -> ColumnMaker:
    """Compile columns of a plan to a NumPy program or a kernel.

    Args:
        backend: "numpy", "jit" or "auto".
        frames: the number of frames to compute.

    Raises:
        LibraryError: for "jit", if Numba is missing or does not work here.
    """
    if backend == "jit":
        from lidarspec.points import numba_kernels

        return numba_kernels.compile(plan, names)
    if backend == "auto":
        kernel = _find_faster_kernel(plan, names, frames)
        if kernel is not None:
            return kernel
    return numpy_plan.compile(plan, names)


def _find_faster_kernel(plan: Plan, names: tuple[str, ...], frames: int) -> ColumnMaker | None:
    """Count the points, and return a kernel if it saves time, else None."""
    counts = _POINT_COUNTS.setdefault(plan.function, {})
    counts[names] = counts.get(names, 0) + frames * plan.width
    if counts[names] < MIN_WARM_KERNEL_POINTS:
        return None
    from lidarspec.points import numba_kernels  # most jobs do not need it

    try:
        if numba_kernels.is_available():
            kernel = numba_kernels.compile(plan, names)
            if counts[names] < MIN_COLD_KERNEL_POINTS and not kernel.was_stored:
                return None
            kernel.compile()
            return kernel
    except Exception:  # if Numba or its cache fails, NumPy is used
        pass
    counts[names] = _NEVER
    return None
