"""Tests of pictures in the terminal: orientation, scale, and uncovered points."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable

import numpy as np
import pytest

from lidarspec import PointCloud
from lidarspec.errors import UnknownName
from lidarspec.points.appearance import (
    RAMP_STEPS,
    CloudAppearance,
    choose_appearance,
    find_bounds,
    fit_to_points,
    list_ramps,
    ramp_positions,
    ring_step,
    round_up,
)
from lidarspec.view.canvas import BLANK, FIRST_STEP
from lidarspec.view.polar import draw_cloud

DOTS = {
    0x01: (0, 0),
    0x02: (1, 0),
    0x04: (2, 0),
    0x40: (3, 0),
    0x08: (0, 1),
    0x10: (1, 1),
    0x20: (2, 1),
    0x80: (3, 1),
}
FLAT = CloudAppearance("range", 5, 5)
TALL = CloudAppearance("range", 5, 5, flat=False)


def cloud(*xyz: tuple[float, float, float], intensity: Iterable[float] | None = None) -> PointCloud:
    x, y, z = np.array(xyz, np.float32).reshape(-1, 3).T
    zero = np.zeros(len(x), np.float32)
    strength = None if intensity is None else np.array(list(intensity), np.float32)
    elevation = np.arctan2(z, np.hypot(x, y))
    return PointCloud(
        x=x, y=y, z=z, range=np.hypot(x, y), azimuth=zero, elevation=elevation,
        time=zero.astype(float), valid=np.isfinite(x), intensity=strength,
    )  # fmt: skip


def draw_lines(
    points: PointCloud, look: CloudAppearance = FLAT, width: int = 60, height: int = 30
) -> list[str]:
    return draw_cloud(points, width=width, height=height, look=look).lines()


def dots(lines: Iterable[str]) -> set[tuple[int, int]]:
    """Return the (row, column) of every dot of braille characters.

    The bits of a character are its dots, in the order of Unicode.
    """
    found = set()
    for row, line in enumerate(lines):
        for column, character in enumerate(line):
            bits = ord(character) - BLANK
            if 0 < bits < 256:
                found |= {
                    (4 * row + down, 2 * column + across)
                    for bit, (down, across) in DOTS.items()
                    if bits & bit
                }
    return found


def of_points(points: PointCloud) -> set[tuple[int, int]]:
    """Return the dots that are drawn only with the points."""
    return dots(draw_lines(points)) - dots(draw_lines(points[:0]))


@pytest.mark.parametrize(
    ("point", "row", "column"),
    [
        ((4.1, 0, 0), -1, 0),
        ((0, 4.1, 0), 0, -1),
        ((-4.1, 0, 0), 1, 0),
        ((0, -4.1, 0), 0, 1),
        ((3, 3, 0), -1, -1),
    ],
)
def test_forward_is_up_and_left_is_left(
    point: tuple[float, float, float], row: int, column: int
) -> None:
    ((down, across),) = of_points(cloud(point))
    assert np.sign([round((down - 61) / 9), round((across - 61) / 9)]).tolist() == [row, column]


def test_a_circle_is_round() -> None:
    turn = np.linspace(0, 2 * np.pi, 2000)
    found = np.array(
        sorted(
            of_points(cloud(*zip(4.5 * np.cos(turn), 4.5 * np.sin(turn), 0 * turn, strict=True)))
        )
    )
    height, width = np.ptp(found, axis=0)
    assert abs(int(height) - int(width)) <= 1
    assert height == pytest.approx(2 * 4.5 / 5 * 59.5, abs=2)


def test_points_beyond_the_picture_are_not_drawn() -> None:
    assert of_points(cloud((7, 0, 0))) == set()
    for points in (cloud((7, 0, 0)), cloud(), cloud((1, 1, 1))):
        for chosen in (FLAT, TALL):
            assert [len(line) for line in draw_lines(points, chosen, 41, 13)] == [41] * 13


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (5, 2), (300, 4)])
def test_any_window_has_a_picture(size: tuple[int, int]) -> None:
    for chosen in (FLAT, TALL):
        assert [len(line) for line in draw_lines(cloud((1, 1, 1)), chosen, *size)] == [
            size[0]
        ] * size[1]


def test_rings_and_directions_are_named() -> None:
    lines = draw_lines(cloud())
    text = "\n".join(lines)
    assert "▲" in lines[15]
    assert all(label in text for label in ("2 m", "4 m", "0° forward", " -90°", "180°"))
    assert (ring_step(5), ring_step(8.1), ring_step(0.3), ring_step(100)) == (2, 5, 0.1, 50)


def test_a_label_hides_no_point() -> None:
    points = cloud(*((0, -y, 0) for y in np.linspace(0.3, 5, 200)))
    assert "2 m" in draw_lines(points[:0])[15]
    assert "2 m" not in draw_lines(points)[15]
    assert "2 m" in "".join(draw_lines(points))


def test_the_middle_can_be_elsewhere() -> None:
    points = cloud((9, 3, 0))
    assert (
        len(
            dots(draw_lines(points, CloudAppearance("range", 5, 5, middle=(8.5, 3.0))))
            - dots(draw_lines(points[:0], CloudAppearance("range", 5, 5, (8.5, 3.0))))
        )
        == 1
    )


def test_the_reach_takes_in_most_points_and_is_round() -> None:
    near = [(2.0 * np.cos(a), 2.0 * np.sin(a), 0.0) for a in np.linspace(0, 6.28, 500)]
    assert choose_appearance(cloud(*near)).reach == 2.0
    assert choose_appearance(cloud(*near, (90, 0, 0))).reach == 2.0
    assert choose_appearance(cloud()).reach == 1.0
    assert [round_up(value) for value in (0.011, 1.0, 1.01, 5.3, 99, 101)] == pytest.approx(
        [0.012, 1.0, 1.2, 6.0, 100.0, 120.0]
    )


@pytest.mark.parametrize("outliers", [0, 10])
@pytest.mark.parametrize("middle", [(0.0, 0.0), (60.0, -8.0)])
def test_a_fitted_picture_is_filled_by_98_percent_of_the_points(
    middle: tuple[float, float], outliers: int
) -> None:
    turn = np.linspace(0, 2 * np.pi, 600)
    x, y = middle[0] + 4 * np.cos(turn), middle[1] + 2.5 * np.sin(turn)
    points = cloud(*zip(x, y, 0 * x, strict=True), *[(500.0, 300.0, 20.0)] * outliers)
    plain = choose_appearance(points)
    fitted = fit_to_points(points, plain)
    assert fitted.middle == pytest.approx(middle, abs=0.2)
    assert 4 <= fitted.reach * 1.01 < 4 / 0.9
    assert (fitted.full, fitted.ramp) == (plain.full, plain.ramp)


def test_a_fitted_picture_shows_the_sensor_if_that_costs_little() -> None:
    across = np.linspace(-3, 3, 100)
    for x, forward in ((3.0, 1.5), (30.0, 30.0)):
        points = cloud(*((x, y, 0.0) for y in across))
        assert fit_to_points(points, choose_appearance(points)).middle[0] == pytest.approx(forward)
    empty = cloud()
    assert fit_to_points(empty, choose_appearance(empty)).middle == (0.0, 0.0)
    assert [ends.tolist() for ends in find_bounds(empty)] == [[0, 0, 0], [0, 0, 0]]


def test_colours_go_from_near_to_far_and_from_weak_to_strong() -> None:
    points = cloud((0.1, 0.1, 0), (3.4, 3.4, 0), intensity=(200, 1))
    for ramp, last in (("range", [0, RAMP_STEPS - 1]), ("intensity", [RAMP_STEPS - 1, 0])):
        inks = draw_cloud(
            points,
            width=60,
            height=30,
            look=CloudAppearance(ramp, 5, 4.8 if ramp == "range" else 200),
        ).inks
        steps = inks[inks >= FIRST_STEP] - FIRST_STEP
        assert steps.tolist()[::-1] == last  # the near one is further down


def test_without_intensity_colours_show_the_range() -> None:
    assert choose_appearance(cloud((1, 0, 0)), ramp="intensity").ramp == "range"
    assert choose_appearance(
        cloud((1, 0, 0), intensity=[7.0]), ramp="intensity"
    ) == CloudAppearance("intensity", 1.0, 8.0)


def test_the_side_view_has_the_same_scale_and_up_is_up() -> None:
    wall = [(4.0, y, z) for y in np.linspace(-2, 2, 100) for z in np.linspace(0, 3, 60)]
    lines = draw_lines(cloud(*wall), TALL, 60, 44)
    title = next(row for row, line in enumerate(lines) if "front at the right" in line)
    above, side = dots(lines[:title]), dots(lines[title + 1 :])
    column = most(column for _, column in side)
    line = most(row for row, _ in above)
    tall = [row for row, at in side if at == column]
    wide = [at for row, at in above if row == line]
    assert column > 60
    assert " x" not in lines[title]
    assert max(tall) - min(tall) == pytest.approx((max(wide) - min(wide)) * 3 / 4, abs=1)
    level = next(row for row, line in enumerate(lines[title + 1 :]) if "z 0 m" in line)
    assert abs(max(tall) // 4 - level) <= 1  # the wall stands on the height of the sensor


def test_small_heights_are_enlarged_with_a_note() -> None:
    lines = draw_lines(cloud(*((x, 0, 0.2) for x in np.linspace(-5, 5, 50))), TALL, 60, 30)
    assert any("heights x10" in line for line in lines)


def most(values: Iterable[int]) -> int:
    """Return the most frequent value."""
    return Counter(values).most_common(1)[0][0]


def test_colours_show_a_further_column_from_its_lowest_value_on() -> None:
    plain = cloud((1, 0, 0), (2, 0, 0), (3, 0, 0))
    points = dataclasses.replace(
        plain,
        extra={"velocity": np.array([-3.0, np.nan, 5.0], np.float32)},
        units={"velocity": "m/s"},
    )
    found = choose_appearance(points, ramp="velocity")
    assert (found.ramp, found.low, found.full, found.ends) == (
        "velocity",
        -3.0,
        5.0,
        ("-3", "5 m/s"),
    )
    assert ramp_positions(points, found).tolist() == [0.0, 0.0, 1.0]
    assert list_ramps(points) == ["range", "velocity"]
    with pytest.raises(UnknownName, match="did you mean 'velocity'"):
        choose_appearance(points, ramp="velocty")
