"""Pictures in the terminal: the right way round, to scale, with nothing in the way of a point."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np
import pytest

from lidarspec import PointCloud
from lidarspec.view.canvas import BLANK, Canvas
from lidarspec.view.polar import polar, polar_text, ring_step, top_side

DOTS = {0x01: (0, 0), 0x02: (1, 0), 0x04: (2, 0), 0x40: (3, 0), 0x08: (0, 1), 0x10: (1, 1), 0x20: (2, 1), 0x80: (3, 1)}


def cloud(*xyz: tuple[float, float, float]) -> PointCloud:
    x, y, z = np.array(xyz, np.float32).reshape(-1, 3).T
    zero = np.zeros(len(x), np.float32)
    return PointCloud(x=x, y=y, z=z, range=np.hypot(x, y), azimuth=zero, elevation=zero, time=zero.astype(float), valid=np.isfinite(x))


def dots(picture: str) -> set[tuple[int, int]]:
    """(row, column) of every dot, by the bits of the characters as Unicode numbers them."""
    found = set()
    for row, line in enumerate(picture.splitlines()):
        for column, character in enumerate(line):
            bits = ord(character) - BLANK
            if 0 < bits < 256:
                found |= {(4 * row + down, 2 * column + across) for bit, (down, across) in DOTS.items() if bits & bit}
    return found


def of_points(points: PointCloud, **more: float) -> set[tuple[int, int]]:
    """The dots that are not there without the points."""
    empty = polar(points[:0], width=60, height=30, max_range=more.get("max_range", 5))
    return dots(polar(points, width=60, height=30, max_range=more.get("max_range", 5))) - dots(empty)


@pytest.mark.parametrize(
    ("point", "row", "column"),
    [((4.1, 0, 0), -1, 0), ((0, 4.1, 0), 0, -1), ((-4.1, 0, 0), 1, 0), ((0, -4.1, 0), 0, 1), ((3, 3, 0), -1, -1)],
)
def test_forward_is_up_and_left_is_left(point: tuple[float, float, float], row: int, column: int) -> None:
    ((down, across),) = of_points(cloud(point))
    assert np.sign([round((down - 61) / 9), round((across - 61) / 9)]).tolist() == [row, column]


def test_a_circle_is_round() -> None:
    turn = np.linspace(0, 2 * np.pi, 2000)
    found = np.array(sorted(of_points(cloud(*zip(4.5 * np.cos(turn), 4.5 * np.sin(turn), 0 * turn, strict=True)))))
    height, width = np.ptp(found, axis=0)
    assert abs(int(height) - int(width)) <= 1
    assert height == pytest.approx(2 * 4.5 / 5 * 59.5, abs=2)


def test_points_beyond_the_range_are_left_out_and_the_picture_keeps_its_size() -> None:
    assert of_points(cloud((7, 0, 0))) == set()
    for picture in (polar(cloud((7, 0, 0)), width=41, height=13, max_range=5), polar(cloud(), width=41, height=13)):
        assert [len(line) for line in picture.splitlines()] == [41] * 13


def test_rings_bear_their_range() -> None:
    picture = polar(cloud(), width=60, height=30, max_range=5)
    assert "^" in picture
    assert "2 m" in picture
    assert "4 m" in picture
    assert (ring_step(5), ring_step(8.1), ring_step(0.3), ring_step(100)) == (2, 5, 0.1, 50)


def test_a_label_hides_no_point() -> None:
    points = cloud(*((0, -y, 0) for y in np.linspace(0, 5, 200)))
    with_points = polar(points, width=60, height=30, max_range=5).splitlines()[15]
    assert "m" not in with_points
    assert "2 m" in polar(points, width=60, height=30, max_range=5)


def test_a_few_far_points_do_not_shrink_the_picture() -> None:
    near = [(2.0 * np.cos(a), 2.0 * np.sin(a), 0.0) for a in np.linspace(0, 6.28, 500)]
    assert polar(cloud(*near, (90, 0, 0)), width=60, height=30) == polar(cloud(*near), width=60, height=30)


def test_colours_go_from_near_to_far_and_plain_text_has_none() -> None:
    text = polar_text(cloud((0.5, 0.5, 0), (4.5, 0, 0)), width=60, height=30, max_range=5)
    assert {"bright_red", "magenta"} <= {str(span.style) for span in text.spans}
    assert "\x1b" not in text.plain


def test_the_side_view_has_the_same_scale_and_up_is_up() -> None:
    wall = [(4.0, y, z) for y in np.linspace(-2, 2, 100) for z in np.linspace(0, 2, 60)]
    above, side = top_side(cloud(*wall), width=60, height=44, max_range=5).split("from the right, forward is right\n")
    column = most(column for _, column in dots(side))
    line = most(row for row, _ in dots(above))
    tall = [row for row, at in dots(side) if at == column]
    wide = [at for row, at in dots(above) if row == line]
    assert column > 60
    assert max(tall) - min(tall) == pytest.approx((max(wide) - min(wide)) / 2, abs=1)


def most(values: Iterable[int]) -> int:
    """The most frequent value."""
    return Counter(values).most_common(1)[0][0]


@pytest.mark.parametrize(("bit", "place"), list(DOTS.items()))
def test_each_dot_has_its_bit(bit: int, place: tuple[int, int]) -> None:
    canvas = Canvas(1, 1)
    canvas.plot(np.array([place[1] + 0.5]), np.array([place[0] + 0.5]), np.array([0.0]))
    assert canvas.text().plain == chr(BLANK + bit)


def test_the_canvas_sets_single_dots() -> None:
    canvas = Canvas(2, 1)
    canvas.plot(np.array([3.2]), np.array([2.9]), np.array([0.5]))
    assert canvas.text().plain == f" {chr(BLANK + 0x20)}"
    assert not canvas.label(0, 1, "x")
    assert canvas.label(0, 0, "x")
    assert not canvas.label(0, 0, "y")
    assert canvas.text().plain == f"x{chr(BLANK + 0x20)}"
