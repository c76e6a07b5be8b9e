"""Ten sensors that represent all mechanisms of the installed sensors.

Promises about the engine are tested on the shapes of `tests.shapes` and, if real variety matters,
on these sensors. Promises about a sensor are tested in the `tests` folder of its plugin. The module
holds only ids: a sensor is loaded when a test needs it.
"""

from __future__ import annotations

import pytest

import lidarspec as ls
from tests.shapes import SHAPES

REPRESENTATIVES = (
    "ldrobot-stl27l",  # serial, fixed frames, CRC-8, interpolated angles
    "cspc-m1c1-mini",  # variable count, XOR over words, an angle that depends on range
    # answers of several types, each after its descriptor, differential angles
    "slamtec-rplidar-a1",
    "velodyne-vlp16",  # firings, rotation between blocks, a position packet as clock
    "robosense-m1",  # MEMS directions in the packet, two returns
    "hesai-qt128",  # large blocks, optional parts, calibration from a file
    "ouster-os1",  # frames that depend on metadata, columns and rows
    "livox-mid360",  # Cartesian points, IMU, commands over UDP
    "sick-multiscan136",  # segments of variable shape in long datagrams
    "hokuyo-ust10lx",  # text frames, characters of six bits
)

#: The representatives that send a stream of bytes; the others send datagrams.
STREAM_REPRESENTATIVES = (
    "ldrobot-stl27l",
    "cspc-m1c1-mini",
    "slamtec-rplidar-a1",
    "hokuyo-ust10lx",
)

#: The `name` of every shape and every representative.
each_sensor = pytest.mark.parametrize("name", [*SHAPES, *REPRESENTATIVES])
#: The same, with the representatives in the slow tier: for what the shapes prove.
each_shape = pytest.mark.parametrize(
    "name", [*SHAPES, *(pytest.param(name, marks=pytest.mark.slow) for name in REPRESENTATIVES)]
)


def load_sensor(sensor_id: str) -> ls.Sensor:
    """Return the shape or the installed sensor of this id."""
    if sensor_id in SHAPES:
        return SHAPES[sensor_id]
    return ls.sensor(sensor_id)
