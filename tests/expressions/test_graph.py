"""Tests of the graph of a traced function."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import lidarspec
from lidarspec.expressions.columns import Batch
from lidarspec.expressions.graph import (
    Node,
    compute,
    get_node,
    get_only_field,
    make_sample,
    split_condition,
    trace,
    traverse,
)
from lidarspec.points.evaluate import evaluate
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.spec import Fields, Polar, stack, take
from tests.agreement import assert_same_points

STL27L = lidarspec.sensor("ldrobot-stl27l")
PACKETS = STL27L.decode(b"".join(STL27L.example("data", seed=seed) for seed in range(5)))


def graph_of(function: Any) -> Node:
    node = get_node(trace(function, make_sample(PACKETS.batch(), PACKETS.table.groups[0]))[0])  # type: ignore[attr-defined]
    assert isinstance(node, Node)
    return node


def compute_node(node: Node, batch: Batch) -> Any:
    fields = Fields(batch)
    return compute(node, {}, lambda node: node.function(fields) if node.kind == "field" else None)


def test_a_field_that_is_read_twice_is_one_node() -> None:
    node = graph_of(lambda f: f.points.distance * 2 + f.points.distance)
    assert [(n.kind, n.path) for n in traverse(node) if n.kind == "field"] == [
        ("field", "points.distance")
    ]
    assert list(traverse(node, into=lambda n: n.kind != "call")) == [node]


def test_columns_and_arrays_give_equal_results() -> None:
    node = graph_of(
        lambda f: np.where(
            f.points.intensity > 100, f.points.distance + f.start_angle, f.end_angle % 7
        )
    )
    column = compute_node(node, PACKETS.batch())
    arrays = {
        "points.distance": PACKETS["points.distance"],
        "points.intensity": PACKETS["points.intensity"],
    }
    arrays |= {path: PACKETS[path][:, None] for path in ("start_angle", "end_angle")}
    np.testing.assert_array_equal(
        compute(node, {}, lambda node: arrays.get(node.path)), column.array
    )


@pytest.mark.parametrize(
    ("function", "path"),
    [
        (lambda f: np.sin(f.points.distance * 2) + 1, "points.distance"),
        (lambda f: take([1, 2, 3], f.points.intensity), "points.intensity"),
        (lambda f: (f.points.distance * 2).on("points"), "points.distance"),
        (lambda f: f.points.distance + f.points.intensity, None),
        (lambda f: f.points.distance * np.arange(12), None),
        (lambda f: stack(f.points.distance, f.points.distance), None),
    ],
)
def test_the_one_field_that_an_expression_is_made_of(function: Any, path: str | None) -> None:
    source = get_only_field(graph_of(function))
    assert (source.path if source is not None else None) == path


def test_combined_conditions_are_split() -> None:
    node = graph_of(lambda f: (f.start_angle < 360) & ((f.end_angle < 360) & (f.speed > 0)))
    assert [get_only_field(part).path for part in split_condition(node)] == [
        "start_angle",
        "end_angle",
        "speed",
    ]  # type: ignore[union-attr]


def echoes(f: Fields) -> Polar:
    angle = np.deg2rad(stack(f.points.intensity, f.points.intensity * 2))
    return Polar(range=stack(f.points.distance, f.points.distance * 2), azimuth=angle)


def test_one_field_beside_itself_has_points() -> None:
    packets = dataclasses.replace(STL27L, points=echoes).decode(
        b"".join(STL27L.example("data", seed=seed) for seed in range(5))
    )
    assert_same_points(evaluate(packets).cloud, evaluate_plainly(packets).cloud)


def test_a_test_of_plausibility_may_put_fields_side_by_side() -> None:
    frame = dataclasses.replace(
        STL27L.frames["data"],
        plausible=lambda f: stack(f.points.intensity, f.points.intensity) < 256,
    )
    sensor = dataclasses.replace(STL27L, frames={"data": frame})
    assert len(sensor.decode(STL27L.example("data") * 3)) == 3
