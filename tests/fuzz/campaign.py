"""Make inputs for one target from its examples and from inputs that reach new lines.

Inputs are made by atheris if it is installed, otherwise at random from a seed.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from tests.fuzz import slug
from tests.fuzz.targets import LONGEST, Target
from tests.fuzz.trial import Finding, bound_memory, judge, limits

#: one input in so many is traced for the lines that it reaches, which makes it ten times as slow.
TRACED = 20
#: seconds after which a job says how far it is.
TOLD = 1.0


@dataclass
class Job:
    """The inputs that were read for a target, and their results.

    Attributes:
        target: the target.
        folder: the folder of its corpus, findings and report.
        seed: the seed of all random choices.
        inputs: the number of inputs that were read.
        lines: the number of lines of code that traced inputs reached.
        seconds: the duration.
        findings: one finding for each line of code that raised, by this line.
    """

    target: Target
    folder: Path
    seed: int
    inputs: int = 0
    lines: int = 0
    seconds: float = 0.0
    findings: dict[str, Finding] = field(default_factory=dict)
    _began: float = field(default_factory=time.monotonic)

    @property
    def corpus(self) -> Path:
        """Return the folder of inputs that reached new lines."""
        return self.folder / "corpus" / slug(self.target.name)

    @property
    def current(self) -> Path:
        """Return the file of the current input, which remains if the process dies."""
        return self.folder / "current" / slug(self.target.name)

    def read(self, data: bytes) -> None:
        """Read an input, and store a finding."""
        self._current.seek(0)
        self._current.write(len(data).to_bytes(4, "little") + data)
        found = judge(self.target, data)
        self.inputs += 1
        if found is not None and found.place not in self.findings:
            self.findings[found.place] = found
            keep(self.folder, found)
        if time.monotonic() - self._began - self.seconds > TOLD:
            self.write_progress()
            bound_memory()

    def write_progress(self) -> None:
        """Write the counts, the duration and the findings so far to a file."""
        self.seconds = time.monotonic() - self._began
        told = {
            "inputs": self.inputs,
            "lines": self.lines,
            "seconds": self.seconds,
            "findings": sorted(self.findings),
        }
        path = self.folder / "jobs" / f"{slug(self.target.name)}.json"
        path.with_suffix(".new").write_text(json.dumps(told), encoding="utf-8")
        os.replace(path.with_suffix(".new"), path)

    @contextlib.contextmanager
    def running(self) -> Iterator[list[bytes]]:
        """Yield the initial inputs, within the limits of memory and time.

        Each is read once before the limits apply.
        """
        for path in (self.corpus, self.current.parent, self.folder / "jobs"):
            path.mkdir(parents=True, exist_ok=True)
        beginning = [
            *self.target.examples(),
            *(path.read_bytes() for path in sorted(self.corpus.iterdir())),
        ]
        for data in beginning:
            with contextlib.suppress(Exception):  # reported when it is read again within the limits
                self.target.run(data)
        with limits(), self.current.open("wb", buffering=0) as self._current:
            self._began = time.monotonic()
            yield beginning
            self.write_progress()
        self.current.unlink()


def keep(folder: Path, found: Finding) -> Path:
    """Write the input of a finding and its report to files."""
    path = folder / "findings" / slug(found.target) / hashlib.sha256(found.data).hexdigest()[:12]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(found.data)
    path.with_suffix(".txt").write_text(f"{found.place}: {found.what}\n", encoding="utf-8")
    return path


def run_mutations(job: Job, number: int) -> None:
    """Read a number of inputs, which are mutations.

    They are mutations of the examples, and of inputs that reached new lines. Only a sample of the
    inputs is checked for new lines.
    """
    source = random.Random(f"{job.seed} {job.target.name}")
    lines: set[Any] = set()
    with job.running() as pool:
        for data in pool:
            with _trace(lines):
                job.read(data)
        while job.inputs < number:
            data = job.target.mutation(source.choice(pool), source.choice(pool), source)
            if job.inputs % TRACED:
                job.read(data)
                continue
            before = len(lines)
            with _trace(lines):
                job.read(data)
            if len(lines) > before:
                pool.append(data)
                (job.corpus / hashlib.sha256(data).hexdigest()[:12]).write_bytes(data)
        job.lines = len(lines)


@contextlib.contextmanager
def _trace(lines: set[Any]) -> Iterator[None]:
    """Add the lines of lidarspec and its plugins that run in this context."""

    def local(frame: FrameType, event: str, _: object) -> Callable[..., Any]:
        lines.add((frame.f_code, frame.f_lineno))
        return local

    def called(frame: FrameType, event: str, _: object) -> Callable[..., Any] | None:
        return local if "/lidarspec" in frame.f_code.co_filename else None

    before = sys.gettrace()
    sys.settrace(called)
    try:
        yield
    finally:
        sys.settrace(before)


def run_guided(job: Job, number: int) -> None:
    """Read a number of inputs that atheris chooses by coverage; then end the process.

    lidarspec has to be imported within `atheris.instrument_imports`.
    """
    import atheris

    stack = contextlib.ExitStack()
    beginning = stack.enter_context(job.running())

    def mutation(data: bytes, longest: int, seed: int) -> bytes:
        source = random.Random(seed)
        return job.target.mutation(
            data or source.choice(beginning), source.choice(beginning), source
        )[:longest]

    def one(data: bytes) -> None:
        job.read(data)
        if job.inputs == number:
            stack.close()
            os._exit(0)  # libFuzzer would go on with its corpus

    for data in beginning:
        (job.corpus / hashlib.sha256(data).hexdigest()[:12]).write_bytes(data)
    rules = (
        f"-runs={number + len(beginning)}",
        f"-seed={job.seed + 1}",
        f"-max_len={LONGEST}",
        "-rss_limit_mb=0",
        "-timeout=0",
        "-verbosity=0",
        "-print_final_stats=0",
    )
    atheris.Setup(["fuzz", *rules, str(job.corpus)], one, custom_mutator=mutation)
    atheris.Fuzz()
