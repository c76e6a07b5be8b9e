"""Findings about a sensor's clock: the code, the text and the next step of each."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

from lidarspec.spec.timing import DAY_S


class FindingType(NamedTuple):
    """The text and the advice for one kind of finding.

    Names in braces in the text are replaced by attributes of `ClockFinding`.

    Attributes:
        text: what was found.
        advice: the next step; "" if none is needed.
        is_fault: whether the finding is a fault, not only information.
    """

    text: str
    advice: str = ""
    is_fault: bool = True


CHECK_MASTER = "check the antenna and the cable of the time source, or its PTP domain and profile"
CHECK_NMEA = "check that each NMEA sentence is sent after the pulse to which it belongs"
CONNECT_SOURCE = "connect a time source (PTP, or GPS with PPS), and select it in the sensor"
WRONG_SENTENCE = "the sensor probably paired its PPS pulse with the wrong NMEA sentence"
#: The codes, the most serious first: states that are faults, events that were faults, all others.
FINDING_TYPES = MappingProxyType(
    {
        "not_locked": FindingType("not locked: {state}", CHECK_MASTER),
        "tai": FindingType(
            "runs on TAI: {value:.0f} s ahead of UTC",
            "pass -O epoch=tai, or set the grandmaster's currentUtcOffset",
        ),
        "gps": FindingType(
            "runs on GPS time: {value:.0f} s ahead of UTC",
            "pass -O epoch=gps, or let the receiver apply the leap seconds",
        ),
        "utc": FindingType(
            "runs on UTC, but the declared epoch is {epoch}",
            "pass -O epoch=utc, or let the grandmaster send TAI",
        ),
        "behind_utc": FindingType(
            "{behind:.0f} s behind UTC: the sensor subtracts the TAI offset from a time that is"
            " already UTC",
            "let the grandmaster send TAI (ptpTimescale), with its currentUtcOffset",
        ),
        "second_off": FindingType(
            "{value:+.3f} s off the host's clock: " + WRONG_SENTENCE, CHECK_NMEA
        ),
        "wrong_date": FindingType(
            "the date is {days:.0f} days off: the sensor's clock was probably never set",
            CONNECT_SOURCE,
        ),
        "offset": FindingType(
            "{value:+.3f} s off the host's clock",
            "synchronize both clocks to one source; chronyc tracking, on the computer that received"
            " the packets, shows the state of the host's clock",
        ),
        "drift": FindingType(
            "drifts by {value:+.1f} ppm",
            "synchronize the sensor by PTP or PPS, or use --time host",
        ),
        "unsynchronized": FindingType(
            "the clock has no valid date, but the declared epoch is {epoch}", CONNECT_SOURCE
        ),
        "lock_lost": FindingType("lost its lock: {state}", CHECK_MASTER),
        "restart": FindingType(
            "the sensor restarted, which reset its clock", "check its power supply"
        ),
        "leap_second": FindingType(
            "stepped by {value:+.3f} s at a leap second",
            "use --time host for the data around the leap second",
        ),
        "second_step": FindingType("stepped by {value:+.3f} s: " + WRONG_SENTENCE, CHECK_NMEA),
        "jump": FindingType(
            "stepped by {value:+.3f} s", "use --time host for the data around this time"
        ),
        "free_running": FindingType(
            "counts from power-up, so it has no date", "use --time host for dates", is_fault=False
        ),
        "lock_gained": FindingType("locked: {state}", is_fault=False),
        "state_changed": FindingType("state: {state}", is_fault=False),
        "no_clock": FindingType("the sensor sends no time", "use --time host", is_fault=False),
        "no_arrival_times": FindingType(
            "the source has no arrival times to compare with", is_fault=False
        ),
        "too_short": FindingType("too few packets to judge the clock", is_fault=False),
        "ok": FindingType("no fault found", is_fault=False),
    }
)
_SEVERITY = {code: rank for rank, code in enumerate(FINDING_TYPES)}


@dataclass(frozen=True)
class ClockFinding:
    """One finding about a clock: an event, such as a step, or a lasting condition.

    Attributes:
        code: a key of `FINDING_TYPES`.
        host_ns: for an event, the arrival time of the first packet after it, ns since 1970; 0 for a
            condition.
        value: the drift in ppm, or the offset or step in seconds; 0 if the code has no value.
        state: the meaning of the clock's status; "" if unknown.
        epoch: the declared epoch, a key of `spec.timing.EPOCHS`.
    """

    code: str
    host_ns: int = 0
    value: float = 0.0
    state: str = ""
    epoch: str = ""

    @property
    def text(self) -> str:
        """The finding as a short text, such as "runs on TAI: 37 s ahead of UTC"."""
        return FINDING_TYPES[self.code].text.format(
            value=self.value,
            behind=-self.value,
            days=abs(self.value) / DAY_S,
            state=self.state,
            epoch=self.epoch.upper(),
        )

    @property
    def advice(self) -> str:
        """The next step; "" if none is needed."""
        return FINDING_TYPES[self.code].advice

    @property
    def is_fault(self) -> bool:
        """Whether the finding is a fault, not only information."""
        return FINDING_TYPES[self.code].is_fault

    @property
    def severity(self) -> int:
        """A number to sort by; the most serious finding has the lowest number."""
        return _SEVERITY[self.code]

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as a JSON object."""
        return {
            "code": self.code,
            "host_ns": self.host_ns,
            "value": self.value,
            "state": self.state,
            "fault": self.is_fault,
            "text": self.text,
            "advice": self.advice,
        }
