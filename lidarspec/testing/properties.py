"""The table of properties that every sensor must have, for `lidarspec check` and for pytest.

A property is a function of a `SensorUnderTest` that raises an exception if the property does not
hold. This module can be imported without the extra `testing`.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from lidarspec.errors import SpecError
from lidarspec.framing.frame_engine import get_codec
from lidarspec.simulation.simulator import find_periodic_rates
from lidarspec.testing import commands, consistency, frames, geometry, streams, vectors
from lidarspec.testing.consistency import list_simulated_frames
from lidarspec.testing.findings import Finding, ViolationError
from lidarspec.testing.sensor_under_test import SensorUnderTest


def _no_points(subject: SensorUnderTest) -> str:
    if subject.sensor.has_points:
        return ""
    return "the sensor has no points"


def _no_sweep(subject: SensorUnderTest) -> str:
    if not subject.sensor.has_points:
        return _no_points(subject)
    names = subject.sensor.data_frames
    if not any(subject.sensor.simulation_of(name).sweep for name in names):
        return "the sensor cannot be simulated, because it declares no `sweep`"
    alone = [name for name in names if not get_codec(subject.sensor.frames[name]).is_compiled]
    if alone:
        return (
            "the sensor cannot be simulated, because these frame types are not compiled:"
            f" {', '.join(alone)}"
        )
    return ""


def _no_simulated_frames(subject: SensorUnderTest) -> str:
    if list_simulated_frames(subject.sensor):
        return ""
    if subject.sensor.has_points:
        return _no_sweep(subject)
    return "no frame type declares a `sweep` and a `rate`"


def _no_periodic_frames(subject: SensorUnderTest) -> str:
    if find_periodic_rates(subject.sensor):
        return ""
    return "no frame type without points declares a `rate`"


def _no_commands(subject: SensorUnderTest) -> str:
    if subject.sensor.commands:
        return ""
    return "the sensor has no commands"


def _no_device(subject: SensorUnderTest) -> str:
    has_replies = any(command.replies for command in subject.sensor.commands.values())
    if not has_replies:
        return "the sensor has no commands with a documented reply"
    if subject.sensor.has_points:
        return _no_sweep(subject)
    return ""


@dataclass(frozen=True)
class Property:
    """A property that every sensor must have.

    Attributes:
        function: raises an exception if the property does not hold. Its arguments are the subject
            and, unless `each` is "sensor", the name of a frame, data frame, command or vector.
        each: "sensor", "frame", "data" (a data frame), "periodic" (a frame type without points that
            the sensor sends periodically), "simulated" (a data frame or a periodic frame with a
            `sweep`), "command" or "vector": the function is called for each of these.
        rule: the code of the rule that is violated if the function raises a plain `AssertionError`.
        lacks: a function that returns the reason why the property does not apply to a sensor, or ""
            if it applies.
        unless: codes of other rules; if one of them is violated, the property is not tested.
        depends_on: attributes of a sensor that determine the result; related models with equal
            attributes are not tested again. If empty, each sensor is tested.
    """

    function: Callable[..., None]
    each: str
    rule: str
    lacks: Callable[[SensorUnderTest], str] = lambda subject: ""
    unless: tuple[str, ...] = ()
    depends_on: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The name of the property, which is the name of its function."""
        return self.function.__name__

    def cases(self, subject: SensorUnderTest) -> Iterable[tuple[str, ...]]:
        """Return, for each call of `function`, the arguments after `subject`."""
        if self._is_tested_elsewhere(subject):
            return []
        if self.each == "sensor":
            return [()]
        if self.each == "vector":
            return [(key,) for key in vectors.list_keys(subject)]
        names = {
            "frame": subject.frames,
            "data": subject.sensor.data_frames,
            "periodic": find_periodic_rates(subject.sensor),
            "simulated": list_simulated_frames(subject.sensor),
            "command": subject.commands,
        }
        return [(name,) for name in names[self.each]]

    def _is_tested_elsewhere(self, subject: SensorUnderTest) -> bool:
        """Return whether a related model that is also tested gives the same result."""
        if not self.depends_on:
            return False
        wanted = [getattr(subject.sensor, name) for name in self.depends_on]
        return any(
            wanted == [getattr(sensor, name) for name in self.depends_on]
            for sensor in subject.tested
        )

    def findings(
        self, subject: SensorUnderTest, watch: Callable[[str], None] = lambda text: None
    ) -> list[Finding]:
        """Return the findings of every case that fails.

        Args:
            watch: called with the name of each case before it begins.
        """
        findings = []
        for case in self.cases(subject):
            watch(" ".join((self.name, *case)))
            try:
                self.function(subject, *case)
            except ViolationError as error:
                file = ""
                if error.code == "LS702":  # the fault is in the file of vectors
                    file = str(subject.vectors)
                findings.append(
                    Finding(error.code, error.what, error.path, subject.sensor.id, file)
                )
            except AssertionError as error:
                reason = _find_first_line(error)
                findings.append(Finding(self.rule, reason, ".".join(case), subject.sensor.id))
            except SpecError as error:
                case_path = ".".join(case)
                path = error.path if error.path.startswith(case_path) else case_path
                findings.append(
                    Finding(error.rule or "LS414", error.reason, path, subject.sensor.id)
                )
            except Exception as error:
                findings.append(_make_unexpected_error(error, ".".join(case), subject))
        return findings


#: The rules that are violated if decoding a valid frame raises an exception.
FAILING_RULES = ("LS213", "LS214", "LS215", "LS216", "LS414")

#: Attributes of a sensor that determine the result of decoding a stream.
DECODING_ATTRIBUTES = (
    "frames",
    "datagrams",
    "main_frames",
    "options",
    "points",
    "clock",
    "sequence",
    "scan",
    "state",
)

PROPERTIES = (
    Property(frames.examples_are_valid_and_repeat, "frame", "LS301"),
    Property(frames.bytes_survive_parsing_and_building, "frame", "LS302"),
    Property(frames.every_raw_value_survives, "frame", "LS302", unless=("LS302", "LS303")),
    Property(frames.wrong_rebuild_values_are_invalid, "frame", "LS312", unless=("LS302", "LS303")),
    Property(
        frames.values_in_units_build_the_same_bytes, "frame", "LS304", unless=("LS302", "LS303")
    ),
    Property(
        frames.values_survive_building_and_parsing, "frame", "LS305", unless=("LS302", "LS303")
    ),
    Property(
        frames.the_start_of_a_frame_may_be_content,
        "frame",
        "LS313",
        unless=("LS301", "LS302", "LS303"),
    ),
    Property(frames.parse_finds_out_the_type, "frame", "LS306"),
    Property(frames.a_truncated_frame_is_a_wire_error, "frame", "LS307"),
    Property(frames.a_damaged_frame_is_at_worst_a_wire_error, "frame", "LS308"),
    Property(frames.every_single_bit_error_is_seen, "frame", "LS310"),
    Property(vectors.every_checksum_is_checked, "frame", "LS212"),
    Property(vectors.the_status_is_proven, "sensor", "LS710"),
    Property(
        vectors.vectors_hold,
        "vector",
        "LS706",
        lacks=vectors.describe_missing_vectors,
        unless=("LS216",),
    ),
    Property(
        vectors.every_data_field_is_pinned_down,
        "data",
        "LS711",
        lacks=vectors.describe_missing_vectors,
        unless=("LS702", "LS703", "LS707"),
    ),
    Property(
        vectors.points_stand_in_two_quadrants,
        "data",
        "LS712",
        lacks=vectors.describe_missing_vectors,
        unless=("LS702", "LS703", "LS707"),
    ),
    Property(
        geometry.clouds_keep_the_conventions,
        "data",
        "LS501",
        unless=("LS216",),
        depends_on=DECODING_ATTRIBUTES,
    ),
    Property(geometry.directions_are_radians, "data", "LS502", unless=FAILING_RULES),
    Property(
        geometry.a_single_point_has_a_direction,
        "data",
        "LS503",
        unless=FAILING_RULES,
        depends_on=DECODING_ATTRIBUTES,
    ),
    Property(
        geometry.the_full_circle_equals_zero,
        "data",
        "LS505",
        unless=(*FAILING_RULES, "LS503"),
        depends_on=DECODING_ATTRIBUTES,
    ),
    Property(
        geometry.the_points_turn_as_the_axes_do,
        "data",
        "LS511",
        unless=(*FAILING_RULES, "LS502"),
        depends_on=(*DECODING_ATTRIBUTES, "vendor_axes"),
    ),
    Property(
        geometry.angles_are_in_order,
        "data",
        "LS506",
        lacks=_no_sweep,
        unless=(*FAILING_RULES, "LS502"),
    ),
    Property(
        consistency.periodic_frames_can_be_simulated,
        "periodic",
        "LS508",
        lacks=_no_periodic_frames,
        unless=FAILING_RULES,
    ),
    Property(
        geometry.counters_run_on,
        "simulated",
        "LS509",
        lacks=_no_simulated_frames,
        unless=(*FAILING_RULES, "LS508"),
    ),
    Property(
        consistency.turned_angles_turn_the_points,
        "data",
        "LS504",
        lacks=_no_sweep,
        unless=(*FAILING_RULES, "LS502", "LS504", "LS506"),
    ),
    Property(
        consistency.the_clock_stays_below_its_wrap,
        "simulated",
        "LS512",
        lacks=_no_simulated_frames,
        unless=(*FAILING_RULES, "LS508", "LS509"),
    ),
    Property(
        consistency.sweep_values_fit_their_fields,
        "simulated",
        "LS514",
        lacks=_no_simulated_frames,
        unless=("LS508",),
    ),
    Property(
        consistency.times_of_points_fit_the_clock,
        "data",
        "LS513",
        lacks=_no_sweep,
        unless=(*FAILING_RULES, "LS509"),
    ),
    Property(
        streams.the_same_bytes_give_the_same_points,
        "sensor",
        "LS415",
        lacks=_no_points,
        unless=FAILING_RULES,
        depends_on=DECODING_ATTRIBUTES,
    ),
    Property(
        streams.a_clean_input_loses_nothing,
        "sensor",
        "LS401",
        unless=("LS216",),
        depends_on=DECODING_ATTRIBUTES,
    ),
    Property(
        streams.scans_do_not_depend_on_batches,
        "sensor",
        "LS404",
        lacks=_no_points,
        unless=(*FAILING_RULES, "LS415"),
        depends_on=DECODING_ATTRIBUTES,
    ),
    Property(
        geometry.a_simulated_scene_comes_back,
        "data",
        "LS507",
        lacks=_no_sweep,
        unless=("LS201", "LS218", *FAILING_RULES, "LS502", "LS415", "LS503"),
    ),
    Property(commands.a_command_parses_back, "command", "LS601", lacks=_no_commands),
    Property(commands.arguments_outside_ranges_are_errors, "command", "LS602", lacks=_no_commands),
    Property(commands.replies_can_match, "command", "LS603", lacks=_no_commands),
    Property(commands.replies_belong_to_one_command, "command", "LS606", lacks=_no_commands),
    Property(
        commands.the_simulated_sensor_answers,
        "command",
        "LS604",
        lacks=_no_device,
        unless=(*FAILING_RULES, "LS201", "LS508", "LS601", "LS603"),
    ),
)


def _find_first_line(error: BaseException) -> str:
    """Return the first line of an error's message that is not empty."""
    lines = (line for line in str(error).splitlines() if line.strip())
    return next(lines, type(error).__name__)


def _make_unexpected_error(error: Exception, path: str, subject: SensorUnderTest) -> Finding:
    """Return the finding for an undocumented exception."""
    locations = [
        location
        for location in traceback.extract_tb(error.__traceback__)
        if not _is_library_file(location.filename)
    ]
    location = locations[-1] if locations else None
    text = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
    return Finding(
        "LS308",
        text,
        path,
        subject.sensor.id,
        location.filename if location else "",
        (location.lineno or 0) if location else 0,
    )


def _is_library_file(file: str) -> bool:
    """Return whether a file belongs to the engine or one of its libraries."""
    package = Path(__file__).resolve().parents[1]
    return package in Path(file).parents or any(
        part in Path(file).parts for part in ("construct", "numpy", "hypothesis", "_pytest")
    )
