"""Tests of devices by name in `lidarspec.toml`, in Python and in every verb.

Errors name the file, table and key.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Scan
from lidarspec.device import named_devices
from lidarspec.points.mount import Mount
from lidarspec.simulation.simulator import simulate
from tests.cli.running import ran

SENSOR = "ldrobot-stl27l"
GOOD = f"""
[device.front]
source = "./front.bin"
sensor = "{SENSOR}"
mount = {{x = 1, yaw_deg = 90, inverted = true}}

[device.rear]
source = "udp://:6699"
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the working directory, with a settings file and a capture.

    The user has no settings file.
    """
    home, here = tmp_path / "home", tmp_path / "project" / "deep"
    here.mkdir(parents=True)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(home))
    monkeypatch.setenv("APPDATA", str(home))
    monkeypatch.chdir(here)
    (here.parent / "lidarspec.toml").write_text(GOOD, encoding="utf-8")
    sensor = ls.sensor(SENSOR)
    (here.parent / "front.bin").write_bytes(b"".join(simulate(sensor, 400)))
    return here.parent


def whole(source: str | Path, sensor: str | None = None) -> Scan:
    with ls.open(source, sensor) as device:
        return next(scan for scan in device.scans() if scan.complete)


def test_a_name_opens_its_source_with_its_sensor_and_mount(folder: Path) -> None:
    plain, mounted = whole(folder / "front.bin", SENSOR), whole("front")
    assert mounted.sensor.id == SENSOR
    # turned over y and z change sign, then a quarter turn to the left: (x, y) -> (y, x)
    np.testing.assert_allclose(mounted.points.x, plain.points.y + 1, atol=1e-5)
    np.testing.assert_allclose(mounted.points.y, plain.points.x, atol=1e-5)
    np.testing.assert_array_equal(mounted.points.range, plain.points.range)


def test_packets_stay_in_the_sensors_axes(folder: Path) -> None:
    with ls.open("front") as device:
        cloud = next(device.packets()).points()
    with ls.open(folder / "front.bin", SENSOR) as device:
        np.testing.assert_array_equal(cloud.x, next(device.packets()).points().x)


@pytest.mark.parametrize(
    "words",
    [
        ("stats", "front", "--json"),
        pytest.param(("read", "front", "-n", "2"), marks=pytest.mark.slow),
        pytest.param(("view", "front", "--once"), marks=pytest.mark.slow),
        pytest.param(("convert", "front", "out.csv"), marks=pytest.mark.slow),
        pytest.param(("plot", "front", "-o", "out.svg"), marks=pytest.mark.slow),
        ("record", "front", "-o", "out.lsr"),
        pytest.param(("replay", "front", "--to", "out.bin"), marks=pytest.mark.slow),
        pytest.param(("detect", "front"), marks=pytest.mark.slow),
        pytest.param(("doctor", "front"), marks=pytest.mark.slow),
        pytest.param(("parse", "front"), marks=pytest.mark.slow),
        pytest.param(("explain", "front"), marks=pytest.mark.slow),
    ],
    ids=lambda words: words[0],
)
def test_every_verb_takes_a_name(folder: Path, words: tuple[str, ...]) -> None:
    assert ran(*words).exit_code == 0


def test_a_live_device_by_name_is_live(folder: Path) -> None:
    assert (
        "only a file can be replayed, but rear is a live source"
        in ran("replay", "rear", code=2).stderr
    )
    assert (
        "expected hexadecimal bytes or a file, got the live source udp://:6699"
        in ran("parse", "rear", code=2).stderr
    )


def test_hexadecimal_digits_are_no_name(folder: Path) -> None:
    assert "requires 1 byte, but has 0" in ran("parse", "aa5500", code=4).stderr


def settings_of_the_user(folder: Path, text: str) -> Path:
    """Write the user's own settings file."""
    file = folder.parent / "home" / "lidarspec" / "lidarspec.toml"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")
    return file


def test_the_users_own_file_comes_first_and_the_nearest_one_adds_to_it(folder: Path) -> None:
    user = settings_of_the_user(
        folder,
        '[device.front]\nsource = "sim:ldrobot-stl27l"\n[device.desk]\nsource = "tcp://desk:2"\n',
    )
    found = named_devices.read_devices()
    assert list(found) == ["front", "desk", "rear"]
    assert found["front"].sensor is None
    assert found["desk"].file == str(user)
    project = folder / "lidarspec.toml"
    warning = f"front: using the device that {user} defines, and ignoring the one in {project}"
    with pytest.warns(UserWarning, match=warning):
        assert named_devices.find_device("front") == found["front"]
    said = ran("stats", "front", "-s", SENSOR, "-n", "1").stderr
    assert said.count(warning) == 1
    (folder / "deep" / "lidarspec.toml").write_text("", encoding="utf-8")
    assert list(named_devices.read_devices()) == ["front", "desk"]


@pytest.mark.parametrize(
    "text",
    ["[device.front", "x = " + "[" * 10_000, "[" + "a." * 20_000 + "b]", "#" * (1 << 18) + "\n"],
)
def test_a_file_with_an_error_affects_its_own_devices_only(folder: Path, text: str) -> None:
    broken = folder / "lidarspec.toml"
    broken.write_text(text, encoding="utf-8")
    settings_of_the_user(
        folder, f'[device.desk]\nsource = "{folder / "front.bin"}"\nsensor = "{SENSOR}"\n'
    )
    with pytest.warns(UserWarning, match=rf"{broken}: not TOML: .*; its devices are ignored"):
        assert ls.open("desk").sensor.id == SENSOR
    assert ran("stats", "desk").stderr.count(f"{broken}: not TOML") == 1
    assert ran("stats", "front", code=2).stderr.startswith(f"{broken}: not TOML")
    assert "devices in lidarspec.toml: desk" in ran().stdout


@pytest.mark.parametrize("whose", ["another's", "everybody's", "everybody's folder"])
def test_a_file_of_another_user_is_skipped_with_one_warning(folder: Path, whose: str) -> None:
    file = folder / "deep" / "lidarspec.toml"
    file.write_text('[device.front]\nsource = "sim:velodyne-vlp16"\n', encoding="utf-8")
    if whose == "another's":
        if os.getuid():
            pytest.skip("only root gives files away")
        os.chown(file, 12345, -1)
        reason = f"{file} belongs to user 12345"
    else:
        place = file if whose == "everybody's" else file.parent
        place.chmod(0o777)
        reason = f"{place} is accessible to other users: run chmod 775"
    with pytest.warns(UserWarning, match=f"cannot read {file}: {reason}"):
        device = named_devices.find_device("front")
    assert device is not None
    assert device.sensor == SENSOR  # that of the folder above, which is the user's
    assert ran("stats", "front").stderr.count(f"cannot read {file}: {reason}") == 1


EVIL = (
    "from pathlib import Path\nPath(__file__).with_name('ran').touch()\n"
    "from {} import lidarspec_sensors\n"
)


@pytest.mark.parametrize("how", ["verb", "variable"])
def test_a_project_runs_no_python_until_its_folder_is_allowed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    (folder / "evil.py").write_text(
        EVIL.format("tests.shapes.stranger.acme_lidars"), encoding="utf-8"
    )
    (folder / "lidarspec.toml").write_text(
        '[device.front]\nsource = "./front.bin"\nsensor = "./evil.py"\n', encoding="utf-8"
    )
    for verb, *words in (
        ["stats"],
        ["view"],
        ["record", "-o", "x.lsr"],
        ["detect"],
        ["doctor"],
        ["parse"],
    ):
        said = ran(verb, "front", *words, code=2).stderr
        assert f"{folder / 'lidarspec.toml'}: [device.front]: sensor" in said
        assert f"next: lidarspec trust {folder}" in said
    with monkeypatch.context() as shell:
        for name, value in {
            "_LIDARSPEC_COMPLETE": "bash_complete",
            "COMP_WORDS": "lidarspec send front ",
            "COMP_CWORD": "3",
        }.items():
            shell.setenv(name, value)
        assert ran(code=1).output == ""
    with pytest.raises(ls.UsageError, match="is a Python file, which would be executed"):
        ls.open("front")
    assert not (folder / "ran").exists()
    if how == "verb":
        assert str(folder) in ran("trust", folder).stdout
        ran("trust", folder)
        assert (folder.parent / "home" / "lidarspec" / "trusted").read_text(
            encoding="utf-8"
        ) == f"{folder}\n"
    else:
        monkeypatch.setenv("LIDARSPEC_TRUST", str(folder))
    with ls.open("front") as device:
        assert device.sensor.id == "acme-x1"
    assert (folder / "ran").exists()


@pytest.mark.parametrize("place", ["/etc/hostname", "../outside.csv", "./link.csv", "/dev/stdin"])
def test_a_project_names_no_files_elsewhere_until_its_folder_is_allowed(
    folder: Path, place: str
) -> None:
    (folder.parent / "outside.csv").write_text("-10 0 10 20", encoding="utf-8")
    (folder / "inside.csv").write_text("-10 0 10 20", encoding="utf-8")
    (folder / "link.csv").symlink_to(folder.parent / "outside.csv")
    text = (
        '[device.front]\nsource = "./front.bin"\nsensor = "hesai-xt16"\n'
        'options = {{calibration = "{}"}}\n[device.rear]\nsource = "{}"\n'
    )
    (folder / "lidarspec.toml").write_text(text.format(place, place), encoding="utf-8")
    said = ran("stats", "front", code=2).stderr
    assert f"{folder / 'lidarspec.toml'}: [device.front]: calibration: " in said
    assert "is not a file in" in said
    if place != "/dev/stdin":
        assert "is a file outside" in ran("stats", "rear", code=2).stderr
    (folder / "lidarspec.toml").write_text(text.format("./inside.csv", place), encoding="utf-8")
    assert "inside.csv" in (said := ran("stats", "front", code=2).stderr)
    # The file is read, but is not the one that the sensor requires.
    assert "is not a file in" not in said
    assert "lidarspec trust" not in said


@pytest.mark.parametrize(
    "url",
    [
        "file:///etc/hostname",
        "http://127.0.0.1:9/drive.pcap",
        "ftp://127.0.0.1:9/drive.pcap",
        "s3://bucket/drive.pcap",
    ],
)
def test_urls_of_a_project_need_a_trusted_folder(folder: Path, url: str) -> None:
    (folder / "lidarspec.toml").write_text(f'[device.front]\nsource = "{url}"\n', encoding="utf-8")
    with pytest.raises(ls.UsageError, match=url):
        ls.open("front")
    assert f"next: lidarspec trust {folder}" in ran("stats", "front", code=2).stderr


def test_only_a_folder_of_ones_own_can_be_allowed(folder: Path) -> None:
    folder.chmod(0o777)
    said = ran("trust", folder, code=2).stderr
    assert (
        f"other users could run programs as you, because {folder} is accessible to other users:"
        " run chmod 775"
    ) in said
    assert "is not a folder" in ran("trust", folder / "front.bin", code=2).stderr


def test_paths_that_begin_with_a_dot_are_from_the_files_folder(folder: Path) -> None:
    assert named_devices.read_devices()["front"].source == str(folder / "front.bin")
    assert named_devices.read_devices()["rear"].source == "udp://:6699"


def test_a_path_is_no_name(folder: Path) -> None:
    assert named_devices.find_device("./front") is None
    assert named_devices.find_device(Path("front")) is None
    assert named_devices.find_device("udp://") is None
    assert named_devices.find_device("-") is None
    (folder / "deep" / "other").write_bytes(b"")
    assert named_devices.find_device("other") is None


def test_an_unknown_word_gets_a_suggestion(folder: Path) -> None:
    with pytest.raises(
        ls.UsageError,
        match=r"'frnt' is neither a file nor a device of .*lidarspec.toml; did you mean 'front'\?",
    ):
        ls.open("frnt")


def test_without_settings_a_word_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setenv("APPDATA", str(tmp_path))
    with pytest.raises(ls.SourceError, match="front: No such file"):
        ls.open("front", SENSOR)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[devices.front]", r"unknown table 'devices'; did you mean 'device'\?"),
        (
            "[device]\nfront = 1",
            r"write each device as a table of its own, such as \[device.front\]",
        ),
        ("[device.front]", r"\[device.front\]: source is missing"),
        (
            '[device.front]\nsorce = "x.bin"',
            r"\[device.front\]: unknown key 'sorce'; did you mean 'source'\?",
        ),
        ("[device.front]\nsource = 3", r"\[device.front\]: source must be text, got 3"),
        (
            '[device.front]\nsource = "x.bin"\nsensor = ["a"]',
            r"\[device.front\]: sensor must be text, got \['a'\]",
        ),
        (
            '[device.front]\nsource = "x.bin"\nmount = 90',
            r"\[device.front\]: mount must be a table, got 90",
        ),
        (
            '[device.front]\nsource = "x.bin"\nmount = {yaw = 90}',
            r"\[device.front\] mount: unknown key 'yaw'; did you mean 'yaw_deg'\?",
        ),
        (
            '[device.front]\nsource = "x.bin"\nmount = {yaw_deg = "90"}',
            r"\[device.front\]: mount.yaw_deg must be a number, got '90'",
        ),
        (
            '[device.front]\nsource = "x.bin"\nmount = {x = true}',
            r"mount.x must be a number, got True",
        ),
        (
            '[device.front]\nsource = "x.bin"\nmount = {x = inf}',
            r"mount.x must be a number, got inf",
        ),
        (
            '[device.front]\nsource = "x.bin"\nmount = {inverted = 1}',
            r"mount.inverted must be true or false, got 1",
        ),
        (
            '[device.front]\nsource = "x.bin"\noptions = {zero = 1}',
            r"options require a sensor",
        ),
        ('[device.front]\nsource = "rear"', r"source 'rear' is the name of another device"),
        ('[device.COM4]\nsource = "x.bin"', r"\[device.COM4\]: invalid name"),
        ('[device."a.bin"]\nsource = "x.bin"', r"\[device.a.bin\]: invalid name"),
        ("[device.front", r"not TOML: "),
        ('[owners]\nacme-x1 = "evil"', r"\[owners\] is only allowed in your own settings"),
    ],
)
def test_a_mistake_is_named_with_its_place(folder: Path, text: str, told: str) -> None:
    (folder / "lidarspec.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ls.UsageError, match=rf"lidarspec\.toml: .*{told}"):
        ls.open("front")
    assert ran("stats", "front", code=2).stderr.startswith(str(folder / "lidarspec.toml"))


def test_options_configure_the_sensor(folder: Path) -> None:
    text = (
        '[device.front]\nsource = "./front.bin"\nsensor = "velodyne-vlp16"\n'
        'options = {frame = "vendor"}'
    )
    (folder / "lidarspec.toml").write_text(text, encoding="utf-8")
    with ls.open("front") as device:
        assert device.sensor.options["frame"] == "vendor"
    (folder / "lidarspec.toml").write_text(text.replace("frame =", "fram ="), encoding="utf-8")
    with pytest.raises(ls.UsageError, match="fram"):
        ls.open("front")


@pytest.mark.parametrize(
    ("mount", "expected"),
    [
        (Mount(yaw_deg=90), (-2, 1, 3)),
        (Mount(pitch_deg=90), (3, 2, -1)),
        (Mount(roll_deg=90), (1, -3, 2)),
        (Mount(inverted=True), (1, -2, -3)),
        (Mount(x=1, y=2, z=3), (2, 4, 6)),
        (Mount(x=10, yaw_deg=90, inverted=True), (12, 1, -3)),
        (Mount(yaw_deg=90, pitch_deg=90), (-2, 3, -1)),
    ],
)
def test_a_mount_turns_and_moves(mount: Mount, expected: tuple[float, float, float]) -> None:
    direction = np.array([1.0, 2.0, 3.0])
    reach, level = np.linalg.norm(direction), np.hypot(1.0, 2.0)
    one = {"time": np.zeros(1), "valid": np.ones(1, np.bool_), "stamp_ns": 5}
    polar = {"range": reach, "azimuth": np.arctan2(2.0, 1.0), "elevation": np.arctan2(3.0, level)}
    columns = {
        name: np.array([value], np.float32)
        for name, value in {"x": 1, "y": 2, "z": 3, **polar}.items()
    }
    found = mount.apply(ls.PointCloud(**columns, **one))
    np.testing.assert_allclose(found.xyz[0], expected, atol=1e-5)
    beam = np.array(expected) - (mount.x, mount.y, mount.z)
    assert found.azimuth[0] == pytest.approx(np.arctan2(beam[1], beam[0]), abs=1e-6)
    assert found.elevation[0] == pytest.approx(np.arcsin(beam[2] / reach), abs=1e-6)
    assert found.range[0] == np.float32(reach)
    assert found.stamp_ns == 5


def test_no_return_stays_none_and_keeps_its_direction() -> None:
    nothing = np.full(1, np.nan, np.float32)
    zero = np.zeros(1, np.float32)
    cloud = ls.PointCloud(
        x=nothing, y=nothing, z=nothing, range=np.full(1, np.inf, np.float32),
        azimuth=zero, elevation=zero, time=np.zeros(1), valid=np.zeros(1, np.bool_),
    )  # fmt: skip
    found = Mount(x=3, yaw_deg=180).apply(cloud)
    assert np.isnan(found.xyz).all()
    assert np.isinf(found.range[0])
    assert found.azimuth[0] == pytest.approx(-np.pi)
    assert not found.valid[0]


def test_the_text_of_a_mount() -> None:
    assert str(Mount(x=0.2, yaw_deg=90, inverted=True)) == "x=0.2, yaw_deg=90, inverted"
    assert str(Mount()) == "no rotation or translation"
