"""Ouster OS0, OS1, OS2 and OSDome: columns of pixels over UDP.

The layout of packets and the directions of beams are read from the metadata of the sensor. The
metadata are in a file (`configure(metadata=path)`), or are requested from the sensor's web server
when the sensor is opened. Without metadata, the user can pass a layout (`rows`, `turn`, `profile`),
and the angles are the nominal angles of an ideal sensor.

Source: Software User Manual of firmware 2.x and 3.x (coordinates, HTTP API); ouster-sdk
(parsing.cpp, xyzlut.cpp, sensor_http_imp.cpp). The fields of view, and the positions of the beam
origins of OS0, OS1 and OS2, are from the data sheets and from one captured unit of each model. The
range limits are from the data sheets, for bright targets.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarspec import UsageError
from lidarspec.spec import (
    Clock,
    Command,
    Fields,
    Frame,
    Http,
    HttpReply,
    HttpRequest,
    Learned,
    OnChange,
    Polar,
    Sensor,
    Simulation,
    Text,
    Udp,
    along,
    hookimpl,
    stack,
    take,
)
from lidarspec_ouster.metadata import IDENTITY, TIME_EPOCHS, Table, Unit, read_unit
from lidarspec_ouster.packets import (
    COLUMNS,
    ENCODER_COUNTS_PER_TURN,
    PROFILES,
    VALID,
    make_imu_frame,
    make_lidar_frame,
)
from lidarspec_ouster.recognition import recognise

#: Model -> product line, elevation of the lowest and of the highest beam in degrees, distance of
#: the beam origin from the axis in mm, height of the lidar in mm, range limits in m.
MODELS = {
    "OS0": ("OS-0", -45.0, 45.0, 27.67, 36.18, (0.3, 100.0)),
    "OS1": ("OS-1", -22.5, 22.5, 15.806, 36.18, (0.3, 200.0)),
    "OS2": ("OS-2", -11.25, 11.25, 13.762, 74.296, (0.8, 500.0)),
    "OSDome": ("OS-DOME", 0.0, 90.0, 0.0, 36.18, (0.3, 45.0)),
}
#: The pixel fields that become columns in `extra`.
EXTRA_FIELDS = ("signal", "near_ir", "flags", "window", "zone_mask", "red", "green", "blue")
METADATA_ONLY = "both models send the same packets; only the metadata tell which model it is"


def points(f: Fields, unit: Unit) -> Polar:
    """Return the points of the pixels, calculated with the beams of the sensor."""
    columns = f.columns
    bits = PROFILES[unit.profile]
    names = dict.fromkeys(name for name in bits if name[0] != "_" and name[-1] != "2")

    def pixel_values(name: str) -> Any:
        column = getattr(columns.pixels, name)
        if "range2" in bits:
            return stack(column, getattr(columns.pixels, f"{name}2", column))
        return column

    column_number = columns.measurement_id
    is_legacy = unit.profile == "LEGACY"

    def column_table(rows: Table) -> Any:
        if np.ptp(rows, axis=0).max() < 1e-12:
            return along("pixels", rows[0])
        return take(rows, column_number)

    directions, starts = unit.compute_beams()
    return Polar(
        range=pixel_values("range"),
        azimuth=column_table(np.arctan2(directions[..., 1], directions[..., 0])),
        elevation=column_table(np.arcsin(directions[..., 2])),
        intensity=pixel_values("reflectivity"),
        time=(columns.timestamp - columns[0].timestamp) * 1e-9,
        ring=columns.pixels.index,
        return_index=np.arange(2) if "range2" in bits else None,
        invalid=(columns.status != VALID) if is_legacy else (columns.status.valid != 1),
        origin=(
            column_table(starts[..., 0]),
            column_table(starts[..., 1]),
            column_table(starts[..., 2]),
        ),
        nominal=unit.nominal,
        column=column_number,
        extra={name: pixel_values(name) for name in names if name in EXTRA_FIELDS},
    )


def pace(f: Fields, columns: int) -> Any:
    """Return the seconds from a packet to the next, from the times of its columns.

    Source: Software User Manual, lidar data packet format (timestamps in nanoseconds).
    """
    span = f.columns[columns - 1].timestamp - f.columns[0].timestamp
    return span * 1e-9 * columns / (columns - 1)


def sweep(unit: Unit, i: int) -> dict[str, Any]:
    """Return the values of simulated packet i."""
    numbers = unit.columns * i + np.arange(unit.columns)
    turn_numbers = numbers % unit.turn
    times = numbers * (1_000_000_000 // (unit.turn * int(unit.rate or 10)))
    shared = {"columns.timestamp": times, "columns.measurement_id": turn_numbers}
    if unit.profile == "LEGACY":
        shared |= {
            "columns.frame_id": numbers // unit.turn % 65536,
            "columns.encoder": turn_numbers * (ENCODER_COUNTS_PER_TURN // unit.turn),
        }
        return {**shared, "columns.status": np.full(unit.columns, VALID)}
    return {
        **shared,
        "columns.status.valid": np.ones(unit.columns),
        "frame_id": numbers[0] // unit.turn % 65536,
        "serial": int(unit.serial or 0),
    }


def apply_unit(sensor: Sensor, unit: Unit) -> Sensor:
    """Return the sensor with the layout and the beams of a sensor."""
    rotation = tuple(map(tuple, unit.imu[:3, :3].tolist()))
    frames = {
        "data": make_lidar_frame(unit.profile, unit.rows, unit.columns, unit.turn),
        "imu": make_imu_frame(unit.samples, rotation),
        **HTTP,
    }
    is_legacy = unit.profile == "LEGACY"
    return dataclasses.replace(
        sensor,
        frames=frames,
        points=partial(points, unit=unit),
        scan=OnChange(
            "columns[0].frame_id" if is_legacy else "frame_id",
            angle="columns[0].measurement_id",
            full=unit.turn,
        ),
        clock=Clock(
            "columns[0].timestamp",
            pace=partial(pace, columns=unit.columns) if unit.columns > 1 else None,
            epoch=TIME_EPOCHS.get(unit.timestamp_mode, ""),
        ),
        info={} if is_legacy else {"serial": "data.serial"},
        simulation=Simulation(
            partial(sweep, unit),
            answers={"get_metadata": (("reply", {"status": 200, "body": unit.to_metadata()}),)},
        ),
    )


def make_nominal_unit(model: str, rows: int, turn: int, profile: str) -> Unit:
    """Return a unit with the values of the data sheet.

    Args:
        rows: the number of pixels per column.
        turn: the number of columns per revolution.
        profile: the packing of pixels, a key of `PROFILES`.
    """
    line, low, high, beam_origin, height, _ = MODELS[model]
    beam_transform = np.eye(4)
    lidar_transform = np.diag([-1.0, -1.0, 1.0, 1.0])
    beam_transform[0, 3] = beam_origin
    lidar_transform[2, 3] = height
    imu_transform = np.array(IDENTITY).reshape(4, 4)
    azimuth = np.zeros(rows)
    shifts = np.zeros(rows, np.int64)
    elevation = np.linspace(high, low, rows)
    window = (0, turn - 1)
    return Unit(
        profile,
        turn,
        COLUMNS,
        window,
        10.0,
        elevation,
        azimuth,
        shifts,
        beam_transform,
        lidar_transform,
        imu_transform,
        product=f"{line}-{rows}",
        nominal=True,
    )


def configure(
    sensor: Sensor,
    *,
    metadata: str | Path | Learned | None = None,
    rows: int | None = None,
    turn: int | None = None,
    profile: str | None = None,
) -> Sensor:
    """Return the sensor with the layout and the beams of a sensor.

    Args:
        metadata: the sensor's JSON file, as its web server returns it at /api/v1/sensor/metadata.
        rows: the number of pixels per column of a nominal unit, 16 to 128.
        turn: the number of columns per revolution of a nominal unit, 512 to 4096.
        profile: the packing of pixels of a nominal unit, such as RNG19_RFL8_SIG16_NIR16.

    Raises:
        UsageError: if the metadata cannot be read or belong to another model, or if the layout does
            not exist.
    """
    arguments = {"rows": rows, "turn": turn, "profile": profile}
    arguments = {name: value for name, value in arguments.items() if value is not None}
    metadata = metadata or (None if arguments else sensor.options.get("metadata"))
    if metadata is not None:
        if arguments:
            names = " and ".join(arguments)
            raise UsageError(
                f"{sensor.id}: {names} cannot be set if metadata are given, because the metadata"
                f" contain {names}"
            )
        unit = read_unit(metadata)
        models = [
            name for name, (line, *_) in MODELS.items() if unit.product.upper().startswith(line)
        ]
        if models and models[0] != sensor.model:
            raise UsageError(
                f"{sensor.id}: the metadata are those of an {unit.product}: use -s"
                f" ouster-{models[0].lower()}"
            )
        return dataclasses.replace(apply_unit(sensor, unit), on_open=())
    layout = {
        **DEFAULT_LAYOUT,
        **{name: value for name, value in sensor.options.items() if name in DEFAULT_LAYOUT},
        **arguments,
    }
    for name, maximum in (("rows", 128), ("turn", 4096)):
        if not 16 <= layout[name] <= maximum or layout[name] % 16:
            raise UsageError(
                f"{sensor.id}: {name} must be a multiple of 16 up to {maximum}, not {layout[name]}"
            )
    if layout["profile"] not in PROFILES:
        raise UsageError(
            f"{sensor.id}: profile must be one of {', '.join(PROFILES)}, not {layout['profile']!r}"
        )
    return apply_unit(sensor, make_nominal_unit(sensor.model, **layout))


#: The default layout, which has few rows so that a simulation is fast.
DEFAULT_LAYOUT: dict[str, Any] = {"rows": 16, "turn": 1024, "profile": "RNG19_RFL8_SIG16_NIR16"}
HTTP = {
    "ask": Frame(HttpRequest, direction="out", max_length=65_536),
    "reply": Frame(HttpReply, max_length=1 << 18),
}


def make_request(method: str, path: str, body: str = "", **more: Any) -> Command:
    """Return the command for a request to the web server."""
    values = {"method": method, "path": f"/api/v1/{path}".encode(), "body": body.encode()}
    return Command("ask", values, reply="reply", link="http", timeout=6.0, **more)


COMMANDS = {
    "get_metadata": make_request(
        "GET", "sensor/metadata", learns=lambda reply: {"metadata": reply.body}
    ),
    "get_config": make_request("GET", "sensor/config"),
    "set_config": dataclasses.replace(
        make_request("POST", "sensor/config"), args={"json": ("body", Text(4096))}
    ),
    "start": make_request("POST", "sensor/config", '{"operating_mode": "NORMAL"}'),
    "standby": make_request("POST", "sensor/config", '{"operating_mode": "STANDBY"}'),
    "send_here": make_request("POST", "sensor/cmd/set_udp_dest_auto"),
    "reinitialize": make_request("POST", "sensor/cmd/reinitialize"),
    "save_config": make_request("POST", "sensor/cmd/save_config_params"),
    "get_firmware": make_request("GET", "system/firmware"),
    "get_network": make_request("GET", "system/network"),
}


def make_model(name: str, status: str) -> Sensor:
    """Return the sensor of a model of the family."""
    limits = MODELS[name][-1]
    unit = make_nominal_unit(name, **DEFAULT_LAYOUT)
    sensor = Sensor(
        f"ouster-{name.lower()}",
        vendor="Ouster",
        model=name,
        frames=HTTP,
        points=None,
        scan=OnChange("frame_id"),
        links={"data": Udp(7502, 7503), "http": Http(80)},
        commands=COMMANDS,
        configure=configure,
        recognise=recognise,
        on_open=("get_metadata",),
        range_limits=limits,
        returns=("varying", "varying"),  # the return order is a setting of newer firmware
        vendor_axes=("forward", "left", "up"),
        turn=(5, 20),
        relatives={f"ouster-{other.lower()}": METADATA_ONLY for other in MODELS if other != name},
        status=status,
        source=(
            "Ouster Software User Manual 2.x and 3.x; ouster-sdk, parsing.cpp, xyzlut.cpp and its"
            " captures"
        ),
    )
    return apply_unit(sensor, unit)


OS0, OS1, OS2, OSDOME = (
    make_model(name, status)
    for name, status in zip(MODELS, ("capture", "capture", "capture", "manual"), strict=True)
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Ouster sensors."""
    return [OS0, OS1, OS2, OSDOME]
