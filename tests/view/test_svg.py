"""Tests of a cloud as SVG: it fills the picture, and labels do not overlap."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from lidarspec.points.appearance import choose_appearance, fit_to_points
from lidarspec.view.svg import SIDE_PX, svg
from tests.view.test_polar import cloud

#: pixels above the base line of a text, and of a character, at least.
HEIGHT, CHARACTER = 10, 6
NAMESPACE = "{http://www.w3.org/2000/svg}"


def walls(forward: float, left: float) -> list[tuple[float, float, float]]:
    """Return a room of 8 by 5 metres, not centred on the sensor."""
    turn = np.linspace(0, 2 * np.pi, 400)
    larger = np.maximum(abs(np.cos(turn)), abs(np.sin(turn)))
    height = np.tile(np.linspace(-1, 1, 16), 25)
    return list(
        zip(
            forward + 4 * np.cos(turn) / larger,
            left + 2.5 * np.sin(turn) / larger,
            height,
            strict=True,
        )
    )


@pytest.mark.parametrize("middle", [(0, 0), (4.2, 1), (90, -30)])
def test_labels_are_whole_and_apart(middle: tuple[float, float]) -> None:
    points = cloud(*walls(*middle))
    for view in ET.fromstring(
        svg(points, fit_to_points(points, choose_appearance(points)), "title")
    ).iter(f"{NAMESPACE}svg"):
        if view.get("x") is None:  # the whole picture
            continue
        _, top, width, height = (float(part) for part in view.attrib["viewBox"].split())
        boxes = []
        for text in view.iter(f"{NAMESPACE}text"):
            left, base, name = float(text.attrib["x"]), float(text.attrib["y"]), str(text.text)
            if text.get("text-anchor") == "end":
                left -= CHARACTER * len(name)
            boxes.append((left, base - HEIGHT, left + CHARACTER * len(name), base, name))
        assert any(box[4].endswith(" m") for box in boxes)
        assert len({box[4] for box in boxes}) == len(boxes)
        for number, box in enumerate(boxes):
            assert box[0] >= 0, box
            assert box[2] <= width, box
            assert top <= box[1], box
            assert box[3] <= top + height + 1, box
            for other in boxes[number + 1 :]:
                is_apart = (
                    box[2] < other[0] or other[2] < box[0] or box[3] < other[1] or other[3] < box[1]
                )
                assert is_apart, (box, other)


def test_a_few_far_points_do_not_shrink_the_picture() -> None:
    points = cloud(*walls(30, 5), *[(900.0, 700.0, 50.0)] * 4)
    picture = svg(points, fit_to_points(points, choose_appearance(points)), "title").partition(
        "side view"
    )[0]
    (scale,) = re.findall(r"scale\(([\d.]+)\)", picture)
    found = []
    for path in re.findall(r' d="([^"]*h0)"', picture):
        moves = [
            (int(across), int(down)) for across, down in re.findall(r"m(-?\d+) (-?\d+)h0", path)
        ]
        found.append(np.cumsum(moves, axis=0) * float(scale))
    assert np.ptp(np.concatenate(found), axis=0).max() > 0.88 * SIDE_PX
