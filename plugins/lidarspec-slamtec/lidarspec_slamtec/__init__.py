"""Slamtec RPLIDAR A1 to A3, S1 to S3, T1 and C1: 360 degree lidars with six kinds of data frames.

Source: RPLIDAR interface protocol and the vendor's SDK (sl_lidar_cmd.h, handler_capsules.cpp,
sl_lidar_driver.cpp); baud rates and ports from the SDK (_getNativeBaudRate) and the launch files of
sllidar_ros2. The attribute `source` of each sensor names the source of its range, or says that the
range is assumed.

A data frame is a node, which is one point, or a capsule, which has many points. A response
descriptor announces the kind of the following data frames, and the decoder searches for frames of a
kind only after the descriptor of this kind. The kinds are `node`, `express`, `ultra`, `dense`,
`ultra_dense` and `hq`. By default, the first kind in an input is decoded. The option `answer`, for
example ``-O answer=express``, selects another kind, for which the decoder searches without a
descriptor. Recordings that begin after the descriptor require this option.

For all kinds, a scan ends when the azimuth of the points passes zero.

Nodes have no checksum, so a node is accepted only if at least ten nodes follow each other without a
gap. The docstring of the module `nodes` contains the measured rates of false nodes. Frames do not
contain the times of their points, so all points of a frame have the time of the frame.

Requests, descriptors, and replies with information and configuration were verified with the
recorded communication of a live A1. Nodes, express and ultra capsules were verified with bytes that
were built by the rules of the SDK. Dense, ultra-dense and HQ capsules were verified with points
that were calculated by hand with the SDK's formulas. It is not known whether a C1 supports the
speed command. An S2L is assumed to have the model numbers of an S2, so these models cannot be
distinguished. A T1 receives requests and sends its stream over UDP.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Literal

from lidarspec import UsageError
from lidarspec.spec import Command, Frame, Link, OnWrap, Sensor, Serial, Simulation, Udp, hookimpl
from lidarspec_slamtec import capsules, nodes, units
from lidarspec_slamtec.answers import ANSWERS, DESCRIPTORS
from lidarspec_slamtec.commands import BY_DTR, BY_PWM, BY_SPEED, COMMANDS, make_express_request
from lidarspec_slamtec.requests import REQUESTS

MODELS = ("A1", "A2", "A3", "S1", "S2", "S2L", "S3", "T1", "C1")
SAME_MODEL_NUMBER = ("S2", "S2L")

FRAMES = {
    **DESCRIPTORS,
    **ANSWERS,
    "node": Frame(
        nodes.NODE,
        data=True,
        points=nodes.node_points,
        simulation=Simulation(nodes.node_sweep, rate=nodes.NODE_RATE_HZ),
        plausible=nodes.plausible,
        after="scan_descriptor",
        confirm=nodes.CONFIRM,
    ),
    "express": Frame(
        capsules.EXPRESS,
        data=True,
        points=capsules.express_points,
        simulation=Simulation(
            partial(capsules.sweep, degrees=capsules.EXPRESS_STEP), rate=capsules.EXPRESS_RATE
        ),
        plausible=capsules.plausible,
        after="express_descriptor",
    ),
    "ultra": Frame(
        capsules.ULTRA,
        data=True,
        points=capsules.ultra_points,
        simulation=Simulation(
            partial(capsules.sweep, degrees=capsules.ULTRA_STEP),
            capsules.encode_ultra,
            capsules.ULTRA_RATE,
        ),
        plausible=capsules.plausible,
        after="ultra_descriptor",
    ),
    "dense": Frame(
        capsules.DENSE,
        data=True,
        points=capsules.dense_points,
        simulation=Simulation(
            partial(capsules.sweep, degrees=capsules.DENSE_STEP), rate=capsules.DENSE_RATE
        ),
        plausible=capsules.plausible,
        after="dense_descriptor",
    ),
    "ultra_dense": Frame(
        capsules.ULTRA_DENSE,
        data=True,
        points=capsules.ultra_dense_points,
        simulation=Simulation(
            partial(capsules.sweep, degrees=capsules.ULTRA_DENSE_STEP),
            capsules.encode_ultra_dense,
            capsules.ULTRA_DENSE_RATE,
        ),
        plausible=capsules.plausible,
        after="ultra_dense_descriptor",
    ),
    "hq": Frame(
        nodes.HQ,
        data=True,
        points=nodes.hq_points,
        simulation=Simulation(nodes.hq_sweep, rate=nodes.HQ_CAPSULE_RATE_HZ),
        after="hq_descriptor",
    ),
    **REQUESTS,
}


def configure(
    sensor: Sensor, *, dtheta: Literal["unsigned", "signed"] | None = None, mode: int | None = None
) -> Sensor:
    """Return the sensor with another reading of `dtheta`, or with another scan mode.

    Args:
        dtheta: interpretation of the compensation in express capsules: "unsigned" as in the SDK, or
            "signed" as in the protocol.
        mode: the scan mode that is started when the sensor is opened, instead of a scan of nodes.
            Set the option `answer` to the kind of data frames that this mode sends.

    Raises:
        UsageError: if the mode is not a number from 0 to 255.
    """
    if dtheta is not None:
        changed = dataclasses.replace(
            sensor.frames["express"],
            points=partial(capsules.express_points, signed=dtheta == "signed"),
        )
        sensor = dataclasses.replace(sensor, frames={**sensor.frames, "express": changed})
    if mode is not None:
        if mode not in range(0x100):
            raise UsageError(f"{sensor.id}: mode must be a number from 0 to 255, not {mode!r}")
        answers = {
            **sensor.simulation.answers,
            "mode_scan": sensor.simulation.answers["express_scan"],
        }
        sensor = dataclasses.replace(
            sensor,
            commands={**sensor.commands, "mode_scan": make_express_request(mode)},
            simulation=Simulation(answers=answers),
            on_open=("stop", "start_motor", "mode_scan"),
        )
    return sensor


def make_rplidar(
    name: str,
    *,
    link: Link,
    motor: Mapping[str, Command],
    unit: units.SimulatedUnit,
    range_limits: tuple[float, float],
    turn: tuple[float, float] | None = None,
    status: str,
    source: str,
) -> Sensor:
    """Return one model of the family, simulated with the values of `unit`."""
    commands = {**COMMANDS, **motor}
    return Sensor(
        f"slamtec-rplidar-{name.lower()}",
        vendor="Slamtec",
        model=f"RPLIDAR {name}",
        frames=FRAMES,
        points=None,
        scan=OnWrap("azimuth"),
        links={"data": link},
        commands=commands,
        simulation=Simulation(
            answers={name: answer for name, answer in unit.answers().items() if name in commands}
        ),
        configure=configure,
        on_open=("stop", "start_motor", "scan"),
        on_close=("stop", "stop_motor"),
        acknowledged={}
        if status == "manual"
        else {
            "LS710": "verified with the recorded communication of an A1, which is not distributed"
            " with this package; the project's tests read the original file"
        },
        range_limits=range_limits,
        vendor_axes=("forward", "right", "up"),
        turn=turn,
        relatives={
            f"slamtec-rplidar-{other.lower()}": (
                "no document says how the data of the two models differ; the label on the sensor"
                " names the model"
                if {name, other} == {*SAME_MODEL_NUMBER}
                else "info.model"
            )
            for other in MODELS
            if other != name
        },
        # the firmware version is omitted: it has two fields, major and minor
        info={"serial": "info.serial", "model": "info.model"},
        status=status,
        source=f"RPLIDAR interface protocol and SDK; {source}",
    )


A1 = make_rplidar(
    "A1",
    link=Serial(115_200),
    motor=BY_DTR,
    unit=units.A1,
    range_limits=(0.15, 12.0),
    turn=(1.0, 10.0),  # A1M8 data sheet, scan rate
    status="vectors",
    source="A1M8 data sheet; captured exchange with an A1",
)
A2 = make_rplidar(
    "A2",
    link=Serial(115_200, 256_000),  # A2M8 and older; A2M7, A2M12
    motor=BY_PWM,
    unit=units.A2,
    range_limits=(0.15, 16.0),  # an A2M8 measures 0.15 to 12 m; the rest is assumed for the A2M7
    turn=(5.0, 15.0),
    status="manual",
    source="A2M8 data sheet rev. 2.5 (12 m, speed); the range of an A2M7 is assumed",
)
A3 = make_rplidar(
    "A3",
    link=Serial(256_000),
    motor=BY_PWM,
    unit=units.A3,
    range_limits=(0.2, 25.0),
    turn=(5.0, 15.0),
    status="vectors",
    source="A3M1 data sheet; the ultra capsules were built according to the SDK",
)
S1 = make_rplidar(
    "S1",
    link=Serial(256_000),
    motor=BY_SPEED,
    unit=units.S1,
    range_limits=(0.1, 40.0),
    turn=(8.0, 15.0),
    status="manual",
    source="ArduPilot's page of the S1 (40 m, speed); the shortest distance is assumed",
)
S2 = make_rplidar(
    "S2",
    link=Serial(1_000_000),
    motor=BY_SPEED,
    unit=units.S2,
    range_limits=(0.05, 30.0),
    status="manual",
    source="S2 data sheet",
)
S2L = make_rplidar(
    "S2L",
    link=Serial(1_000_000),
    motor=BY_SPEED,
    unit=units.S2,
    range_limits=(0.05, 18.0),
    status="manual",
    source="the range is assumed",
)
S3 = make_rplidar(
    "S3",
    link=Serial(1_000_000, 460_800),  # the second for the model number 82 (SDK)
    motor=BY_SPEED,
    unit=units.S3,
    range_limits=(0.05, 40.0),
    status="manual",
    source="the range is assumed",
)
T1 = make_rplidar(
    "T1",
    link=Udp(8089, stream=True),  # the sensor's address is 192.168.11.2 (sllidar_ros2)
    motor=BY_SPEED,
    unit=units.T1,
    range_limits=(0.05, 40.0),  # assumed: an S3's
    status="manual",
    source="port from sllidar_ros2; the range is assumed",
)
C1 = make_rplidar(
    "C1",
    link=Serial(460_800),
    motor=BY_SPEED,
    unit=units.C1,
    range_limits=(0.05, 12.0),
    status="manual",
    source="C1 data sheet",
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the RPLIDAR models."""
    return [A1, A2, A3, S1, S2, S2L, S3, T1, C1]
