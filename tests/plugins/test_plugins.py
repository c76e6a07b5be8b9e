"""Tests of sensors from files and other distributions, and of finding them by name."""

from __future__ import annotations

import pickle
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import lidarspec
from lidarspec import SourceError, SpecError, UsageError
from lidarspec.entry_points import GROUP, SENSORS, entry_points
from lidarspec.errors import UnknownSensor
from lidarspec.plugins import Registry, import_file, use_registry
from lidarspec.testing import SensorConformance
from tests.plugins.test_installed import distribution

HERE = Path(__file__).resolve().parents[1] / "shapes"
STRANGER = HERE / "stranger" / "acme_lidars.py"


def test_sensor_of_a_foreign_distribution_is_found_and_decodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The registry of this process is made before the stranger is on the path.
    lidarspec.sensor("ldrobot-stl27l")
    shutil.copy(STRANGER, tmp_path)
    distribution(tmp_path, "acme_lidars", "3.2.1", "[lidarspec]\nacme = acme_lidars\n")
    monkeypatch.syspath_prepend(tmp_path)
    with use_registry(Registry(entry_points(GROUP), entry_points(SENSORS))) as registry:
        sensor = lidarspec.sensor("acme-x1")
        assert len(sensor.decode(sensor.example("data"))) == 1
        (plugin,) = [one for one in registry.plugins if one.distribution == "acme_lidars"]
        assert (plugin.version, plugin.sensors, plugin.error) == ("3.2.1", ("acme-x1",), "")
        assert lidarspec.sensor("ldrobot-stl27l").id == "ldrobot-stl27l"


@pytest.mark.slow
class TestStranger(SensorConformance):
    """Tests of the sensor of another author, loaded from its file."""

    sensor = STRANGER
    examples = 4


def test_the_third_party_sensor_uses_all_mechanisms(tmp_path: Path) -> None:
    sensor = lidarspec.sensor(STRANGER)
    samples = [dict(distance=1000, row=row, quality=9) for row in range(4)]
    data = b"".join(sensor.build("data", start=start, samples=samples) for start in (0, 1000, 2000))
    cloud = sensor.decode(data).points()
    assert bool(cloud.nominal)
    np.testing.assert_allclose(np.rad2deg(cloud.azimuth), -np.arange(12) * 2.5, atol=1e-4)
    np.testing.assert_allclose(np.rad2deg(cloud.elevation[:4]), [-1.5, -0.5, 0.5, 1.5], atol=1e-5)
    turned = sensor.decode(sensor.build("mount", zero=500) + data).points()
    assert not turned.nominal
    np.testing.assert_allclose(np.rad2deg(turned.azimuth), 5 - np.arange(12) * 2.5, atol=1e-4)
    file = tmp_path / "elevations.txt"
    file.write_text("-10 0 10 20", encoding="utf-8")
    np.testing.assert_allclose(
        np.rad2deg(sensor.configure(calibration=file).decode(data).points().elevation[:4]),
        [-10, 0, 10, 20],
        atol=1e-5,
    )
    with pytest.raises(UsageError, match="not a file of elevations"):
        sensor.configure(calibration=tmp_path / "none.txt")
    assert sensor.parse(sensor.command("spin", rate=10.0)).rate == 100


def test_a_file_of_another_kind_is_no_sensor(tmp_path: Path) -> None:
    (file := tmp_path / "readme.txt").write_text("hello", encoding="utf-8")
    with pytest.raises(lidarspec.SourceError, match=r"readme\.txt is not a Python file"):
        lidarspec.sensor(str(file))


def test_a_file_with_several_sensors_asks_which(tmp_path: Path) -> None:
    file = tmp_path / "two.py"
    text = STRANGER.read_text(encoding="utf-8").replace(
        "return [X1]", "return [X1, dataclasses.replace(X1, id='acme-x2', aliases=())]"
    )
    file.write_text(text, encoding="utf-8")
    assert lidarspec.sensor(f"{file}:acme-x2").id == "acme-x2"
    with pytest.raises(UsageError, match=r"two.py:acme-x1, .*two.py:acme-x2"):
        lidarspec.sensor(file)
    with pytest.raises(UnknownSensor):
        lidarspec.sensor(f"{file}:acme-x3")


def test_a_file_that_is_no_sensor_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such file"):
        lidarspec.sensor(tmp_path / "none.py")
    file = tmp_path / "mine.py"
    for text, message in {
        "import a_library_that_nobody_has": "a_library_that_nobody_has",
        "def broken(:": "SyntaxError",
        "raise SystemExit(3)": "SystemExit",
        "": "the file declares no sensors",
        (
            "from lidarspec.spec import hookimpl\n@hookimpl\n"
            "def lidarspec_sensors():\n    return [1 / 0]"
        ): "ZeroDivisionError",
    }.items():
        file.write_text(text, encoding="utf-8")
        with pytest.raises(SpecError, match=message):
            lidarspec.sensor(str(file))


def test_a_relative_file_needs_no_more_than_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(STRANGER, tmp_path / "x.py")
    monkeypatch.chdir(tmp_path)
    assert lidarspec.sensor("./x.py").id == lidarspec.sensor("x.py").id == "acme-x1"


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("ldrobot-stl27", "'ldrobot-stl27l'"),
        ("LDROBOT-LD006", "'ldrobot-ld06'"),
        ("ld006", "'ldrobot-ld06'"),
        ("xt", "'hesai-xt16', 'hesai-xt32' or 'hesai-xt32m'"),
        ("helios", "'robosense-helios16p', 'robosense-helios32' or 'robosense-helios5515'"),
        ("VLP", "'velodyne-vlp16', 'velodyne-vlp32c' or 'velodyne-puck-hi-res'"),
    ],
)
def test_an_unknown_sensor_suggests_those_with_this_part_or_the_closest(
    name: str, meant: str
) -> None:
    with pytest.raises(UnknownSensor, match=rf"did you mean {meant}\?$"):
        lidarspec.sensor(name)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        *(
            ("ld19", "ldrobot-ld06"),
            ("LD06", "ldrobot-ld06"),
            ("STL-27L", "ldrobot-stl27l"),
            ("rplidar", "slamtec-rplidar-a1"),
        ),
        *(
            ("Puck", "velodyne-vlp16"),
            ("vlp_16", "velodyne-vlp16"),
            ("PandarXT-32", "hesai-xt32"),
            ("helios16p", "robosense-helios16p"),
        ),
    ],
)
def test_a_sensor_is_known_by_the_names_that_people_use(name: str, meant: str) -> None:
    assert lidarspec.sensor(name).id == meant


def test_a_file_may_have_dataclasses_with_annotations_that_are_texts(tmp_path: Path) -> None:
    text = STRANGER.read_text(encoding="utf-8")
    own = "\n".join(
        [
            "",
            "from dataclasses import dataclass",
            "",
            "@dataclass",
            "class Laser:",
            "    angle: float = 0.0",
            "",
        ]
    )
    file, broken = tmp_path / "mine.py", tmp_path / "broken.py"
    file.write_text(text + own, encoding="utf-8")
    assert "from __future__ import annotations" in text
    assert lidarspec.sensor(str(file)).frames
    module = import_file(file)
    assert pickle.loads(pickle.dumps(module.Laser(2.0))) == module.Laser(2.0)
    broken.write_text("1 / 0", encoding="utf-8")
    before = set(sys.modules)
    with pytest.raises(SpecError, match="ZeroDivisionError"):
        lidarspec.sensor(str(broken))
    assert set(sys.modules) == before
