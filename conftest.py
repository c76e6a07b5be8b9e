"""Isolate the tests from the user's settings, and list the missing tools at the end.

A shell starts background jobs with Ctrl-C ignored, and child processes inherit that. So the handler
is restored here, and Ctrl-C reaches the programs that tests start.
"""

from __future__ import annotations

import gc
import os
import signal
import weakref
from collections.abc import Iterator

import pytest

from lidarspec.framing import example_frames
from lidarspec.sensor_operations import Sensor
from tests.missing import describe_missing

#: Plugins with tests that need a separate environment: `make test-ros2`.
collect_ignore = ["plugins/lidarspec-ros2"]

# Collecting tests makes hundreds of thousands of objects, and all are kept. So garbage collection
# would waste time.
gc.disable()

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

#: Environment variables that change lidarspec's behaviour; unset for the tests.
LIDARSPEC_VARIABLES = (
    "LIDARSPEC_BACKEND",
    "LIDARSPEC_THREADS",
    "LIDARSPEC_DEBUG",
    "LIDARSPEC_TRUST",
)


@pytest.fixture(autouse=True, scope="session")
def _isolated(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Run the tests with separate settings and kernel folders, and no `lidarspec.toml`."""
    base = tmp_path_factory.getbasetemp()
    (base / "lidarspec.toml").touch()  # only the nearest file is read
    here = base / "here"
    here.mkdir()
    every = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    with pytest.MonkeyPatch.context() as patch:
        for name in LIDARSPEC_VARIABLES:
            patch.delenv(name, raising=False)
        for name in ("XDG_CONFIG_HOME", "APPDATA"):
            patch.setenv(name, str(base / "settings"))
        patch.setenv("LIDARSPEC_CACHE", str(every / "kernels"))  # shared by all workers
        patch.setenv("OPENBLAS_NUM_THREADS", "1")  # child processes need no BLAS threads
        # Child processes share compiled modules in a temporary folder, for speed.
        if os.environ.get("PYTHONDONTWRITEBYTECODE"):
            patch.delenv("PYTHONDONTWRITEBYTECODE")
            patch.setenv("PYTHONPYCACHEPREFIX", str(every / "bytecode"))
        patch.chdir(here)
        yield


@pytest.fixture(autouse=True, scope="session")
def _examples_are_made_once() -> Iterator[None]:
    """Cache example frames, because thousands of tests use the same frames."""
    made: weakref.WeakKeyDictionary[Sensor, dict[tuple[str, int], bytes]] = (
        weakref.WeakKeyDictionary()
    )
    original = example_frames.example

    def example(sensor: Sensor, frame: str, *, seed: int = 0) -> bytes:
        frames = made.setdefault(sensor, {})
        if (frame, seed) not in frames:
            frames[frame, seed] = original(sensor, frame, seed=seed)
        return frames[frame, seed]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(example_frames, "example", example)
        yield


@pytest.fixture(autouse=True, scope="module")
def _frozen() -> None:
    """Exempt all objects from garbage collection before a module's first test.

    This saves time.
    """
    gc.collect(1)
    gc.freeze()


def pytest_collection_finish() -> None:
    """Enable garbage collection for the tests."""
    gc.enable()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List the tests skipped for a missing tool or capture, and how to get it."""
    skipped = [
        report
        for report in terminalreporter.stats.get("skipped", [])
        if isinstance(report.longrepr, tuple)
    ]
    for line in describe_missing((report.nodeid, report.longrepr[2]) for report in skipped):
        terminalreporter.write_line(line)
