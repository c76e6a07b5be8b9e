"""What `lidarspec check` and the test kit say of a sensor: findings, each under a rule that says why it matters and what to write."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lidarspec.spec import Sensor
from lidarspec.testing.rules import RULES, Rule


@dataclass(frozen=True)
class Finding:
    """A mistake at a place in a spec.

    Attributes:
        code: of its rule.
        what: what is wrong there.
        path: frame, and field below it ("data.points.distance"); "" where it concerns the whole.
        sensor: its id; "" where it never came to be one.
        file, line: where that stands, "" and 0 where it is not known.
    """

    code: str
    what: str
    path: str = ""
    sensor: str = ""
    file: str = ""
    line: int = 0

    @property
    def rule(self) -> Rule:
        """The rule that it is a case of."""
        return RULES[self.code]

    def to_dict(self) -> dict[str, Any]:
        """The finding and its rule as JSON has them."""
        return {**asdict(self), "title": self.rule.title, "why": self.rule.why, "write": self.rule.write}

    def __str__(self) -> str:
        place = " ".join(part for part in (self.sensor, self.path) if part)
        file = Path(self.file)
        file = file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file
        where = f"{file}:{self.line}" if self.line else str(file) if self.file else ""
        where = f"{place} ({where})" if place and where else place or where
        rule = self.rule
        return f"{self.code} {rule.title}\n  where  {where}\n  what   {self.what}\n  why    {rule.why}\n  write  {rule.write}"


class Violation(AssertionError):
    """A property that does not hold: the test kit's failure, and the check's finding."""

    def __init__(self, code: str, what: str, path: str = "") -> None:
        self.code, self.what, self.path = code, what, path
        rule = RULES[code]
        super().__init__(
            f"{code} {rule.title}\n  where: {path or 'the sensor'}\n  what:  {what}\n  why:   {rule.why}\n  write: {rule.write}"
        )


def require(holds: object, code: str, what: str, path: str = "") -> None:
    """Raise a `Violation` unless something holds.

    Raises:
        Violation: with this code, text and place.
    """
    if not holds:
        raise Violation(code, what, path)


def left_over(findings: list[Finding], sensor: Sensor, *, whole: bool) -> list[Finding]:
    """The findings without those that a sensor's declaration acknowledges with a reason.

    Args:
        whole: these are all findings, and an acknowledgement of none of them is one more.
    """
    given = {"": sensor.acknowledged, **{name: frame.acknowledged for name, frame in sensor.frames.items()}}
    used: set[tuple[str, str]] = set()
    left = []
    for finding in findings:
        frame, _, field = finding.path.partition(".")
        keys = [(place, key) for place in (frame, "") for key in (finding.code, f"{finding.code} {field if place else finding.path}")]
        known = [(place, key) for place, key in keys if given.get(place, {}).get(key, "").strip()]
        used.update(known)
        left += [] if known else [finding]
    for place, entries in given.items() if whole else ():
        for key, reason in entries.items():
            if (place, key) not in used:
                said = "has no reason" if not reason.strip() else "is not found"
                left.append(Finding("LS209", f"{key!r} is acknowledged, and {said}", place, sensor.id))
    return left
