"""Tests that `check` reports each broken plugin's mistake by its rule, and no other."""

from __future__ import annotations

from pathlib import Path

import pytest

from lidarspec.testing.check import find_target, iter_reports
from lidarspec.testing.findings import Finding

HERE = Path(__file__).resolve().parents[1] / "broken"

#: mistakes that the authors of parsers make, as a plugin can make them.
USUAL = {
    "int_for_round": {"LS106"},
    "count_unguarded": {"LS503"},
    "no_wrap": {"LS504"},
    "full_circle": {"LS505"},
    "by_vectors/wrong_span": {"LS703"},
    "by_vectors/wrong_order": {"LS704"},
    "by_vectors/unsigned": {"LS705"},
    "swallowed_in_plausible": {"LS801"},
    "wall_clock": {"LS802", "LS415"},
    "clock_without_wrap": {"LS509"},
    "counter_without_wrap": {"LS510"},
    "short_write": {"LS803"},
}
#: where construct bites.
CONSTRUCT = {
    "this_decides": {"LS804"},
    "plausible_expression": {"LS207"},
    "hasattr_this": {"LS805"},
    "sizeof_if": {"LS008"},
    "bare_const": {"LS114"},
    "shadowed_name": {"LS101"},
    "reserved_name": {"LS102"},
    "leading_underscore": {"LS103"},
    "duplicate_names": {"LS104"},
    "unnamed": {"LS105"},
    "union": {"LS109"},
    "flag": {"LS107"},
    "slicing": {"LS106"},
    "flags_enum": {"LS108"},
    "pickled": {"LS110"},
    "greedy_range": {"LS111"},
    "greedy_bytes": {"LS111"},
    "pointer": {"LS112"},
    "optional": {"LS113"},
    "bare_errors": {"LS308"},
    "lambda_raises": {"LS115", "LS116"},
    "code_by_number": {"LS117"},
}
#: where pluggy bites, and what else keeps a plugin from being loaded.
PLUGGY = {
    "misspelt_hook": {"LS002"},
    "unmarked_hook": {"LS003"},
    "wrong_signature": {"LS004"},
    "duplicate_id": {"LS005"},
    "raising_hook": {"LS006"},
    "no_sensors": {"LS006"},
    "not_importable": {"LS001"},
    "exits": {"LS001"},
    "bad_id": {"LS007"},
    "no_longest_length": {"LS009"},
    "raising_checksum_hook": {"LS010"},
}
#: what is wrong in a declaration, its points and its commands.
DECLARED = {
    "missing_unit": {"LS201"},
    "empty_unit": {"LS201"},
    "unknown_unit": {"LS201"},
    "scaled_swapped": {"LS007"},
    "missing_source": {"LS202"},
    "longest_length_wrong": {"LS203"},
    "longest_length_far": {"LS203"},
    "common_sync": {"LS204"},
    "uncovered_field": {"LS205"},
    "no_plausible": {"LS206"},
    "checksum_not_verified": {"LS212"},
    "untraceable": {"LS208"},
    "acknowledges_nothing": {"LS209"},
    "out_of_reach": {"LS210"},
    "interpreted": {"LS116"},
    "no_such_flag": {"LS216"},
    "clock_without_unit": {"LS216"},
    "and_in_plausible": {"LS213"},
    "and_in_points": {"LS213"},
    "without_parentheses": {"LS213"},
    "off_by_one": {"LS214"},
    "folded_times": {"LS215"},
    "no_example": {"LS301"},
    "not_held": {"LS312"},
    "blind_checksum": {"LS310"},
    "points_fail": {"LS414"},
    "with_memory": {"LS415"},
    "degrees": {"LS502"},
    "bare_coordinates": {"LS201", "LS502"},
    "against_its_axes": {"LS511"},
    "sweep_of_nothing": {"LS508"},
    "sweep_off_by_one": {"LS508"},
    "periodic_sweep_of_nothing": {"LS508"},
    "sweep_in_raw_steps": {"LS514"},
    "wrap_too_early": {"LS512"},
    "wrap_too_late": {"LS509"},
    "times_in_milliseconds": {"LS513"},
    "no_wrap_aligned": {"LS504"},
    "option_unread": {"LS217"},
    "option_ignored": {"LS217"},
    "intensity_of_distance": {"LS218"},
    "code_for_range": {"LS219"},
    "unknown_field": {"LS601"},
    "reply_without_field": {"LS603"},
    "silent_command": {"LS604"},
    "shared_reply": {"LS606"},
    "by_vectors/wrong_value": {"LS706"},
    "by_vectors/wrong_header": {"LS707"},
    "by_vectors/turned": {"LS708"},
    "by_vectors/mirrored": {"LS709"},
}
EVERY = USUAL | CONSTRUCT | PLUGGY | DECLARED
#: those of the quick tier: what keeps a plugin from being loaded, and one of each kind of property.
QUICK = {
    *PLUGGY,
    "by_vectors/wrong_order",
    "lambda_raises",
    "shadowed_name",
    "silent_command",
}
#: mistakes in a module's own text: the line that is named has these words.
LINES = {
    "shadowed_name": "items",
    "missing_unit": '"distance" / Int16ul',
    "no_wrap": "def points",
    "wall_clock": "time.time()",
    "short_write": "os.write",
    "this_decides": "this.count == 1",
    "swallowed_in_plausible": "except Exception",
    "degrees": "def points",
    "sweep_of_nothing": "def sweep",
    "sweep_off_by_one": "def sweep",
    "periodic_sweep_of_nothing": "def periodic_sweep",
    "not_importable": "import a_library",
    "no_longest_length": "Frame(make_frame()",
    "bare_const": '"order": Frame(',
}


def check_module(name: str) -> list[Finding]:
    """Return the findings of `check` for one of the modules."""
    file = HERE / f"{name}.py"
    return [
        finding
        for report in iter_reports(find_target(file), str(file), examples=4)
        for finding in report.findings
    ]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in EVERY]
)
def test_the_mistake_is_named_and_no_other(name: str) -> None:
    findings = check_module(name)
    assert {finding.code for finding in findings} == EVERY[name], "\n".join(map(str, findings))
    if name in LINES:
        spots = [finding for finding in findings if finding.file]
        assert spots
        assert any(
            LINES[name] in Path(spot.file).read_text(encoding="utf-8").splitlines()[spot.line - 1]
            for spot in spots
        )


@pytest.mark.parametrize(
    "name", ["sound", pytest.param("by_vectors/sound", marks=pytest.mark.slow)]
)
def test_without_a_mistake_nothing_is_found(name: str) -> None:
    assert check_module(name) == []


def test_every_module_is_in_the_list() -> None:
    modules = {str(file.relative_to(HERE).with_suffix("")) for file in HERE.rglob("*.py")}
    helpers = {"__init__", "by_vectors/__init__", "sound", "by_vectors/sound"}
    assert {name.replace("\\", "/") for name in modules} - helpers == EVERY.keys()
