"""Ouster OS0, OS1, OS2 and OSDome: columns of pixels over UDP, whose layout and directions come
with the unit's metadata.

The metadata are a file, `configure(metadata=path)`, or are fetched from the sensor's web server
when it is opened. Without them a layout can be named (`rows`, `turn`, `profile`), and the angles
are those of an ideal sensor, evenly over its field of view: `nominal`.

Source: Software User Manual of firmware 2.x and 3.x (coordinates, HTTP API); ouster-sdk
(parsing.cpp, xyzlut.cpp, sensor_http_imp.cpp). The fields of view, and the offsets of OS0, OS1 and
OS2, are those of the data sheets and of one captured unit each; the limits of range are the data
sheets', for bright targets.
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
from lidarspec_ouster.metadata import STILL, Table, Unit, read
from lidarspec_ouster.packets import COLUMNS, ENCODER, PROFILES, VALID, imu, lidar
from lidarspec_ouster.recognition import recognise

#: model -> product line, degrees of the lowest and the highest beam, mm where beams leave and of
#: the lidar's height, limits of range in m.
MODELS = {
    "OS0": ("OS-0", -45.0, 45.0, 27.67, 36.18, (0.3, 100.0)),
    "OS1": ("OS-1", -22.5, 22.5, 15.806, 36.18, (0.3, 200.0)),
    "OS2": ("OS-2", -11.25, 11.25, 13.762, 74.296, (0.8, 500.0)),
    "OSDome": ("OS-DOME", 0.0, 90.0, 0.0, 36.18, (0.3, 45.0)),
}
#: of the extra columns, those that each return has for itself.
EXTRA = ("signal", "near_ir", "flags", "window", "zone_mask", "red", "green", "blue")
TOLD_BY = "identical packets; see the model in the metadata"


def points(f: Fields, unit: Unit) -> Polar:
    """Pixels by the tables of the unit; of two returns, side by side."""
    columns = f.columns
    bits = PROFILES[unit.profile]
    names = dict.fromkeys(name for name in bits if name[0] != "_" and name[-1] != "2")

    def each(name: str) -> Any:
        column = getattr(columns.pixels, name)
        if "range2" in bits:
            return stack(column, getattr(columns.pixels, f"{name}2", column))
        return column

    number = columns.measurement_id
    legacy = unit.profile == "LEGACY"

    def table(rows: Table) -> Any:
        if np.ptp(rows, axis=0).max() < 1e-12:
            return along("pixels", rows[0])
        return take(rows, number)

    directions, starts = unit.beams()
    return Polar(
        range=each("range"),
        azimuth=table(np.arctan2(directions[..., 1], directions[..., 0])),
        elevation=table(np.arcsin(directions[..., 2])),
        intensity=each("reflectivity"),
        time=(columns.timestamp - columns[0].timestamp) * 1e-9,
        ring=columns.pixels.index,
        return_index=np.arange(2) if "range2" in bits else None,
        invalid=(columns.status != VALID) if legacy else (columns.status % 2 != 1),
        origin=(table(starts[..., 0]), table(starts[..., 1]), table(starts[..., 2])),
        nominal=unit.nominal,
        column=number,
        extra={name: each(name) for name in names if name in EXTRA},
    )


def pace(f: Fields, columns: int) -> Any:
    """Return the seconds from a packet to the next, by the times of its columns.

    Each column has a timestamp in nanoseconds (Software User Manual, lidar data packet format).
    """
    span = f.columns[columns - 1].timestamp - f.columns[0].timestamp
    return span * 1e-9 * columns / (columns - 1)


def sweep(unit: Unit, i: int) -> dict[str, Any]:
    """Packet i, at ten turns a second where nothing else is said."""
    numbers = unit.columns * i + np.arange(unit.columns)
    places = numbers % unit.turn
    times = numbers * (1_000_000_000 // (unit.turn * int(unit.rate or 10)))
    shared = {"columns.timestamp": times, "columns.measurement_id": places}
    if unit.profile == "LEGACY":
        shared |= {
            "columns.frame_id": numbers // unit.turn % 65536,
            "columns.encoder": places * (ENCODER // unit.turn),
        }
        return {**shared, "columns.status": np.full(unit.columns, VALID)}
    return {
        **shared,
        "columns.status": np.ones(unit.columns),
        "frame_id": numbers[0] // unit.turn % 65536,
        "serial": int(unit.serial or 0),
    }


def with_unit(sensor: Sensor, unit: Unit) -> Sensor:
    """Return the sensor with the layout and the beams of a unit."""
    turned = tuple(map(tuple, unit.imu[:3, :3].tolist()))
    frames = {
        "data": lidar(unit.profile, unit.rows, unit.columns, unit.turn),
        "imu": imu(unit.samples, turned),
        **HTTP,
    }
    legacy = unit.profile == "LEGACY"
    return dataclasses.replace(
        sensor,
        frames=frames,
        points=partial(points, unit=unit),
        scan=OnChange(
            "columns[0].frame_id" if legacy else "frame_id",
            angle="columns[0].measurement_id",
            full=unit.turn,
        ),
        clock=Clock(
            "columns[0].timestamp",
            pace=partial(pace, columns=unit.columns) if unit.columns > 1 else None,
        ),
        info={} if legacy else {"serial": "data.serial"},
        simulation=Simulation(
            partial(sweep, unit),
            answers={"get_metadata": (("reply", {"status": 200, "body": unit.to_metadata()}),)},
        ),
    )


def nominal(model: str, rows: int, turn: int, profile: str) -> Unit:
    """Return a unit as the data sheet has it."""
    line, low, high, out, height, _ = MODELS[model]
    beam = np.eye(4)
    lifted = np.diag([-1.0, -1.0, 1.0, 1.0])
    beam[0, 3], lifted[2, 3] = out, height
    still = np.array(STILL).reshape(4, 4)
    level = np.zeros(rows)
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
        level,
        shifts,
        beam,
        lifted,
        still,
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
    """The sensor with the layout and the beams of a unit; or with a layout alone, and nominal
    beams.

    Args:
        metadata: the JSON file of the unit, such as its web server gives at
            /api/v1/sensor/metadata.
        rows: pixels of a column, 16 to 128.
        turn: columns of a turn, 512 to 4096.
        profile: how pixels are packed, RNG19_RFL8_SIG16_NIR16 and others.

    Raises:
        UsageError: for metadata that cannot be read, or are of another model; for a layout that
            there is not.
    """
    given = {"rows": rows, "turn": turn, "profile": profile}
    given = {name: value for name, value in given.items() if value is not None}
    metadata = metadata or (None if given else sensor.options.get("metadata"))
    if metadata is not None:
        if given:
            raise UsageError(
                f"{sensor.id}: the metadata contain {' and '.join(given)}: omit this option"
            )
        unit = read(metadata)
        known = [
            name for name, (line, *_) in MODELS.items() if unit.product.upper().startswith(line)
        ]
        if known and known[0] != sensor.model:
            raise UsageError(
                f"{sensor.id}: the metadata belong to an {unit.product}: use -s"
                f" ouster-{known[0].lower()}"
            )
        return dataclasses.replace(with_unit(sensor, unit), on_open=())
    layout = {
        **LAYOUT,
        **{name: value for name, value in sensor.options.items() if name in LAYOUT},
        **given,
    }
    for name, most in (("rows", 128), ("turn", 4096)):
        if not 16 <= layout[name] <= most or layout[name] % 16:
            raise UsageError(
                f"{sensor.id}: {name} must be a multiple of 16 up to {most}, not {layout[name]}"
            )
    if layout["profile"] not in PROFILES:
        raise UsageError(
            f"{sensor.id}: profile must be one of {', '.join(PROFILES)}, not {layout['profile']!r}"
        )
    return with_unit(sensor, nominal(sensor.model, **layout))


#: a layout to begin with: few rows, so that a simulation of it is quick.
LAYOUT: dict[str, Any] = {"rows": 16, "turn": 1024, "profile": "RNG19_RFL8_SIG16_NIR16"}
HTTP = {
    "ask": Frame(HttpRequest, direction="out", max_length=65_536),
    "reply": Frame(HttpReply, max_length=1 << 18),
}


def make_request(method: str, path: str, body: str = "", **more: Any) -> Command:
    """Return a request to the web server."""
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


def model(name: str, status: str) -> Sensor:
    """Return a model of the family."""
    limits = MODELS[name][-1]
    unit = nominal(name, **LAYOUT)
    bare = Sensor(
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
        vendor_axes=("forward", "left", "up"),
        turn=(5, 20),
        relatives={f"ouster-{other.lower()}": TOLD_BY for other in MODELS if other != name},
        status=status,
        source=(
            "Ouster Software User Manual 2.x and 3.x; ouster-sdk, parsing.cpp, xyzlut.cpp and its"
            " captures"
        ),
    )
    return with_unit(bare, unit)


OS0, OS1, OS2, OSDOME = (
    model(name, status)
    for name, status in zip(MODELS, ("capture", "capture", "capture", "manual"), strict=True)
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The Ouster sensors."""
    return [OS0, OS1, OS2, OSDOME]
