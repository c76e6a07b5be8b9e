"""Compare every workload with memcpy and with other libraries, and print one table.

See docs/how-to/benchmarks.md.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

from capture_workloads import ELSEWHERE
from environments import NOT_INSTALLED, find_version, read_failures
from formats import CONVERSIONS
from inputs import Inputs
from libraries import Missing
from live_workloads import ON_LINES
from measure import Clock, Contender, Rates, cpu_seconds, measure_contenders, memcpy, times
from packet_workloads import ON_BYTES, Work
from remote_contender import RemoteContender
from report import print_rows

import lidarspec as ls
from lidarspec.framing.decoder import BACKENDS

WORKS = {**ON_BYTES, **ELSEWHERE, **ON_LINES, **CONVERSIONS}
#: distributions to show with their versions.
LIBRARIES = (
    "construct",
    "numpy",
    "numba",
    "pyarrow",
    "dpkt",
    "velodyne-decoder",
    "ouster-sdk",
    "lds2d",
    "rplidar",
)
LEAST_RUNS = 5
RUNS = 7
LEAST_SECONDS = 0.05  # of a run
#: the size of a capture that is converted.
SIZE_MB = 1000
QUICK_SIZE_MB = 20


def find_backends() -> list[str]:
    """Return the back ends available here; "auto" represents one of them."""
    sensor = ls.sensor("ldrobot-stl27l")
    found = []
    for name in BACKENDS:
        is_missing = name == "jit" and importlib.util.find_spec("numba") is None
        if name == "auto" or is_missing:
            continue
        try:
            sensor.decode(sensor.example("data"), backend=name).points()
        except (ls.LidarSpecError, ImportError):
            continue
        found.append(name)
    return found


def rows(
    name: str,
    work: Work,
    backends: list[str],
    copy: Contender,
    *,
    runs: int,
    least: float,
    clock: Clock,
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a workload, one for each back end, measured in turn."""
    chosen = backends if work.has_backends else [""]
    others, missing = work.prepare_others()
    if work.after:
        runs = 1
        least = 0.0
    ours = {
        backend: {
            "ours": Contender(work.ours(backend), work.amount, work.after),
            **work.own(backend),
        }
        for backend in chosen
    }
    by_backend = {
        f"{own} {backend}": contender
        for backend, owns in ours.items()
        for own, contender in owns.items()
    }
    rates = measure_contenders({"memcpy": copy, **by_backend, **others}, runs, least, clock)
    for other in others.values():
        if isinstance(other, RemoteContender):
            other.close()
    for backend in chosen:
        mine: Rates = {**rates, **{own: rates[f"{own} {backend}"] for own in ours[backend]}}
        yield {
            "work": name,
            "title": work.title,
            "backend": backend,
            "unit": work.unit,
            "amount": work.amount,
            "bytes": work.size,
            "runs": runs,
            **figures(work, mine, list(others), backend),
            "best": figures(
                work,
                {contender: [min(seconds)] for contender, seconds in mine.items()},
                list(others),
                backend,
            ),
            "not_installed": missing,
        }


def figures(work: Work, rates: Rates, others: list[str], backend: str) -> dict[str, Any]:
    """Return the figures of a workload from the rates of all contenders."""
    seconds = median(rates["ours"]) * work.amount
    return {
        "seconds": seconds,
        "million_per_s": work.amount / seconds / 1e6,
        "mb_per_s": work.size / seconds / 1e6,
        "share_of_memcpy": times(rates, "ours", "memcpy") * work.size / work.amount,
        "times": {other: times(rates, "ours", other) for other in others},
        "facts": work.facts(backend or "numpy", rates),
    }


def versions() -> dict[str, str]:
    """Return the version of each library, or the reason why it is not installed."""
    found = {name: find_version(name) for name in LIBRARIES}
    extras = {name: f"{NOT_INSTALLED} ({reason})" for name, reason in read_failures().items()}
    return {**extras, **found}


def record(found: list[dict[str, Any]], *, quick: bool, cpu: bool) -> dict[str, Any]:
    """Return the results for `--json`."""
    machine = {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "system": platform.system(),
        "cores": os.cpu_count(),
    }
    return {
        "lidarspec": ls.__version__,
        "quick": quick,
        "cpu_time": cpu,
        **machine,
        "libraries": versions(),
        "rows": found,
    }


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(prog="make bench", description=__doc__)
    names = ", ".join(WORKS)
    parser.add_argument(
        "--only",
        metavar="NAME",
        action="append",
        help=(
            "works whose names begin with NAME; default: all but those with `to-`; there are:"
            f" {names}"
        ),
    )
    parser.add_argument(
        "--json", metavar="FILE", type=Path, help="write the figures to a file as well"
    )
    parser.add_argument(
        "--runs",
        metavar="N",
        type=int,
        default=RUNS,
        help=f"runs of each contender, {LEAST_RUNS} or more; default: {RUNS}",
    )
    parser.add_argument(
        "--backend",
        metavar="NAME",
        action="append",
        choices=BACKENDS,
        help="back ends; default: all that work here",
    )
    parser.add_argument(
        "--cpu",
        action="store_true",
        help="count processor time, not the time that passes: for a busy machine",
    )
    parser.add_argument(
        "--best", action="store_true", help="show the best run of each contender, not the median"
    )
    parser.add_argument(
        "--size",
        metavar="MB",
        type=int,
        help=f"of each capture that is converted; default: {SIZE_MB}",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="tiny inputs: shows that everything runs, the figures mean nothing",
    )
    given = parser.parse_args()
    if given.runs < LEAST_RUNS:
        parser.error(f"--runs is {LEAST_RUNS} or more")
    given.size = 1_000_000 * (given.size or (QUICK_SIZE_MB if given.quick else SIZE_MB))
    if given.only:
        given.works = [name for name in WORKS if name.startswith(tuple(given.only))]
    else:
        given.works = [name for name in WORKS if name not in CONVERSIONS]
    if not given.works:
        parser.error(f"no work begins so; there are {', '.join(WORKS)}")
    return given


def main() -> int:
    """Run the benchmarks; return 1 if an undamaged frame was lost, otherwise 0."""
    given = arguments()
    backends = given.backend or find_backends()
    found: list[dict[str, Any]] = []
    copy = memcpy(quick=given.quick)
    least = 0.0 if given.quick else LEAST_SECONDS
    clock = cpu_seconds if given.cpu else time.perf_counter
    with tempfile.TemporaryDirectory() as folder:
        for name in given.works:
            print(f"{name} ...", file=sys.stderr)
            try:
                work = WORKS[name](Inputs(Path(folder), quick=given.quick, size=given.size))
            except Missing as missing:
                print(f"{name}: left out: {missing}", file=sys.stderr)
                continue
            found += rows(name, work, backends, copy, runs=given.runs, least=least, clock=clock)
    title = "best runs" if given.best else "medians"
    if given.cpu:
        title += ", processor time"
    if given.quick:
        title = "quick: these figures mean nothing"
    print_rows(
        found,
        versions(),
        title=title,
        best=given.best,
    )
    if given.json:
        given.json.write_text(
            json.dumps(record(found, quick=given.quick, cpu=given.cpu), indent=2) + "\n",
            encoding="utf-8",
        )
    return int(any(row["facts"].get("intact frames lost") for row in found))


if __name__ == "__main__":
    sys.exit(main())
