"""Fuzz everything that reads outside data: `make fuzz INPUTS=10000000 SEED=1`.

The same command resumes an interrupted run.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

from tests.fuzz import slug

ROOT = Path(__file__).parents[2]
#: seconds without a word after which a job is stopped: nothing that it may do takes as long.
SILENCE = 300.0
#: groups whose inputs are of kilobytes: atheris keeps each that it made until the end, which for a
#: million of these is all the memory.
SEEDED = {"capture", "file", "log", "recording"}


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(prog="make fuzz", description=__doc__)
    parser.add_argument(
        "--inputs",
        metavar="N",
        type=int,
        default=1_000_000,
        help="in all, spread over the targets; default: a million",
    )
    parser.add_argument(
        "--seed",
        metavar="N",
        type=int,
        default=0,
        help="of everything that is drawn; another one makes other inputs",
    )
    parser.add_argument(
        "--only",
        metavar="NAME",
        action="append",
        help="targets whose names begin so, such as frame or 'stream ldrobot'",
    )
    parser.add_argument(
        "--jobs",
        metavar="N",
        type=int,
        default=os.cpu_count(),
        help="processes at a time; default: one for each core",
    )
    parser.add_argument(
        "--engine",
        choices=["atheris", "seeded"],
        help="what chooses inputs; default: atheris where it is installed",
    )
    parser.add_argument(
        "--folder",
        metavar="DIR",
        type=Path,
        default=ROOT / ".fuzz",
        help="for corpus and findings; default: .fuzz",
    )
    parser.add_argument(
        "--again",
        metavar="FILE",
        type=Path,
        help="read the input of a finding once more, and let it fail in the open",
    )
    parser.add_argument("--job", metavar="TARGET", help=argparse.SUPPRESS)
    given = parser.parse_args()
    given.engine = given.engine or ("atheris" if importlib.util.find_spec("atheris") else "seeded")
    given.folder = given.folder.absolute()
    return given


def main() -> int:
    """Run the fuzzing; return 1 if there are findings, else 0."""
    given = arguments()
    if given.again:
        given.again = given.again.absolute()
    if given.job or given.again:
        return child(given)
    with tempfile.TemporaryDirectory() as scratch:
        chosen = list_targets(Path(scratch), given.only)
    names = list(chosen)
    done = {
        path.stem: json.loads(path.read_text())
        for path in (given.folder / f"done-{given.seed}").glob("*.json")
    }
    shares = spread(chosen, given.inputs)
    waiting = [name for name in names if done.get(slug(name), {}).get("asked") != shares[name]]
    before = len(names) - len(waiting)
    print(
        f"{len(names)} targets, {sum(shares.values())} inputs, {given.engine}, seed {given.seed};"
        f" {before} targets done before"
    )
    run(given, waiting, shares)
    return print_results(given, names)


def list_targets(folder: Path, only: list[str] | None) -> dict[str, float]:
    """Return the requested targets, and the cost of an input of each."""
    from tests.every_sensor import every_sensor
    from tests.fuzz.targets import targets

    known = targets(folder, every_sensor().values())
    found = {
        name: target.cost
        for name, target in known.items()
        if not only or name.startswith(tuple(only))
    }
    if not found:
        sys.exit(f"no target begins so; there are {', '.join(known)}")
    return found


def spread(costs: dict[str, float], number: int) -> dict[str, int]:
    """Return the number of inputs of each target.

    A group of targets gets its share of all inputs. Within a group, a target gets more inputs if
    its inputs cost less.
    """
    from tests.fuzz.targets import SHARES

    of = {name: name.partition(" ")[0] for name in costs}
    whole = sum(SHARES[group] for group in set(of.values()))
    parts = {
        group: sum(1 / cost for name, cost in costs.items() if of[name] == group)
        for group in of.values()
    }
    return {
        name: max(1, round(number * SHARES[of[name]] / whole / cost / parts[of[name]]))
        for name, cost in costs.items()
    }


def run(given: argparse.Namespace, waiting: list[str], shares: dict[str, int]) -> None:
    """Run the jobs, `given.jobs` at a time, and store each result when a job ends."""
    running: dict[str, tuple[subprocess.Popen[bytes], float]] = {}
    queue = list(waiting)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        while queue or running:
            while queue and len(running) < given.jobs:
                name = queue.pop(0)
                running[name] = start(given, name, shares[name]), time.time()
            time.sleep(0.05)
            for name, (process, began) in list(running.items()):
                report = given.folder / "jobs" / f"{slug(name)}.json"
                heard = report.stat().st_mtime if report.is_file() else began
                if process.poll() is None and time.time() - heard > SILENCE:
                    process.kill()
                    process.wait()
                if process.returncode is not None:
                    store_results(given, name, shares[name], process)
                    del running[name]
    except KeyboardInterrupt:
        print(
            "interrupted: the same command goes on with the targets that are not done",
            file=sys.stderr,
        )
    finally:
        for process, _ in running.values():
            process.kill()


def start(given: argparse.Namespace, name: str, number: int) -> subprocess.Popen[bytes]:
    """Start the process of one job."""
    (given.folder / "jobs").mkdir(parents=True, exist_ok=True)
    report = given.folder / "jobs" / f"{slug(name)}.json"
    report.unlink(missing_ok=True)
    words = [
        "--job",
        name,
        "--inputs",
        str(number),
        "--seed",
        str(given.seed),
        "--engine",
        given.engine,
        "--folder",
        str(given.folder),
    ]
    with report.with_suffix(".log").open("wb") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz", *words],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )


def store_results(
    given: argparse.Namespace, name: str, asked: int, process: subprocess.Popen[bytes]
) -> None:
    """Store the results of a job; the input that ended its process is a finding."""
    from tests.fuzz.campaign import keep
    from tests.fuzz.trial import Finding

    report = given.folder / "jobs" / f"{slug(name)}.json"
    did = (
        json.loads(report.read_text())
        if report.is_file()
        else {"inputs": 0, "lines": 0, "seconds": 0.0, "findings": []}
    )
    current = given.folder / "current" / slug(name)
    if current.is_file():
        held = current.read_bytes()
        data = held[4 : 4 + int.from_bytes(held[:4], "little")]
        keep(
            given.folder,
            Finding(
                name,
                data,
                f"the process ended with {process.returncode}; -9: it was stopped after {SILENCE:g}"
                " s without a word",
                "the process",
            ),
        )
        current.unlink()
        did["findings"].append("the process")
    elif did["inputs"] < asked:
        log = report.with_suffix(".log").read_text(errors="replace")
        did["findings"].append(f"it ended after {did['inputs']} inputs: {log[-300:]}")
    place = given.folder / f"done-{given.seed}"
    place.mkdir(exist_ok=True)
    (place / f"{slug(name)}.json").write_text(
        json.dumps(
            {
                **did,
                "found": len(did["findings"]),
                "asked": asked if did["inputs"] >= asked else 0,
                "target": name,
            }
        )
    )
    print(
        f"{name}: {did['inputs']} inputs, {did['inputs'] / max(did['seconds'], 1e-9):.0f} a second",
        flush=True,
    )


def print_results(given: argparse.Namespace, names: list[str]) -> int:
    """Print the results of this seed by group, and the command to repeat each finding.

    Returns 1 if there is a finding.
    """
    every = [
        json.loads(path.read_text())
        for path in sorted((given.folder / f"done-{given.seed}").glob("*.json"))
    ]
    groups: dict[str, list[dict[str, Any]]] = {}
    for did in (did for did in every if did["target"] in names):
        groups.setdefault(did["target"].partition(" ")[0], []).append(did)
    print(f"\n{'target':14}{'inputs':>12}{'seconds':>9}{'a second':>10}{'findings':>10}")
    for group, mine in {**groups, "all": [did for jobs in groups.values() for did in jobs]}.items():
        inputs, seconds, found = (
            sum(did[key] for did in mine) for key in ("inputs", "seconds", "found")
        )
        print(f"{group:14}{inputs:12}{seconds:9.0f}{inputs / max(seconds, 1e-9):10.0f}{found:10}")
    places = [
        (did["target"], place)
        for jobs in groups.values()
        for did in jobs
        for place in did["findings"]
    ]
    for target, place in places:
        print(f"{target}: {place}")
    kept = {slug(target) for target, _ in places}
    for path in sorted((given.folder / "findings").glob("*/*.txt")):
        if path.parent.name in kept:
            print(
                f"make fuzz ARGS='--again {os.path.relpath(path.with_suffix(''))}'   #"
                f" {path.read_text().strip()[:150]}"
            )
    return int(bool(places))


def child(given: argparse.Namespace) -> int:
    """Run one job, or one input again, in this process.

    It uses a separate folder, and no user settings.
    """
    os.environ.update(OPENBLAS_NUM_THREADS="1", COLUMNS="80")
    is_guided = (
        given.engine == "atheris" and given.job and given.job.partition(" ")[0] not in SEEDED
    )
    atheris = importlib.import_module("atheris") if is_guided else None
    sys.stdout.flush()
    with (
        tempfile.TemporaryDirectory() as scratch,
        atheris.instrument_imports(include=["lidarspec"]) if atheris else contextlib.nullcontext(),
    ):
        os.environ.update(
            XDG_CONFIG_HOME=f"{scratch}/settings", LIDARSPEC_CACHE=str(given.folder / "kernels")
        )
        from tests.every_sensor import every_sensor
        from tests.fuzz.campaign import Job, run_guided, run_mutations
        from tests.fuzz.targets import targets

        warnings.simplefilter("ignore")  # they tell a user what was in the bytes
        place = Path(scratch, "here")
        place.mkdir()
        (Path(scratch) / "lidarspec.toml").touch()
        os.chdir(place)
        known = targets(place, every_sensor().values())
        if given.again:
            name = next(name for name in known if slug(name) == given.again.parent.name)
            known[name].run(given.again.read_bytes())
            return 0
        (run_guided if atheris else run_mutations)(
            Job(known[given.job], given.folder, given.seed), given.inputs
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
