"""Tests of the table of known sensors.

It equals a new generation, lists the installed sensors, and names missing distributions. The
environment of these tests holds the core and one plugin: a virtual environment with links to the
installed packages that the core requires, and no other.
"""

from __future__ import annotations

import json
import os
import random
import struct
import subprocess
import venv
from importlib.metadata import distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import lidarspec as ls
from lidarspec.entry_points import EntryPoint
from lidarspec.known_sensors import KnownSensor, install_command, known_sensors
from lidarspec.plugins import Registry, make_row, registry
from tests.made_captures import ethernet, ipv4, pcap
from tools.make_known_sensors import TABLE, table

INSTALLED = "lidarspec-ldrobot"
PACKAGES = (
    "lidarspec",
    "lidarspec_ldrobot",
    "click",
    "construct",
    "numpy",
    "numpy.libs",
    "pluggy",
    "serial",
    "rich",
)
REQUIRED_BY_RICH = ("pygments", "markdown_it", "mdurl")
VELODYNE_PORT = 2368
LIVOX_PORT = 56301
SENDER_PORT = 40_000


@pytest.fixture(scope="module")
def one_plugin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the interpreter of an environment with the core and one plugin."""
    place = tmp_path_factory.mktemp("one_plugin")
    venv.create(place, with_pip=False, symlinks=os.name != "nt")
    python = place / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    asked = [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    site = Path(subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip())
    for name in (*PACKAGES, *REQUIRED_BY_RICH):
        folder = package_folder(name)
        if folder is not None:
            (site / name).symlink_to(folder, target_is_directory=True)
    for name in ("lidarspec", INSTALLED):
        metadata = Path(
            str(
                distribution(name).locate_file(
                    f"{name.replace('-', '_')}-{ls.__version__}.dist-info"
                )
            )
        )
        (site / metadata.name).symlink_to(metadata, target_is_directory=True)
    return python


def package_folder(name: str) -> Path | None:
    """Return the folder of an installed package; None if there is none, as with `numpy.libs` on
    some systems.
    """
    if "." in name:
        folder = package_folder(name.partition(".")[0])
        assert folder is not None
        return folder.with_name(name) if folder.with_name(name).is_dir() else None
    spec = find_spec(name)
    return Path(spec.origin).parent if spec is not None and spec.origin is not None else None


def capture_to(port: int, datagrams: list[bytes]) -> bytes:
    """Return a pcap file of datagrams to a port."""
    headers = (struct.pack(">HHHH", SENDER_PORT, port, 8 + len(data), 0) for data in datagrams)
    return pcap(
        *(ethernet(ipv4(header + data)) for header, data in zip(headers, datagrams, strict=True))
    )


def run(python: Path, *words: object, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the command line in an environment."""
    variables = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTHON", "LIDARSPEC"))
    }
    command = [python, "-m", "lidarspec", *map(str, words)]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=python.parent, env=variables, check=False
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done


def test_the_table_equals_a_fresh_generation() -> None:
    assert TABLE.read_text(encoding="utf-8") == table(), "run `make known-sensors`"


def test_rows_survive_their_json_form() -> None:
    for row in known_sensors():
        assert KnownSensor.from_dict(json.loads(json.dumps(row.to_dict()))) == row


def test_every_installed_sensor_is_listed_as_it_is() -> None:
    listed = {row.id: row._replace(signatures=()) for row in registry().list_sensors()}
    homes = {name: plugin for plugin in registry().plugins for name in plugin.sensors}
    assert listed == {
        name: make_row(sensor, homes[name].distribution, homes[name].version)
        for name, sensor in ls.sensors().items()
    }


@pytest.mark.parametrize(
    ("version", "names", "loaded"),
    [
        ("0.1.0", {"ldrobot-ld20", "ld20"}, False),
        ("0.1.1", {"ldrobot-ld20", "ld20"}, True),
        ("0.1.0", {"ldrobot-ld20"}, True),
    ],
    ids=["as in the table", "another version", "an alias less"],
)
def test_only_a_sensor_that_the_table_describes_is_listed_without_its_plugin(
    version: str, names: set[str], loaded: bool
) -> None:
    entries = [EntryPoint(name, "no_such_module:LD20", INSTALLED, version) for name in names]
    registry = Registry(offered=entries)
    listed = [row.id for row in registry.list_sensors()]
    assert listed == ([] if loaded else ["ldrobot-ld20"])
    assert [plugin.distribution for plugin in registry.failures] == [INSTALLED] * loaded


@pytest.mark.parametrize("name", ["velodyne-vlp16", "puck", "VLP-16"])
def test_an_uninstalled_sensor_is_named_with_its_distribution(name: str) -> None:
    with pytest.raises(ls.UsageError) as caught:
        Registry().sensor(name)
    assert caught.value.distribution == "lidarspec-velodyne"  # type: ignore[attr-defined]
    assert caught.value.__notes__ == [f"next: {install_command('lidarspec-velodyne')}"]


def test_the_install_command_names_a_folder_of_the_checkout_else_the_repository(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert Path(install_command("lidarspec-ouster").split()[-1]).is_dir()
    monkeypatch.setattr(
        "lidarspec.known_sensors.__file__", str(tmp_path / "lidarspec" / "known_sensors.py")
    )
    assert install_command("lidarspec-ouster").endswith("#subdirectory=plugins/lidarspec-ouster'")


@pytest.mark.slow
def test_with_one_plugin_verbs_name_the_distribution_to_install(
    one_plugin: Path, tmp_path: Path
) -> None:
    vlp16 = ls.sensor("velodyne-vlp16")
    datagrams = [bytes(frame) for frame in ls.simulate(vlp16, 20)]
    capture = tmp_path / "drive.pcap"
    capture.write_bytes(capture_to(VELODYNE_PORT, datagrams))
    for words in (
        ("view", "sim:velodyne-vlp16", "--once"),
        ("show", "vlp16"),
        ("stats", capture, "-s", "velodyne-vlp16"),
    ):
        assert "pip install 'lidarspec-velodyne @" in run(one_plugin, *words, code=2).stderr
    assert "lidarspec-velodyne" in run(one_plugin, "detect", capture, code=4).stderr
    assert "lidarspec-velodyne" in run(one_plugin, "read", capture, code=4).stderr


@pytest.mark.slow
def test_with_one_plugin_a_serial_stream_is_recognized(one_plugin: Path, tmp_path: Path) -> None:
    stream = tmp_path / "line.bin"
    stream.write_bytes(
        b"".join(bytes(frame) for frame in ls.simulate(ls.sensor("cspc-m1c1-mini"), 100))
    )
    assert "lidarspec-cspc" in run(one_plugin, "detect", stream, code=4).stderr


def test_with_one_plugin_a_known_port_is_enough(one_plugin: Path, tmp_path: Path) -> None:
    capture = tmp_path / "noise.pcap"
    capture.write_bytes(capture_to(LIVOX_PORT, [random.Random(0).randbytes(200)] * 5))
    assert "lidarspec-livox" in run(one_plugin, "detect", capture, code=4).stderr


def test_with_one_plugin_only_its_sensors_are_listed(one_plugin: Path) -> None:
    lines = run(one_plugin, "sensors").stdout.splitlines()
    expected = [row.id for row in known_sensors() if row.distribution == INSTALLED]
    assert [line.split()[0] for line in lines[1:]] == expected
    listed: list[dict[str, Any]] = json.loads(run(one_plugin, "sensors", "--json").stdout)
    assert [row["id"] for row in listed] == expected


def test_listing_loads_no_plugin_that_the_table_describes(one_plugin: Path) -> None:
    code = (
        "import sys; from lidarspec.plugins import registry; registry().list_sensors();"
        " print('lidarspec_ldrobot' in sys.modules)"
    )
    done = subprocess.run([one_plugin, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
