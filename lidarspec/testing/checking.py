"""`lidarspec check` without the command line: every property and every rule over a sensor, a file or a distribution."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lidarspec.spec import Sensor
from lidarspec.testing.declared import declared
from lidarspec.testing.findings import Finding, left_over
from lidarspec.testing.places import Places
from lidarspec.testing.properties import PROPERTIES
from lidarspec.testing.subject import EXAMPLES, Subject
from lidarspec.testing.targets import Target
from lidarspec.testing.written import written

#: rules without which there is nothing to try, and what is skipped then.
FATAL, ELSE = frozenset({"LS114", "LS115", "LS301"}), "everything else"


@dataclass(eq=False)
class Report:
    """What was found.

    Attributes:
        name: the sensor's id, or what was checked where there is none.
        findings: what is wrong.
        held: how many properties hold.
        skipped: property -> why it does not apply.
        measured: what was measured along the way.
    """

    name: str
    findings: list[Finding]
    held: int = 0
    skipped: dict[str, str] = field(default_factory=dict)
    measured: dict[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON has it."""
        return {**vars(self), "findings": [finding.to_dict() for finding in self.findings]}


def reports(
    target: Target, name: str, *, examples: int = EXAMPLES, vectors: Path | None = None, watch: Callable[[str], None] | None = None
) -> Iterator[Report]:
    """A report of the text and the loading of a target, where there is something to say, and one of each of its sensors.

    Args:
        name: what was asked for.
        examples: of each frame type, for each property.
        vectors: golden vectors; by default those that the target has.
        watch: is told what is looked at.
    """
    places = Places(target.files)
    mistakes = [places.placed(finding) for finding in target.findings] + written(target.files)
    single = [sensor for sensor in target.sensors if len(target.sensors) == 1]
    if mistakes and not single:
        yield Report(name, mistakes)
    for sensor in target.sensors:
        subject = Subject(sensor, examples, vectors=vectors or target.vectors)
        yield _report(subject, places, mistakes if single else [], watch or (lambda text: None))


def _report(subject: Subject, places: Places, mistakes: list[Finding], watch: Callable[[str], None]) -> Report:
    sensor: Sensor = subject.sensor
    report = Report(sensor.id, list(mistakes))
    if not sensor.frames:
        report.skipped["all properties"] = "it has no frames before it is configured with its file"
        return report
    watch(f"{sensor.id}: declaration")
    report.findings += declared(subject)
    for one in PROPERTIES:
        reason = one.lacks(subject) or _in_vain(one.unless, report.findings)
        if reason:
            report.skipped[one.name] = reason
            continue
        watch(f"{sensor.id}: {one.name}")
        found = one.findings(subject)
        report.held += not found
        report.findings += found
        if any(finding.code in FATAL for finding in report.findings):
            report.skipped[ELSE] = "nothing can be tried before what is found is mended"
            break
    distinct = list({(finding.code, finding.path): finding for finding in reversed(report.findings)}.values())[::-1]
    left = left_over(distinct, sensor, whole=ELSE not in report.skipped)
    report.findings = [places.placed(finding, sensor) for finding in left]
    report.measured = subject.measured
    return report


def _in_vain(unless: tuple[str, ...], findings: list[Finding]) -> str:
    """Why a property would only say again what was found."""
    found = sorted({finding.code for finding in findings} & set(unless))
    return f"{', '.join(found)} is found already" if found else ""
