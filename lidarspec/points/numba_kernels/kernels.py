"""Compile or load kernels, and call them in one or more threads.

Numba is imported when the first kernel is needed.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import math
import os
import sys
import types
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from lidarspec._version import __version__
from lidarspec.errors import UsageError
from lidarspec.frames.layout import Bytes2D, view_span
from lidarspec.optional_libraries import import_library
from lidarspec.points.numba_kernels.cache import StoredKernel, is_stored
from lidarspec.points.numba_kernels.source import KernelText, write_kernel
from lidarspec.points.plan import ColumnMaker, Plan, PointsFunction, Values

THREADS = "LIDARSPEC_THREADS"

#: A further thread is used only if each thread has at least this number of points.
MIN_THREAD_POINTS = 1 << 16

#: The size of the frames that have their own kernel, for each `points` function.
_OWN_KERNEL_BYTES: WeakKeyDictionary[PointsFunction, int] = WeakKeyDictionary()


class Kernel(ColumnMaker):
    """Computes columns of frames of one layout by a compiled kernel.

    Args:
        text: the source of the kernel and its arguments.
        width: the number of points of a frame.
    """

    def __init__(self, text: KernelText, width: int) -> None:
        self._text = text
        self._width = width
        self._numbers = np.array(text.wanted.numbers, np.int64)
        self._function: Any = None

    @property
    def is_ready(self) -> bool:
        """Whether the compiled code is loaded."""
        return self._function is not None

    @functools.cached_property
    def was_stored(self) -> bool:
        """Whether the code did not have to be compiled when this property was first read.

        This is so if the code was already loaded or on disk.
        """
        return self.is_ready or is_code_available(self._text.source)

    def compile(self) -> None:
        """Load or compile the code, if this was not done before."""
        self._function = self._function or compile_source(self._text.source)

    def columns(self, number: int) -> dict[str, NDArray[Any]]:
        return {
            name: np.empty(number * self._width, dtype)
            for name, dtype in self._text.columns.items()
        }

    def run(self, rows: Bytes2D, values: Values, columns: Mapping[str, NDArray[Any]]) -> None:
        self.compile()
        count = rows.shape[0]
        stride = rows.strides[0]
        arguments: list[Any] = []
        for node in self._text.wanted.nodes:
            arguments += _flatten(values(node), node.shape)
        rest = (
            self._numbers,
            *self._text.wanted.arrays,
            *arguments,
            *(columns[name] for name in self._text.columns),
        )
        data = view_span(rows)
        self._call_in_threads(
            count, lambda first, number: self._function(data, stride, first, number, *rest)
        )

    def _call_in_threads(self, count: int, run: Callable[[int, int], Any]) -> None:
        """Call the kernel for all frames, in several threads if this is faster.

        Args:
            count: the number of frames.
            run: a function that calls the kernel, given the first frame and the number of frames.
        """
        number = min(count_threads(), max(count * self._width // MIN_THREAD_POINTS, 1), count)
        if number < 2:
            if count:
                run(0, count)
            return
        edges = [count * index // number for index in range(number + 1)]
        parts = [
            _get_pool(number - 1).submit(run, first, last - first)
            for first, last in pairwise(edges[1:])
        ]
        run(0, edges[1])
        for part in parts:
            part.result()


def _flatten(array: NDArray[Any], shape: tuple[int, ...]) -> tuple[NDArray[np.float64], int]:
    """Return a flattened array, and the number of values of each packet."""
    # The number is 0 if all packets share the values.
    full = (len(array), *shape)
    if array.shape != full:
        array = np.broadcast_to(array, full)
    return np.ascontiguousarray(array, np.float64).reshape(-1), math.prod(shape) if len(
        array
    ) > 1 else 0


def get_kernel(plan: Plan, names: tuple[str, ...]) -> Kernel:
    """Return the kernel that computes columns of a plan; the plan caches it."""
    # The first layout of a `points` function has its own kernel. All other layouts share kernels
    # that accept arrays of any length.
    kernel = plan.kernels.get(names)
    if not isinstance(kernel, Kernel):
        is_own = (
            not plan.varying
            or _OWN_KERNEL_BYTES.setdefault(plan.function, plan.layout.size) == plan.layout.size
        )
        kernel = plan.kernels[names] = Kernel(
            write_kernel(plan, names, set() if is_own else plan.varying), plan.width
        )
    return kernel


def count_threads() -> int:
    """Return the number of threads of a kernel: LIDARSPEC_THREADS, by default 1.

    Raises:
        UsageError: if LIDARSPEC_THREADS is not an integer of at least 1.
    """
    text = os.environ.get(THREADS, "1")
    if not text.isdecimal() or not int(text):
        raise UsageError(f"{THREADS} must be a number of threads, at least 1, not {text!r}")
    return int(text)


@functools.cache
def _get_pool(number: int) -> Any:
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(number, "lidarspec")


def is_available() -> bool:
    """Return whether Numba is installed, without importing it."""
    return importlib.util.find_spec("numba") is not None


@functools.cache  # reading the version takes as long as decoding a hundred packets
def import_numba() -> None:
    """Import Numba.

    Raises:
        LibraryError: if Numba is missing, too old, or does not work here.
    """
    import_library("numba", "jit")


@functools.cache
def _make_module_name(source: str) -> str:
    """Return a hash of everything that the compiled code depends on, as a module name."""
    # The processor is not included, because the name of the file in the cache depends on it.
    from importlib.metadata import version

    vocabulary = Path(__file__).with_name("arithmetic.py").read_bytes()
    parts = (source, __version__, version("numba"), np.__version__, sys.version)
    digest = hashlib.sha256("\0".join(parts).encode() + vocabulary)
    return f"lidarspec_kernel_{digest.hexdigest()[:24]}"


def is_code_available(source: str) -> bool:
    """Return whether the compiled code of a kernel is loaded, or in the cache folder."""
    name = _make_module_name(source)
    return name in sys.modules or is_stored(name)


@functools.lru_cache(maxsize=256)
def compile_source(source: str) -> Any:
    """Return the compiled function of a kernel, given its source."""
    name = _make_module_name(source)
    module = types.ModuleType(name)
    module.__dict__["STORED"] = StoredKernel(name)
    sys.modules[name] = module  # Numba looks it up by its name as it loads compiled code
    try:
        exec(compile(source, name, "exec"), module.__dict__)
    except BaseException:
        del sys.modules[name]
        raise
    return module.kernel
