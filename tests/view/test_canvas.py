"""Tests of the canvas: braille dots, labels, ASCII, and updates of a terminal."""

from __future__ import annotations

import re

import numpy as np
import pytest

from lidarspec.points.appearance import RAMP_STEPS
from lidarspec.view.canvas import (
    ALARM,
    BLANK,
    FAINT,
    FIRST_STEP,
    INKS,
    PLAIN,
    Canvas,
    CellGrid,
    sgr,
    style,
)
from lidarspec.view.terminal_screen import encode_changes
from tests.view.test_polar import DOTS


@pytest.mark.parametrize(("bit", "place"), list(DOTS.items()))
def test_each_dot_has_its_bit(bit: int, place: tuple[int, int]) -> None:
    canvas = Canvas(1, 1)
    canvas.plot(np.array([place[1] + 0.5]), np.array([place[0] + 0.5]), np.array([0.0]))
    assert canvas.cells().lines() == [chr(BLANK + bit)]


def test_texts_of_others_steer_no_terminal() -> None:
    cells = CellGrid.blank(16, 1)
    cells.write(0, 0, "a\x1b[2J\u202eb\n")
    assert cells.lines() == [r"a\x1b[2J\u202eb "]


def test_the_canvas_sets_single_dots_and_labels_around_them() -> None:
    canvas = Canvas(2, 1)
    canvas.plot(np.array([3.2]), np.array([2.9]), np.array([0.5]))
    assert canvas.cells().lines() == [f" {chr(BLANK + 0x20)}"]
    assert not canvas.label(0, 1, "x")
    assert canvas.label(0, 0, "x")
    assert not canvas.label(0, 0, "y")
    assert canvas.label(0, 1, "z", over=True)
    assert canvas.cells().lines() == ["xz"]


@pytest.mark.parametrize("where", [(-1, 0), (0, -1), (1, 0), (0, 2)])
def test_points_outside_are_not_drawn(where: tuple[int, int]) -> None:
    canvas = Canvas(2, 1)
    canvas.plot(np.array([where[1] * 2.0]), np.array([where[0] * 4.0]), np.array([0.0]))
    assert not canvas.label(*where, "x")
    assert canvas.cells().lines() == ["  "]


def test_the_nearest_and_the_strongest_point_colour_a_cell() -> None:
    for ramp, step in (("range", 2), ("intensity", 16)):
        canvas = Canvas(1, 1, ramp)
        canvas.plot(np.zeros(3), np.zeros(3), np.array([0.3, 0.1, 0.8]))
        assert canvas.cells().inks.tolist() == [[FIRST_STEP + step]]


def test_writing_and_pasting_stay_inside() -> None:
    cells, small = CellGrid.blank(4, 2), CellGrid.blank(3, 3)
    small.write(0, 0, "abc", ALARM)
    cells.paste(1, 2, small)
    cells.write(0, -1, "xyz")
    cells.write(5, 0, "never")
    assert cells.lines() == ["yz  ", "  ab"]
    assert cells.inks[1].tolist() == [PLAIN, PLAIN, ALARM, ALARM]


def test_ascii_keeps_the_density_of_dots() -> None:
    cells = CellGrid.blank(5, 1)
    cells.write(0, 0, f"{chr(BLANK + 1)}{chr(BLANK + 255)}▲°e")
    assert cells.ascii().lines() == [".#^de"]


def emulate_terminal(before: list[str], text: str) -> list[str]:
    """Return the screen of a terminal after some output.

    Supports cursor addressing and characters according to ECMA-48.
    """
    grid = [list(line) for line in before]
    row = column = 0
    for address, _, character in re.findall(r"\x1b\[(\d+;\d+)H|(\x1b\[[0-9;]*m)|(.)", text):
        if address:
            row, column = (int(part) - 1 for part in address.split(";"))
        elif character:
            grid[row][column] = character
            column += 1
    return ["".join(line) for line in grid]


def test_changes_bring_a_terminal_from_picture_to_picture() -> None:
    source = np.random.default_rng(4)
    before = CellGrid.blank(30, 8)
    for _ in range(50):
        after = CellGrid(before.codes.copy(), before.inks.copy())
        for _ in range(source.integers(0, 30)):
            after.write(
                int(source.integers(8)),
                int(source.integers(30)),
                chr(source.integers(33, 126)),
                int(source.integers(3)),
            )
        text = encode_changes(before, after, "256")
        assert emulate_terminal(before.lines(), text) == after.lines()
        before = after


def test_only_what_changed_is_written() -> None:
    before, after = CellGrid.blank(80, 24), CellGrid.blank(80, 24)
    assert encode_changes(before, after, "truecolor") == ""
    after.write(3, 7, "x", ALARM)
    assert encode_changes(before, after, "none") == "\x1b[4;8H\x1b[0;1mx"
    recoloured = CellGrid(after.codes, np.zeros_like(after.inks))
    assert encode_changes(after, recoloured, "none") == "\x1b[4;8H\x1b[0mx"


def test_colours_match_the_terminal() -> None:
    assert sgr(FIRST_STEP, "truecolor") == "\x1b[0;38;2;99;92;173m"
    assert sgr(FIRST_STEP, "256") == "\x1b[0;38;5;61m"
    assert sgr(FIRST_STEP, "standard") == "\x1b[0;94m"
    assert sgr(FIRST_STEP, "none") == "\x1b[0m"
    assert sgr(FAINT, "none") == "\x1b[0;2m"
    assert style(FIRST_STEP) == "#635cad"
    steps = range(FIRST_STEP, FIRST_STEP + RAMP_STEPS)
    assert len({sgr(step, "truecolor") for step in steps}) == RAMP_STEPS
    assert len({sgr(step, "standard") for step in steps}) == 4
    assert all("38;2" not in sgr(ink, "256") for ink in range(len(INKS)))
