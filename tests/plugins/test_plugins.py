"""Plugins as they arrive: a stranger's distribution is found and works, broken ones beside it are named and disturb nothing."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec
from lidarspec import SourceError, SpecError, UsageError
from lidarspec.entry_points import SENSORS, entry_points
from lidarspec.errors import UnknownSensor
from lidarspec.plugins import file_module
from lidarspec.testing import SensorConformance

HERE = Path(__file__).resolve().parents[1] / "shapes"
STRANGER = HERE / "stranger" / "acme_lidars.py"

#: what each broken entry point is reported with.
REPORTS = {
    "absent-module = lidarspec_broken.absent": "No module named 'lidarspec_broken.absent'",
    "absent-import = lidarspec_broken.absent_import": "No module named 'a_library_that_nobody_has'",
    "syntax = lidarspec_broken.syntax": "SyntaxError",
    "exits = lidarspec_broken.exits": "SystemExit: leaving",
    "wrong-signature = lidarspec_broken.wrong_signature": "everything",
    "misspelt = lidarspec_broken.misspelt": "there is no hook 'lidarspec_sensor'",
    "unmarked = lidarspec_broken.unmarked": "lidarspec_sensors lacks @hookimpl",
    "duplicate = lidarspec_broken.duplicate": "acme-x1: another sensor has this id already: that of acme-lidars:acme_lidars",
    "raises = lidarspec_broken.raises": "ZeroDivisionError",
    "no-sensor = lidarspec_broken.no_sensor": "returns sensors, not str",
    "bad-spec = lidarspec_broken.bad_spec": "no field may be called 'state' or 'on'",
    "hook = lidarspec_broken.hook": f"lidarspec_checksum for {min('acme-x1', *lidarspec.sensors())}: KeyError",
}

#: sensors that fail at work, and what they say.
FAILING = {
    "broken-checksum": "ZeroDivisionError",
    "broken-parse": "ZeroDivisionError",
    "broken-plausible": "no such luck",
    "broken-points": "no such luck",
    "broken-field": "did you mean 'distances'?",
    "broken-shape": "lengths that do not go together",
    "broken-result": "has to return Polar or Cartesian",
}

FRAME = "bb ad 01 0a 0b 0c 0d 00"

LOOK = """
import json, lidarspec as ls
from lidarspec.plugins import registry
sensors = ls.sensors()
plugins = [[p.distribution, p.version, p.entry_point, list(p.sensors), p.error, bool(p.traceback)] for p in registry().plugins]
good = [name for name, s in sensors.items() if not name.startswith("broken-") and s.parse(s.example(s.data_frame), s.data_frame)]
"""

WORK = """
report = {}
for name in (n for n in sensors if n.startswith("broken-")):
    s, said = sensors[name], []
    data = bytes.fromhex(FRAME) * 3
    for backend in ("auto", "construct"):
        decoder = s.decoder(backend=backend)
        found = decoder.feed(data) + decoder.finish()
        try:
            cloud = s.decode(data, backend=backend).points()
            said.append([len(found), decoder.stats.plugin_errors, int(cloud.valid.sum()), len(cloud), "".join(decoder.stats.tracebacks)])
        except ls.SpecError as error:
            said.append([len(found), decoder.stats.plugin_errors, 0, 0, str(error)])
        scans = list(s.scans(data, backend=backend))
    try:
        s.parse(data[:8])
        parsed = ""
    except ls.LidarSpecError as error:
        parsed = type(error).__name__ + ": " + str(error)
    report[name] = [said, parsed]
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the stranger's and the broken distributions, installed by pip as a user would."""
    folder = tmp_path_factory.mktemp("plugins")
    sources = [shutil.copytree(HERE / name, folder / name) for name in ("stranger", "broken")]
    (folder / "broken" / "lidarspec_broken" / "syntax.py").write_text("def broken(:\n", encoding="utf-8")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index", "--no-deps"]
    command += ["--no-build-isolation", "--no-compile", "--target", str(folder / "site"), *map(str, sources)]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    own = folder / "site" / "lidarspec" / "lidarspec.toml"
    own.parent.mkdir()
    own.write_text('[owners]\nacme-x1 = "acme-lidars"\n', encoding="utf-8")
    return folder / "site"


@pytest.fixture(scope="module")
def seen(site: Path) -> dict[str, Any]:
    """What a program sees that runs with these plugins installed."""
    code = f"FRAME = {FRAME!r}\n{LOOK}{WORK}\nprint(json.dumps([plugins, good, sorted(sensors), report]))"
    done = python(site, "-c", code)
    assert done.returncode == 0, done.stderr
    return dict(zip(("plugins", "good", "sensors", "report"), json.loads(done.stdout), strict=True))


def python(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    paths = [str(site), os.environ.get("PYTHONPATH", "")]
    own = dict.fromkeys(("XDG_CONFIG_HOME", "APPDATA"), str(site))
    environment = {**os.environ, **own, "PYTHONPATH": os.pathsep.join(path for path in paths if path)}
    return subprocess.run([sys.executable, *arguments], check=False, env=environment, cwd=site, capture_output=True, text=True, timeout=120)


def test_a_strangers_sensor_is_found_and_works(seen: dict[str, Any]) -> None:
    assert ["acme-lidars", "3.2.1", "acme = acme_lidars", ["acme-x1"], "", False] in seen["plugins"]
    assert {"acme-x1", *lidarspec.sensors()} <= set(seen["good"])


def test_every_broken_plugin_is_named_with_its_error(seen: dict[str, Any]) -> None:
    errors = {entry: (distribution, version, error, kept) for distribution, version, entry, _, error, kept in seen["plugins"] if error}
    assert errors.keys() == REPORTS.keys()
    for entry, (distribution, version, error, kept) in errors.items():
        assert (distribution, version) == ("lidarspec-broken", "0.0.7")
        assert REPORTS[entry] in error
        assert "\n" not in error
        assert kept or entry.startswith("duplicate")  # which raises nothing


def test_nothing_of_a_broken_plugin_stays(seen: dict[str, Any]) -> None:
    assert set(seen["sensors"]) - set(seen["good"]) == {*FAILING, "broken-nan", "broken-fresh"}  # which stands beside a duplicate


@pytest.mark.parametrize("name", FAILING)
def test_a_plugin_that_fails_at_work_is_counted_and_says_so(seen: dict[str, Any], name: str) -> None:
    said, parsed = seen["report"][name]
    assert said[0][:4] == said[1][:4]
    for frames, errors, _, _, text in said:
        assert FAILING[name] in text
        assert frames == 3 or errors >= 3
    assert parsed == "" or (parsed.startswith("SpecError") and name in parsed and FAILING[name] in parsed)


def test_points_that_are_not_numbers_are_not_valid(seen: dict[str, Any]) -> None:
    said, _ = seen["report"]["broken-nan"]
    assert [case[:4] for case in said] == [[3, 0, 0, 12]] * 2


@pytest.mark.skipif(not (HERE.parent.parent / "lidarspec" / "cli").is_dir(), reason="there is no command line yet")
def test_the_command_line_lists_what_is_broken(site: Path) -> None:
    done = python(site, "-m", "lidarspec", "plugins", "--json")
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    for entry, error in REPORTS.items():
        if entry.startswith("hook"):
            continue  # fails when a sensor is asked for, and a list of plugins asks for none
        assert entry.partition(" ")[0] in done.stdout
        assert json.dumps(error)[1:-1] in done.stdout
    assert python(site, "-m", "lidarspec", "show", "acme-x1").returncode == 0


#: what `check` names each broken entry point with.
RULES = {
    "absent-module = lidarspec_broken.absent": "LS001",
    "absent-import = lidarspec_broken.absent_import": "LS001",
    "syntax = lidarspec_broken.syntax": "LS001",
    "exits = lidarspec_broken.exits": "LS001",
    "wrong-signature = lidarspec_broken.wrong_signature": "LS004",
    "misspelt = lidarspec_broken.misspelt": "LS002",
    "unmarked = lidarspec_broken.unmarked": "LS003",
    "duplicate = lidarspec_broken.duplicate": "LS005",
    "raises = lidarspec_broken.raises": "LS006",
    "no-sensor = lidarspec_broken.no_sensor": "LS006",
    "hook = lidarspec_broken.hook": "LS010",
}


def test_a_broken_distribution_is_checked_to_its_end(site: Path) -> None:
    done = python(site, "-m", "lidarspec", "check", "lidarspec-broken", "--max-examples", "3", "--json")
    assert (done.returncode, done.stderr) == (1, "")
    loading, *sensors = json.loads(done.stdout)
    named = {finding["path"]: finding["code"] for finding in loading["findings"]}
    assert RULES.items() <= named.items()
    assert named.get("on") == "LS102"
    assert {"broken-checksum", "broken-plausible", "broken-points"} <= {report["name"] for report in sensors if report["findings"]}
    assert {finding["path"] for finding in loading["findings"] if finding["code"] == "LS001" and not finding["line"]} == {
        "absent-module = lidarspec_broken.absent"
    }


@pytest.mark.parametrize("name", ["acme-x1", "acme-lidars", "lidarspec-broken"])
def test_of_two_with_one_id_both_are_named_and_the_one_that_is_meant_is_checked(site: Path, name: str) -> None:
    done = python(site, "-m", "lidarspec", "check", name, "--max-examples", "3", "--json")
    reports = {report["name"]: report for report in json.loads(done.stdout)}
    (taken,) = [finding for report in reports.values() for finding in report["findings"] if finding["code"] == "LS005"]
    assert taken["what"] == "lidarspec-broken has acme-x1: another sensor has this id already: that of acme-lidars:acme_lidars"
    assert taken["path"] == "duplicate = lidarspec_broken.duplicate"
    source = reports["acme-x1"]["picture"].get("source")
    assert (source == "Acme X1 manual, which nobody wrote") == (name != "lidarspec-broken")


class TestStranger(SensorConformance):
    """The stranger's sensor straight from its file."""

    sensor = STRANGER
    examples = 4


def test_the_stranger_uses_state_look_ahead_and_its_calibration_file(tmp_path: Path) -> None:
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
        np.rad2deg(sensor.configure(calibration=file).decode(data).points().elevation[:4]), [-10, 0, 10, 20], atol=1e-5
    )
    with pytest.raises(UsageError, match="not a file of elevations"):
        sensor.configure(calibration=tmp_path / "none.txt")
    assert sensor.parse(sensor.command("spin", rate=10.0)).rate == 100


def test_a_file_of_another_kind_is_no_sensor(tmp_path: Path) -> None:
    (file := tmp_path / "readme.txt").write_text("hello", encoding="utf-8")
    with pytest.raises(lidarspec.SourceError, match=r"readme\.txt is no Python file"):
        lidarspec.sensor(str(file))


def test_a_file_with_several_sensors_asks_which(tmp_path: Path) -> None:
    file = tmp_path / "two.py"
    text = STRANGER.read_text(encoding="utf-8").replace("return [X1]", "return [X1, dataclasses.replace(X1, id='acme-x2', aliases=())]")
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
        "": "no function lidarspec_sensors",
        "from lidarspec.spec import hookimpl\n@hookimpl\ndef lidarspec_sensors():\n    return [1 / 0]": "ZeroDivisionError",
    }.items():
        file.write_text(text, encoding="utf-8")
        with pytest.raises(SpecError, match=message):
            lidarspec.sensor(str(file))


def test_a_relative_file_needs_no_more_than_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_an_unknown_sensor_suggests_those_with_this_part_or_the_closest(name: str, meant: str) -> None:
    with pytest.raises(UnknownSensor, match=rf"did you mean {meant}\?$"):
        lidarspec.sensor(name)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        *(("ld19", "ldrobot-ld06"), ("LD06", "ldrobot-ld06"), ("STL-27L", "ldrobot-stl27l"), ("rplidar", "slamtec-rplidar-a1")),
        *(("Puck", "velodyne-vlp16"), ("vlp_16", "velodyne-vlp16"), ("PandarXT-32", "hesai-xt32"), ("helios16p", "robosense-helios16p")),
    ],
)
def test_a_sensor_is_known_by_the_names_that_people_use(name: str, meant: str) -> None:
    assert lidarspec.sensor(name).id == meant


def test_each_name_of_a_sensor_loads_it_alone() -> None:
    offered = {entry.name for entry in entry_points(SENSORS)}
    assert {name for sensor in lidarspec.sensors().values() for name in (sensor.id, *sensor.aliases)} <= offered


def test_a_file_may_have_dataclasses_with_annotations_that_are_texts(tmp_path: Path) -> None:
    text = STRANGER.read_text(encoding="utf-8")
    own = "\n".join(["", "from dataclasses import dataclass", "", "@dataclass", "class Laser:", "    angle: float = 0.0", ""])
    file, broken = tmp_path / "mine.py", tmp_path / "broken.py"
    file.write_text(text + own, encoding="utf-8")
    assert "from __future__ import annotations" in text
    assert lidarspec.sensor(str(file)).frames
    module = file_module(file)
    assert pickle.loads(pickle.dumps(module.Laser(2.0))) == module.Laser(2.0)
    broken.write_text("1 / 0", encoding="utf-8")
    before = set(sys.modules)
    with pytest.raises(SpecError, match="ZeroDivisionError"):
        lidarspec.sensor(str(broken))
    assert set(sys.modules) == before
