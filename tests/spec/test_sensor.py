"""Tests that a sensor is immutable and accepts only its declared options."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any, Literal, Optional

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.errors import PluginError
from tests.cli.running import ran
from tests.shapes import SHAPES


def configure(
    sensor: ls.Sensor,
    *,
    file: str | Path | None = None,
    turned: float = 0,
    mode: Optional[int] = None,  # noqa: UP045  plugins are written so too
    upside: bool = False,
    kind: Literal["a", "b"] = "a",
    plain=None,  # type: ignore[no-untyped-def]
) -> ls.Sensor:
    return sensor


@pytest.mark.parametrize("name", ["beams", "note"])
def test_no_attribute_of_a_sensor_can_be_set(name: str) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(SHAPES["shape-count"], name, 3)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"file": 1}, "file .*1"),
        ({"file": True}, "file .*True"),
        ({"file": ["a"]}, r"file .*\['a'\]"),
        ({"turned": "1"}, "turned .*'1'"),
        ({"turned": True}, "turned .*True"),
        ({"mode": 1.5}, "mode .*1.5"),
        ({"upside": 1}, "upside .*1"),
        ({"kind": "c"}, "kind must be 'a' or 'b', not 'c'"),
        ({"kind": 3}, "kind must be 'a' or 'b', not 3"),
        (
            {
                "file": None,
                "turned": 1,
                "mode": np.int64(3),
                "upside": True,
                "kind": "b",
                "plain": [1],
            },
            "",
        ),
        ({"file": Path("a"), "turned": np.float32(1), "mode": None}, ""),
    ],
)
def test_an_option_is_of_the_type_that_its_parameter_declares(
    options: dict[str, Any], named: str
) -> None:
    sensor = dataclasses.replace(SHAPES["shape-count"], configure=configure)
    if not named:
        assert sensor.configure(**options).options == options
        return
    with pytest.raises(ls.UsageError, match=f"shape-count: {named}"):
        sensor.configure(**options)


def configured_by(annotation: str) -> ls.Sensor:
    """Return a sensor with an option `table` of this type.

    The module of the option does not import the names in the annotation.
    """
    names: dict[str, Any] = {}
    exec(f"def typed(sensor: 'Sensor', *, table: {annotation!r}):\n    return sensor\n", names)
    return dataclasses.replace(SHAPES["shape-count"], configure=names["typed"])


def test_annotation_that_cannot_be_evaluated_names_the_option() -> None:
    with pytest.raises(ls.SpecError, match=r"configure\.table: .*'Table' is not defined"):
        configured_by("Table | None").configure(table=1)


def test_types_of_options_need_not_be_imported_by_the_plugin() -> None:
    sensor = configured_by("Path | None")
    assert sensor.configure.files == ("table",)
    with pytest.raises(ls.UsageError, match="table must be a path, not 1"):
        sensor.configure(table=1)


def test_on_the_command_line_a_digit_can_be_the_name_of_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("1").write_text("nothing of the kind", encoding="utf-8")
    Path("x.bin").touch()
    for name in ("1", "[" * 5000):  # which tomllib takes for a number, and for a list too deep
        said = ran("stats", "x.bin", "-s", "hesai-xt16", "-O", f"calibration={name}", code=2).stderr
        assert said.startswith(f"{name}: ")


def test_an_exception_of_configure_is_a_plugin_error(tmp_path: Path) -> None:
    (tmp_path / "heads.json").write_text("{nonsense", encoding="utf-8")
    with pytest.raises(PluginError, match=r"shape-headed: .*JSONDecodeError"):
        SHAPES["shape-headed"].configure(calibration=tmp_path / "heads.json")


@pytest.mark.skipif(os.name != "posix", reason="named pipes are POSIX")
def test_named_pipe_as_option_is_refused_before_it_is_opened(tmp_path: Path) -> None:
    os.mkfifo(pipe := tmp_path / "heads.json")
    with pytest.raises(ls.UsageError, match="expected a regular file, not a pipe or device"):
        SHAPES["shape-headed"].configure(calibration=pipe)
