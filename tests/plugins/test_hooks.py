"""Tests of hooks: permitted changes, refused changes, isolated failures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pluggy
import pytest
from construct import Const, Int8ul, Struct

import lidarspec
from lidarspec import Sensor, SpecError
from lidarspec.plugins import Registry
from lidarspec.scans.stream import iter_scans
from lidarspec.spec import Checksummed, Fields, Frame, OnWrap, Polar, Serial, Sum, Xor, hookimpl
from tests.by_construct import reader
from tests.plugins.test_plugins import STRANGER
from tests.shapes import SHAPES


class Plugin:
    """A plugin object with the given hooks."""

    def __init__(self, **hooks: Any) -> None:
        for name, function in hooks.items():
            setattr(self, name, hookimpl(function))


@pytest.fixture
def registry() -> Registry:
    found = Registry()
    found.add(
        Plugin(lidarspec_sensors=lambda: [SHAPES["shape-count"], SHAPES["shape-nested"]]),
        name="shapes",
    )
    return found


def test_an_alias_names_the_same_sensor(registry: Registry) -> None:
    registry.add(Plugin(lidarspec_sensors=lambda: [lidarspec.sensor(STRANGER)]), name="acme")
    assert registry.sensor("acme-x1-lite") is registry.sensor("acme-x1")


def test_a_checksum_hook_replaces_the_algorithm_and_nothing_else(registry: Registry) -> None:
    plain = registry.sensor("shape-count").example("data", seed=1)
    registry.add(
        Plugin(
            lidarspec_checksum=lambda sensor, frame: Xor() if sensor.id == "shape-count" else None
        ),
        name="site",
    )
    hooked = registry.sensor("shape-count")
    built = hooked.build("data", hooked.parse(plain, verify=False))
    assert built[:-2] == plain[:-2]
    assert built[-2] == Xor()(plain[:-2])
    for backend in ("auto", "construct"):
        assert reader(hooked, backend).decode(built + plain).stats.frames == {"data": 1}
    assert SHAPES["shape-count"].parse(plain)
    untouched = registry.sensor("shape-nested")
    assert untouched.parse(untouched.example("data"))


def test_a_checksum_hook_supplies_a_missing_algorithm(registry: Registry) -> None:
    struct = Checksummed(
        Struct("header" / Const(b"\x99\x01"), "angle" / Int8ul, "sum" / Int8ul), field="sum"
    )
    open_ = Sensor(
        "open-sum",
        vendor="Open",
        model="Sum",
        frames={"data": Frame(struct, data=True, max_length=4)},
        points=lambda f: Polar(range=1, azimuth=f.angle),
        scan=OnWrap("azimuth"),
        links={"data": Serial(9600)},
        range_limits=(0, 1),
        status="manual",
        source="invented for the tests",
    )
    registry.add(Plugin(lidarspec_sensors=lambda: [open_]), name="open")
    with pytest.raises(SpecError, match="lidarspec_checksum"):
        registry.sensor("open-sum").build("data", angle=5)
    registry.add(
        Plugin(
            lidarspec_checksum=lambda sensor, frame: Sum(8) if sensor.id == "open-sum" else None
        ),
        name="sums",
    )
    sensor = registry.sensor("open-sum")
    assert sensor.build("data", angle=5) == b"\x99\x01\x05\x9f"
    assert len(sensor.decode(sensor.build("data", angle=5) * 3)) == 3


def test_a_points_hook_replaces_the_own_function(registry: Registry) -> None:
    plain = registry.sensor("shape-count")
    data = plain.example("data", seed=1)
    own = plain.decode(data).points()

    def answer(sensor: Sensor, fields: Fields) -> Polar | None:
        if sensor.id != "shape-count":
            return None
        return Polar(range=fields.samples.distance * 2, azimuth=0.5)

    registry.add(Plugin(lidarspec_points=answer), name="site")
    found = registry.sensor("shape-count").decode(data).points()
    np.testing.assert_allclose(found.range[own.valid], 2 * own.range[own.valid], rtol=1e-6)
    assert set(found.azimuth.tolist()) == {0.5}
    nested = registry.sensor("shape-nested")
    frame = nested.example("data")
    np.testing.assert_array_equal(
        nested.decode(frame).points().x, SHAPES["shape-nested"].decode(frame).points().x
    )


def test_a_hook_that_fails_is_a_spec_error_of_its_sensor(registry: Registry) -> None:
    def failing(sensor: Sensor, fields: Any) -> Any:
        raise RuntimeError("the site's file is gone")

    registry.add(Plugin(lidarspec_points=failing), name="site")
    sensor = registry.sensor("shape-count")
    packets = sensor.decode(sensor.example("data"))
    with pytest.raises(SpecError, match="the site's file is gone"):
        packets.points()
    with pytest.warns(UserWarning, match="the site's file is gone"):
        assert list(sensor.scans(sensor.example("data"))) == []
    assert list(iter_scans(sensor, [packets])) == []
    assert packets.stats.plugin_errors == 1
    assert "the site's file is gone" in packets.stats.tracebacks[0]


@pytest.mark.parametrize(
    "answer",
    [lambda sensor, frame: 1 / 0, lambda sensor, frame: "crc"],
    ids=["raises", "no checksum"],
)
def test_a_checksum_hook_that_fails_disturbs_no_sensor(registry: Registry, answer: Any) -> None:
    before = registry.sensor("shape-count").example("data", seed=1)
    registry.add(Plugin(lidarspec_checksum=answer), name="site")
    assert registry.sensors().keys() == {"shape-count", "shape-nested"}
    assert registry.sensor("shape-count").example("data", seed=1) == before


def test_a_refused_plugin_leaves_no_trace(registry: Registry) -> None:
    before = registry.sensors().keys()
    twice = [SHAPES["shape-bits"], SHAPES["shape-count"], SHAPES["shape-count"]]
    broken = Plugin(lidarspec_sensors=lambda: twice, lidarspec_points=lambda sensor, fields: 1 / 0)
    with pytest.raises(SpecError, match="shape-count"):
        registry.add(broken, name="late")
    assert registry.sensors().keys() == before
    registry.add(Plugin(), name="another")  # hooks are applied anew
    sensor = registry.sensor("shape-count")
    assert len(sensor.decode(sensor.example("data")).points())


def test_a_misspelt_hook_is_refused_by_name(registry: Registry) -> None:
    class Misspelt:
        @hookimpl
        def lidarspec_point(self) -> None:
            """Never called."""

    with pytest.raises(SpecError, match="unknown hook 'lidarspec_point'"):
        registry.add(Misspelt(), name="misspelt")


def test_every_hook_has_its_documentation() -> None:
    from lidarspec import plugins as hookspecs

    manager = pluggy.PluginManager(hookspecs.NAMESPACE)
    manager.add_hookspecs(hookspecs)
    hooks = [name for name in dir(manager.hook) if name.startswith("lidarspec_")]
    assert len(hooks) == 8
    assert all(getattr(hookspecs, name).__doc__ for name in hooks)
