"""Kernels at work: compiled by Numba, kept on disk between runs, called by one or several threads.

Nothing here imports Numba before a kernel is wanted. The text of a kernel is a file in the cache folder, since Numba keeps
compiled code only for functions that come from files; its name is a hash of all that the code depends on.
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

import numpy as np
from numpy.typing import NDArray

from lidarspec._version import __version__
from lidarspec.columns.graph import Node
from lidarspec.errors import UsageError
from lidarspec.points.numba_kernels.source import SPREAD, Text
from lidarspec.wire.layout import Bytes2D, span

Values = Callable[[Node], NDArray[Any]]

CACHE, THREADS = "LIDARSPEC_CACHE", "LIDARSPEC_THREADS"

#: points below which a second thread costs more than it saves.
SHARE = 1 << 16


class Kernel:
    """The columns that a text describes, for frames of one layout.

    Args:
        text: of the kernel.
        width: points of a frame.
    """

    def __init__(self, text: Text, width: int) -> None:
        self._text, self._width = text, width
        wanted = text.wanted
        self._numbers = np.array(wanted.numbers, np.int64)
        self._function: Any = None

    @property
    def is_ready(self) -> bool:
        """Whether the compiled code is at hand."""
        return self._function is not None

    @functools.cached_property
    def is_compiled(self) -> bool:
        """Whether the compiled code was at hand or on disk when this was first asked."""
        return self.is_ready or compiled_before(self._text.source)

    def compile(self) -> None:
        """Have the code at hand."""
        self._function = self._function or function_of(self._text.source)

    def columns(self, number: int) -> dict[str, NDArray[Any]]:
        """The columns of so many frames, to be filled."""
        return {name: np.empty(number * self._width, np.float32) for name in self._text.names}

    def run(self, rows: Bytes2D, values: Values, found: Mapping[str, NDArray[Any]]) -> None:
        """Fill the columns of all frames; arguments as of `Program.run`."""
        self.compile()
        count, stride = rows.shape[0], rows.strides[0]
        given: list[Any] = []
        for node in self._text.wanted.nodes:
            given += _flat(values(node), node.shape)
        rest = (self._numbers, *self._text.wanted.arrays, *given, *(found[name] for name in self._text.names))
        data = span(rows)
        self._shared(count, lambda first, number: self._function(data, stride, first, number, *rest))

    def _shared(self, count: int, run: Callable[[int, int], Any]) -> None:
        """Call for all frames, by parts where there are threads and enough for them."""
        number = min(threads(), max(count * self._width // SHARE, 1), count)
        if number < 2:
            if count:
                run(0, count)
            return
        edges = [count * index // number for index in range(number + 1)]
        parts = [_pool(number - 1).submit(run, first, last - first) for first, last in pairwise(edges[1:])]
        run(0, edges[1])
        for part in parts:
            part.result()


def _flat(array: NDArray[Any], shape: tuple[int, ...]) -> tuple[NDArray[np.float64], int]:
    """A result for every packet, or one for all, (n or 1, *shape), as one run of numbers; and how many each packet has of its own."""
    full = (len(array), *shape)
    array = array if array.shape == full else np.broadcast_to(array, full)
    return np.ascontiguousarray(array, np.float64).reshape(-1), math.prod(shape) if len(array) > 1 else 0


def spread_out(values: NDArray[Any], first: NDArray[np.intp], width: int, found: NDArray[Any], *, compiled: bool) -> None:
    """Write the points of packets, `width` each, to where the first of each packet goes; -1 leaves a packet out."""
    if compiled and values.dtype == np.float32:
        function_of(SPREAD)(values, first.astype(np.int64, copy=False), width, found)
        return
    kept = first >= 0
    rows, starts = np.ascontiguousarray(values.reshape(len(first), width), found.dtype), first
    if not kept.all():
        rows, starts = rows[kept], first[kept]
    if rows.size:
        piece = np.dtype((np.void, rows.shape[1] * rows.itemsize))
        windows: NDArray[Any] = np.ndarray((len(found) - width + 1,), piece, found.data, 0, found.strides)
        windows[starts] = rows.view(piece).reshape(-1)


def threads() -> int:
    """How many threads a kernel is given: LIDARSPEC_THREADS, by default 1.

    Raises:
        UsageError: where that is no number of at least 1.
    """
    text = os.environ.get(THREADS, "1")
    if not text.isdecimal() or not int(text):
        raise UsageError(f"{THREADS} is a number of threads, 1 or more, not {text!r}")
    return int(text)


@functools.cache
def _pool(number: int) -> Any:
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(number, "lidarspec")


def available() -> bool:
    """Whether Numba is installed; it is not imported for that."""
    return importlib.util.find_spec("numba") is not None


def require() -> None:
    """Import Numba.

    Raises:
        UsageError: where it is not installed, or does not work here.
    """
    try:
        import lidarspec.points.numba_kernels.arithmetic  # noqa: F401
    except ImportError as error:
        raise UsageError(f"backend 'jit' needs Numba: pip install 'lidarspec[jit]' ({error})") from error


def cache_folder() -> Path:
    """Where kernels are kept: LIDARSPEC_CACHE, or what the system calls the user's cache."""
    named = os.environ.get(CACHE)
    if named:
        return Path(named)
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "lidarspec"


@functools.cache
def _module_name(source: str) -> str:
    """A name by all that the compiled code depends on, but for the processor, which Numba looks after."""
    from importlib.metadata import version

    vocabulary = Path(__file__).with_name("arithmetic.py").read_bytes()
    parts = (source, __version__, version("numba"), np.__version__, sys.version)
    digest = hashlib.sha256("\0".join(parts).encode() + vocabulary)
    return f"lidarspec_kernel_{digest.hexdigest()[:24]}"


def compiled_before(source: str) -> bool:
    """Whether compiled code of a kernel is in the cache folder."""
    name = _module_name(source)
    if name in sys.modules:
        return True
    try:
        return any((cache_folder() / "__pycache__").glob(f"{name}.kernel-*.nbi"))
    except OSError:
        return False


@functools.lru_cache(maxsize=256)
def function_of(source: str) -> Any:
    """The compiled function of a kernel's text; where the cache folder cannot be written, compiled for this run only."""
    name = _module_name(source)
    path = _kept(name, source)
    module = types.ModuleType(name)
    if path is not None:
        module.__file__ = str(path)
    sys.modules[name] = module  # Numba looks it up by its name as it loads compiled code
    text = source if path is not None else source.replace("cache=True, ", "")
    try:
        exec(compile(text, str(path or name), "exec"), module.__dict__)
    except BaseException:
        del sys.modules[name]
        raise
    return module.kernel


def _kept(name: str, source: str) -> Path | None:
    """The file of a kernel's text, written if it is not there; None where that cannot be done."""
    folder = cache_folder()
    path = folder / f"{name}.py"
    try:
        if path.is_file() and path.read_text(encoding="utf-8") == source:
            return path if os.access(folder, os.W_OK) or (folder / "__pycache__").is_dir() else None
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        unfinished = folder / f"{name}.{os.getpid()}.tmp"
        unfinished.write_text(source, encoding="utf-8")
        os.replace(unfinished, path)
        return path
    except OSError:
        return None
