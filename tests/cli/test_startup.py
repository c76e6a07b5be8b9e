"""Tests that a command imports only the modules and the plugin that it uses.

They count modules, not seconds.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import lidarspec as ls

SENSOR = "ldrobot-stl27l"
PLUGIN = "lidarspec_ldrobot"
#: the plugin of the MS200, which sends the frames of this sensor.
PLUGIN_OF_RELATIVE = "lidarspec_oradar"
FRAMES = 40
PRINT_MODULES = """
import json, sys
from lidarspec.cli.root import main
try:
    main(sys.argv[1:])
finally:
    print("\\n" + json.dumps(sorted(sys.modules)), file=sys.stderr)
"""
COUNT_TREES = """
import gc, sys
import lidarspec as ls
from lidarspec.spec import Frame
ls.sensor(sys.argv[1])
frames = [value for value in gc.get_objects() if type(value) is Frame]
print(len(frames), sum("tree" in vars(frame) for frame in frames))
"""


def modules_after(*words: object) -> set[str]:
    """Return the modules that a process of the command line has imported at its end."""
    command = [sys.executable, "-c", PRINT_MODULES, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(json.loads(done.stderr.splitlines()[-1]))


def plugins_in(modules: set[str]) -> set[str]:
    """Return the packages of sensors among some modules."""
    return {name for name in modules if name.startswith("lidarspec_") and "." not in name}


def test_sensors_loads_no_plugin() -> None:
    modules = modules_after("sensors")
    assert not plugins_in(modules)
    assert (
        not {
            "numpy",
            "construct",
            "rich",
            "serial",
            "lidarspec.plugins",
            "lidarspec.spec",
            "lidarspec.device",
        }
        & modules
    )


def test_show_loads_one_plugin_and_no_device() -> None:
    modules = modules_after("show", SENSOR)
    assert plugins_in(modules) == {PLUGIN}
    assert (
        not {
            "rich",
            "serial",
            "lidarspec.framing.decoder",
            "lidarspec.points",
            "lidarspec.device.named_devices",
        }
        & modules
    )


def test_explain_of_a_named_sensor_loads_one_plugin_and_no_source() -> None:
    modules = modules_after("explain", "-s", SENSOR, ls.sensor(SENSOR).example("data").hex())
    assert plugins_in(modules) == {PLUGIN}
    unused = {
        "rich",
        "serial",
        "lidarspec.detect.identification",
        "lidarspec.transports.open_url",
        "lidarspec.device.device",
    }
    assert not unused & modules


@pytest.mark.parametrize("source", ["file", pytest.param("simulation", marks=pytest.mark.slow)])
def test_reading_a_named_sensor_loads_no_plugin_but_that_of_its_relatives(
    source: str, tmp_path: Path
) -> None:
    stream = tmp_path / "line.bin"
    stream.write_bytes(b"".join(map(bytes, ls.simulate(ls.sensor(SENSOR), FRAMES))))
    words = (
        ("stats", stream, "-s", SENSOR) if source == "file" else ("view", f"sim:{SENSOR}", "--once")
    )
    loaded = plugins_in(modules_after(*words))
    assert {PLUGIN} <= loaded <= {PLUGIN, PLUGIN_OF_RELATIVE}


def test_loading_a_sensor_builds_no_frame_tree() -> None:
    done = subprocess.run(
        [sys.executable, "-c", COUNT_TREES, SENSOR], capture_output=True, text=True, check=True
    )
    frames, trees = map(int, done.stdout.split())
    assert frames
    assert trees == 0
