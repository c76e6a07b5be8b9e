"""`sensors`, `show`, `plugins` and `trust`: the installed sensors and plugins."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

from lidarspec._version import __version__
from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.output import emit, emit_json, output_options, table
from lidarspec.cli.terminal import note, say
from lidarspec.errors import LidarSpecError, SpecError
from lidarspec.known_sensors import KnownLink, KnownSensor, list_sensors_from_table, no_sensors_text
from lidarspec.trusted_files import FILE, TRUSTED, trust as trusted, user_folder

if TYPE_CHECKING:
    from lidarspec.plugins import Plugin
    from lidarspec.sensor_operations import Sensor
    from lidarspec.spec.description import Command, Frame

#: Number of simulated packets for which a plan is made. A single packet is not enough, because some
#: packets of a revolution may be shorter.
PLANNED_PACKETS = 32


def list_sensors() -> tuple[list[KnownSensor], list[Plugin]]:
    """Return facts about each installed sensor, and the plugins that failed to load."""
    # If the plugins are loaded, the program may have registered sensors of its own.
    is_fresh = "lidarspec.plugins" not in sys.modules
    rows = list_sensors_from_table() if is_fresh else None
    if rows is not None:
        return rows, []
    from lidarspec.plugins import registry

    return registry().list_sensors(), registry().failures


def guide() -> str:
    """Return a text with the installed sensors, the ports, and the first commands."""
    from lidarspec.device.named_devices import read_devices
    from lidarspec.transports.ports import list_serial_ports

    installed, _ = list_sensors()
    ports = [port.path for port in list_serial_ports()]
    named = list(read_devices())
    example = installed[0].id if installed else "ID"
    source = (named or ports or [f"sim:{example}"])[0]
    vendors = {sensor.vendor for sensor in installed}
    lines = [
        f"lidarspec {__version__}",
        f"{len(installed)} sensors of {len(vendors)} vendors" if vendors else no_sensors_text(),
        f"serial ports: {', '.join(ports) or 'none'}",
    ]
    if named:
        lines.append(f"devices in {FILE}: {', '.join(named)}")
    commands = {
        "demo": "simulate a sensor, and draw it",
        "sensors": "list the installed sensors",
        "detect": "find the sensor that sends",
        f"view {source}": "draw the points of the sensor",
        f"record {source} -o a.lsr -t 10s": "record the sensor for 10 s",
        "convert a.lsr points.csv": "write the points to a file",
        "explain a.lsr -n 1": "explain every byte of a frame",
        "doctor": "diagnose why no data arrives",
    }
    width = max(len(command) for command in commands)
    lines.append("")
    lines += [f"  lidarspec {command:<{width}}  {text}" for command, text in commands.items()]
    lines += ["", "lidarspec help lists all verbs; lidarspec help VERB lists the options of a verb"]
    return "\n".join(lines)


@click.command()
@output_options
def sensors(as_json: bool, output: str | None) -> None:
    """List the installed sensors, and how each was verified."""
    installed, broken = list_sensors()
    if as_json:
        from lidarspec.plugins import registry

        homes = {row.id: row.distribution for row in installed}
        loaded = registry().sensors()
        broken = registry().failures
        emit_json(
            [
                _sensor_to_dict(sensor) | {"distribution": homes.get(name, "")}
                for name, sensor in loaded.items()
            ],
            output,
        )
    elif installed:
        rows = [
            [
                row.id,
                f"{row.vendor} {row.model}",
                _format_links(row.links),
                row.status,
                row.distribution,
            ]
            for row in installed
        ]
        emit(table(["id", "device", "link", "status", "distribution"], rows, output), output)
    if not installed:
        note(no_sensors_text())
    if broken:
        note(
            f"{len(broken)} plugin{'s' * (len(broken) > 1)} could not be loaded;"
            " to see why, run lidarspec plugins"
        )


@click.command()
@click.argument("sensor_id", metavar="SENSOR")
@click.option(
    "--plan",
    "as_plan",
    is_flag=True,
    help="Show how points are computed, and which values need the reference evaluator, a slow"
    " general method.",
)
@output_options
def show(sensor_id: str, as_plan: bool, as_json: bool, output: str | None) -> None:
    """Describe a sensor, with a table of the fields of each frame."""
    from lidarspec.frames.wire_table import frame_size, wire_table
    from lidarspec.plugins import sensor as named_sensor, summarize_links

    sensor = named_sensor(sensor_id)
    if as_plan:
        plans = {name: _list_plan(sensor, name) for name in sensor.data_frames}
        emit_json(plans, output) if as_json else emit(
            "\n".join(line for name in plans for line in (f"{name}:", *plans[name])), output
        )
        return
    if as_json:
        frames = {name: _frame_to_dict(frame) for name, frame in sensor.frames.items()}
        commands = {
            name: _command_to_dict(sensor.commands[name], data)
            for name, data in _build_commands(sensor, sensor_id).items()
        }
        emit_json({**_sensor_to_dict(sensor), "frames": frames, "commands": commands}, output)
        return
    from lidarspec.explaining.formatting import (
        describe_declared_clock,
        describe_declared_status,
        describe_losses,
    )

    clock = ""
    if sensor.clock is not None:
        clock = f"\n  clock   {describe_declared_clock(sensor.clock)}"
        if sensor.clock.status is not None:
            clock += f"\n  lock    {describe_declared_status(sensor.clock)}"
    clock = clock.replace("`", "")
    losses = describe_losses(sensor).replace("`", "")
    links = _format_links(summarize_links(sensor))
    parts = [
        f"{sensor.id}: {sensor.vendor} {sensor.model}"
        + (f", also {', '.join(sensor.aliases)}" if sensor.aliases else ""),
        f"  link    {links}\n{_format_range(sensor)}  losses  {losses}{clock}"
        f"\n  status  {sensor.status}\n  source  {sensor.source}",
    ]
    if sensor.info:
        facts = [
            f"{name} ({fact.paths[0]}{_format_unit(sensor, fact.paths[0])})"
            for name, fact in sensor.reported.items()
        ]
        parts.append(f"  reports {', '.join(facts)}")
    parts += [
        f"  command {name}{_format_command(sensor, name, data)}"
        for name, data in _build_commands(sensor, sensor_id).items()
    ]
    for name, frame in sensor.frames.items():
        rows = [
            [row.offset, row.size, row.type, row.field, row.unit, row.meaning]
            for row in wire_table(frame)
        ]
        if frame.direction == "out":
            kind = " (to the sensor)"
        elif frame.data:
            kind = " (points)"
        else:
            kind = ""
        headers = ["offset", "size", "type", "field", "unit", "meaning"]
        parts.append(f"\n{name}{kind}: {frame_size(frame)} bytes\n{table(headers, rows, output)}")
    emit("\n".join(parts), output)


def _format_range(sensor: Sensor) -> str:
    if sensor.range_limits is None:
        return ""
    low, high = sensor.range_limits
    return f"  range   {low:g} .. {high:g} m\n"


def _format_unit(sensor: Sensor, path: str) -> str:
    """Return a comma and the unit of a field, such as ", m"; "" without a unit.

    Args:
        path: the field, as "frame.path".
    """
    from lidarspec.frames.schema import make_schema

    frame, _, field = path.partition(".")
    if frame in sensor.frames:
        unit = make_schema(sensor.frames[frame].tree).scan_names[field].unit
    else:
        unit = ""
    if unit:
        return f", {unit}"
    return ""


def _list_plan(sensor: Sensor, frame: str) -> list[str]:
    """Return lines that describe how the points of a frame type are computed."""
    from lidarspec.frames.frame_table import CompiledTable
    from lidarspec.framing.results import Counters, Found, pack_found
    from lidarspec.packets.stream import PacketStream
    from lidarspec.points.numpy_plan import describe
    from lidarspec.points.plan import Plan, plan_for
    from lidarspec.simulation.frame_maker import FrameMaker

    try:
        maker = FrameMaker(sensor, frame)
        sweep = sensor.simulation_of(frame).sweep
    except SpecError as error:
        return [f"reference evaluator: {error}"]
    if sweep:
        frames = maker.make_frames(maker.table([sweep(index) for index in range(PLANNED_PACKETS)]))
    else:
        frames = [sensor.example(frame)]
    sent = pack_found([Found(frame, 0, data) for data in frames])
    packets = PacketStream(sensor, frame, Counters()).add([sent]).with_points
    if not isinstance(packets.table, CompiledTable) or not packets.table.groups:
        return [
            "reference evaluator: a faster method requires that the struct can be compiled, and"
            " that the example frame has points"
        ]
    largest = max(packets.table.groups, key=lambda group: group.layout.size)
    plan = plan_for(sensor.points_of(packets.frame), packets.batch(), largest)
    if isinstance(plan, Plan):
        return describe(plan)
    return [f"reference evaluator: {plan}"]


@click.command()
@output_options
@click.pass_context
def plugins(ctx: click.Context, as_json: bool, output: str | None) -> None:
    """List the installed plugins, with the error of each plugin that fails.

    All plugins are loaded in one separate process. If a plugin makes this process hang or exit,
    each plugin is loaded in a process of its own, to find the plugin at fault. The exit code is 1
    if a plugin fails.
    """
    from lidarspec.plugins import try_plugins

    tried = try_plugins()
    rows = [[p.distribution, p.version, p.entry_point, _describe_plugin(p)] for p in tried]
    if as_json:
        emit_json([{**vars(plugin), "sensors": list(plugin.sensors)} for plugin in tried], output)
    else:
        emit(
            table(["distribution", "version", "entry point", "sensors"], rows, output)
            if rows
            else no_sensors_text(),
            output,
        )
    if any(plugin.error or plugin.remark for plugin in tried):
        ctx.exit(FINDINGS)


def _describe_plugin(plugin: Plugin) -> str:
    """Return the sensors of a plugin, and its error."""
    if plugin.error and not plugin.sensors:
        error = f"not loaded: {plugin.error}"
    else:
        error = plugin.error
    return "; ".join(part for part in (", ".join(plugin.sensors), error, plugin.remark) if part)


@click.command()
@click.argument("folder", default=".")
def trust(folder: str) -> None:
    """Trust a folder, so that its lidarspec.toml may name Python files.

    The lidarspec.toml of a trusted folder may also name files outside the folder. Trust only your
    own folders, with files that you know. The decision is stored in your settings, and applies to
    all later runs. LIDARSPEC_TRUST=FOLDER trusts a folder for a single run.
    """
    say(f"{trusted(folder)}: its {FILE} is now trusted (stored in {user_folder() / TRUSTED})")


def _sensor_to_dict(sensor: Sensor) -> dict[str, Any]:
    """Return the facts about a sensor as a JSON object."""
    from lidarspec.exports.json import link_data, select_attributes

    return {
        **select_attributes(sensor, "id", "vendor", "model", "status", "source", "aliases"),
        "links": {name: link_data(link) for name, link in sensor.links.items()},
        "frames": list(sensor.frames),
        "commands": list(sensor.commands),
        **select_attributes(sensor, "range_limits"),
        "info": {name: fact.paths[0] for name, fact in sensor.reported.items()},
    }


def _frame_to_dict(frame: Frame) -> dict[str, Any]:
    from lidarspec.exports.json import select_attributes
    from lidarspec.frames.wire_table import frame_size, wire_table

    rows = [vars(row) for row in wire_table(frame)]
    return {
        **select_attributes(frame, "direction", "data"),
        "size": frame_size(frame),
        "max_length": frame.max_length,
        "rows": rows,
    }


def _build_commands(sensor: Sensor, sensor_id: str) -> dict[str, bytes]:
    """Return the frame of each command, by name; b"" if a command has arguments or no frame.

    Prints a remark for each command that cannot be built.

    Args:
        sensor_id: the sensor as the user named it, for the remark.
    """
    built = dict[str, bytes]()
    for name, command in sensor.commands.items():
        built[name] = b""
        if command.frame is None or command.arguments:
            continue
        try:
            built[name] = sensor.command(name)
        except LidarSpecError as error:
            check = f"lidarspec check {shlex.quote(sensor_id)}"
            note(f"command {name} cannot be built: {error}; next: {check}")
    return built


def _command_to_dict(command: Command, data: bytes) -> Mapping[str, Any]:
    return {
        "frame": command.frame,
        "arguments": {name: argument.to_dict() for name, argument in command.arguments.items()},
        "hex": data.hex(" "),
        "reply": " or ".join(command.replies) or None,
        "only_stopped": command.only_stopped,
    }


def _format_command(sensor: Sensor, name: str, data: bytes) -> str:
    from lidarspec.explaining.formatting import describe_argument

    command = sensor.commands[name]
    text = "".join(
        f" {argument}={describe_argument(sensor, name, argument)}" for argument in command.arguments
    )
    if data:
        text += f": {data.hex(' ')}"
    if command.replies:
        text += f", reply {' or '.join(command.replies)}"
        if command.only_stopped:
            text += " (only while stopped)"
    return text


def _format_links(links: Mapping[str, KnownLink]) -> str:
    return ", ".join(_format_link(link) for link in links.values())


def _format_link(link: KnownLink) -> str:
    unit = "baud" if link.kind == "serial" else ""
    return f"{link.kind} {'/'.join(map(str, link.numbers))} {unit}".strip()
