"""`sim` and `demo`: simulate a sensor on a port or in a file, and demonstrate one."""

from __future__ import annotations

import shlex
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.options import (
    DURATION,
    SHARE,
    configuration_options,
    count_option,
    sensor_option,
)
from lidarspec.cli.output import Progress, emit_json, format_size, render
from lidarspec.cli.terminal import handle_sigterm, note, say
from lidarspec.detect.identification import format_sensor_options, verb_to_show
from lidarspec.device.demo import Demonstration, demonstrate
from lidarspec.errors import UsageError, suggest
from lidarspec.known_sensors import no_sensors_text
from lidarspec.plugins import registry, sensor as named_sensor
from lidarspec.points.appearance import choose_appearance
from lidarspec.recording.recorders import SUFFIXES
from lidarspec.scans.scan import Scan
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.clock_faults import ClockFaults, parse_clock_faults
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.simulation.faults import BLOCKED, Faults
from lidarspec.simulation.scenes import read_scene
from lidarspec.spec.links import Serial
from lidarspec.transports.base import find_data_link
from lidarspec.transports.destinations import make_simulated_outlet
from lidarspec.transports.outlets import LOCALHOST, Outlet, has_terminals
from lidarspec.transports.serving import serve
from lidarspec.transports.simulated import parse_rate
from lidarspec.transports.simulated_files import write_file
from lidarspec.view.polar import draw_cloud

if TYPE_CHECKING:
    from rich.text import Text

#: Default duration of a file, in seconds.
FILE_DURATION_S = 10.0
#: Maximum width of the picture, in characters.
MAX_PICTURE_COLUMNS = 100
#: Minimum and maximum height of the picture, in lines.
MIN_PICTURE_LINES = 12
MAX_PICTURE_LINES = 42
#: Number of lines of the terminal that are kept free for the summary.
SUMMARY_LINES = 8
#: Help text of --to.
PLACES = (
    f"pty, udp://HOST:PORT, tcp://HOST:PORT, or a file ({', '.join(SUFFIXES)}).  [default: pty or"
    " udp]"
)


@click.command(short_help="Simulate a sensor on a serial port, UDP, TCP or in a file.")
@click.argument("sensor_id", metavar="SENSOR")
@configuration_options
@click.option("--to", metavar="PLACE", help=PLACES)
@click.option("--link", metavar="PATH", help="Create a symbolic link to the pty at this path.")
@click.option(
    "-t",
    "--duration",
    type=DURATION,
    help="Stop after this time.  [default: never; for a file, 10s]",
)
@click.option(
    "--rate",
    metavar="FACTOR",
    default="1",
    show_default=True,
    help="Speed relative to the real sensor; max is as fast as possible.",
)
@click.option(
    "--scene",
    metavar="FILE",
    help="TOML file with the scene that the sensor measures.  [default: a room]",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    metavar="N",
    default=0,
    show_default=True,
    help="Random seed for the room and the errors.",
)
@click.option(
    "--errors",
    type=SHARE,
    default="0%",
    show_default=True,
    help="Share of bytes to corrupt.",
)
@click.option(
    "--loss",
    type=SHARE,
    default="0%",
    show_default=True,
    help="Share of packets to drop.",
)
@click.option(
    "--reorder",
    type=click.IntRange(0, 1000),
    metavar="N",
    default=0,
    show_default=True,
    help="Delay some datagrams, each by up to N datagrams.",
)
@click.option(
    "--unplug",
    type=DURATION,
    help="Disconnect the sensor whenever it has been connected for this time.",
)
@click.option(
    "--shake",
    type=click.FloatRange(min=0),
    default=0.0,
    metavar="NOISE",
    help="Standard deviation of the IMU noise, in m/s2 and rad/s.",
)
@click.option(
    "--absent",
    type=DURATION,
    default="2s",
    show_default=True,
    help="With --unplug: time for which the sensor stays disconnected.",
)
@click.option(
    "--clock",
    metavar="FAULT,...",
    help="Time scale of the clock (utc, tai or gps) and faults to simulate, separated by commas:"
    " drift=50ppm (the clock is fast), step=0.2s@10s (it jumps forward), pps@10s (it counts a pulse"
    " twice), leap@10s (it repeats a second), unlock=5s@10s (it is not locked for 5 s), restart@10s"
    " (it starts again as after power-on). @10s means 10 s after power-on.",
)
@click.option("--rotor", type=click.Choice([BLOCKED]), help="Simulate a blocked rotor.")
@click.option("--force", is_flag=True, help="Overwrite an existing file.")
@click.option(
    "--json", "as_json", is_flag=True, help="Print the address of the simulated sensor as JSON."
)
def sim(
    sensor_id: str | Sensor,
    to: str | None,
    link: str | None,
    duration: float | None,
    rate: str,
    scene: str | None,
    seed: int,
    errors: float,
    loss: float,
    reorder: int,
    unplug: float | None,
    absent: float,
    shake: float,
    rotor: str | None,
    clock: str | None,
    force: bool,
    as_json: bool,
) -> None:
    """Simulate a sensor on a serial port, UDP, TCP or in a file.

    The simulated sensor behaves as its spec describes: it sends data in real time, replies to
    commands, starts and stops. Its address is printed on standard output; all other text is printed
    on standard error.
    """
    sensor = named_sensor(sensor_id)
    clock_faults = ClockFaults() if clock is None else parse_clock_faults(clock)
    faults = Faults(
        errors=errors,
        loss=loss,
        reorder=reorder,
        unplug=unplug or 0.0,
        absent=absent,
        rotor=rotor or "",
        shake=shake,
        clock=clock_faults,
    )
    simulated_scene = read_scene(scene) if scene is not None else None
    device = SimulatedDevice(
        sensor, scene=simulated_scene, seed=seed, rate=parse_rate(rate), faults=faults
    )
    target = to or ("udp://" if sensor.datagrams else "pty")
    if target == "pty" or "://" in target:
        _serve(device, target, link, duration, as_json=as_json)
        return
    if link is not None:
        raise UsageError("--link requires --to pty")
    if Path(target).suffix.lower() not in SUFFIXES:
        raise UsageError(
            f"--to {target}: expected pty, udp://HOST:PORT, tcp://HOST:PORT, or a file"
            f" ({', '.join(SUFFIXES)})"
        )
    written = write_file(device, target, duration or FILE_DURATION_S, overwrite=force)
    _announce(sensor, target, target, {}, as_json=as_json)
    note(f"{_format_sent(device)}, {format_size(written)}")


def _serve(
    device: SimulatedDevice,
    target: str,
    link: str | None,
    duration: float | None,
    *,
    as_json: bool,
) -> None:
    """Run a simulated sensor on a port until it is stopped.

    Args:
        target: "pty" or a URL.
        link: the path of a symbolic link to the pty; None for no link.
        duration: time in seconds after which the sensor stops; None for no limit.
    """
    sensor = device.sensor
    try:
        opened = make_simulated_outlet(sensor, target, link)
    except UsageError as error:
        usual_target = f"udp://{LOCALHOST}" if sensor.datagrams else "pty"
        raise suggest(error, f"lidarspec sim {sensor.id} --to {usual_target}") from None
    try:
        controls = {name: control.local_source for name, control in opened.controls.items()}
        _announce(sensor, opened.local_source, opened.source, controls, as_json=as_json)
        with handle_sigterm(), Progress() as progress:
            serve(device, opened, seconds=duration, on_pass=_make_watcher(device, opened, progress))
    finally:
        opened.close()
        if opened.unsent_bytes:
            lost = (
                f"; {format_size(opened.unsent_bytes)} were dropped: no program read them in time"
            )
        else:
            lost = ""
        note(f"{_format_sent(device)}{lost}")


def _announce(
    sensor: Sensor, local_source: str, source: str, controls: Mapping[str, str], *, as_json: bool
) -> None:
    """Print the address of the sensor, its other links, and the next command.

    Args:
        local_source: see `Outlet.local_source`; for a file, its path.
        source: see `Outlet.source`; for a file, its path.
        controls: the addresses of the links for commands, by name.
    """
    verb = verb_to_show(sensor)
    following = f"lidarspec {verb} {shlex.quote(source)} {format_sensor_options(sensor)}"
    if as_json:
        emit_json(
            {
                "sensor": sensor.id,
                "place": local_source,
                "source": source,
                **({"controls": controls} if controls else {}),
                "next": following,
            },
            None,
        )
        return
    say(local_source)
    control_lines = "".join(
        f"\n  commands over {name}: {address}" for name, address in controls.items()
    )
    note(f"{sensor.id}, simulated{control_lines}\n  next: {following}")


def _make_watcher(
    device: SimulatedDevice, opened: Outlet, progress: Progress
) -> Callable[[], None]:
    """Return a callback that prints received commands, disconnections and the progress."""
    began = time.monotonic()
    printed = 0
    was_present = True

    def report() -> None:
        nonlocal printed, was_present
        events = device.commands_received[printed:]
        if device.present != was_present:
            events += [
                f"connected again at {opened.local_source}" if device.present else "disconnected"
            ]
        for event in events:
            progress.note(f"{time.monotonic() - began:.1f} s: {event}")
        printed = len(device.commands_received)
        was_present = device.present
        progress(lambda: f"{time.monotonic() - began:.0f} s, {_format_sent(device)}")

    return report


def _format_sent(device: SimulatedDevice) -> str:
    frames = [f"{number} {name}" for name, number in device.sent.items()]
    return f"{', '.join(frames) or 'no'} frames sent"


@click.command()
@sensor_option
@count_option("complete scans", default=5, show_default=True)
@click.option(
    "--errors",
    type=SHARE,
    default="1%",
    show_default=True,
    help="Share of bytes to corrupt, or of datagrams to drop.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
def demo(sensor_id: str | Sensor | None, count: int, errors: float, as_json: bool) -> None:
    """Simulate a sensor on a port, read it over a noisy line, record it and draw it."""
    sensor = named_sensor(sensor_id) if sensor_id else _find_default_sensor()
    if not sensor.has_points:
        error = UsageError(f"{sensor.id} measures no points, so demo cannot draw a scan")
        raise suggest(error, f"lidarspec stats sim:{sensor.id} -t 5s")
    result = demonstrate(sensor, scan_count=count, errors=errors)
    whole = [scan for scan in result.scans if scan.whole]  # at least one
    if as_json:
        emit_json(_result_to_dict(result, whole), None)
    else:
        say(
            "\n".join([render(_draw_picture(whole[-1])), *_summarize(result, whole)]),
            colour=True,
        )
    # the recording gave other points than the sensor
    if result.digest != result.recorded_digest:
        click.get_current_context().exit(FINDINGS)


def _find_default_sensor() -> Sensor:
    """Return the first installed sensor that declares a `sweep` for its data frames."""
    for sensor in registry().sensors().values():
        if any(sensor.simulation_of(name).sweep for name in sensor.data_frames):
            return sensor
    raise UsageError(no_sensors_text())


def _draw_picture(scan: Scan) -> Text:
    columns, lines = shutil.get_terminal_size((80, MAX_PICTURE_LINES))
    width = min(columns, MAX_PICTURE_COLUMNS)
    height = max(min(lines - SUMMARY_LINES, MAX_PICTURE_LINES), MIN_PICTURE_LINES)
    return draw_cloud(
        scan.points, width=width, height=height, look=choose_appearance(scan.points)
    ).text()


def _summarize(result: Demonstration, whole: list[Scan]) -> list[str]:
    """Return the lines of the summary."""
    stats = result.stats
    name = result.sensor.id
    frames = sum(stats.frames.values())
    if result.sensor.datagrams:
        errors = f"{result.error_share:.2%} of the datagrams were lost"
    else:
        errors = f"{result.error_share:.2%} of the bytes were damaged"
    lacks_pty = find_data_link(result.sensor, Serial) and not has_terminals()
    if lacks_pty:
        where = f"{result.address} (this system has no pseudo-terminals)"
    else:
        where = result.address
    lines = [
        (
            f"{name}, simulated on {where}: {result.sent} frames sent, {errors}, {result.intact}"
            " packets arrived undamaged"
        ),
        *(str(reply) for reply in result.replies if reply.confirmed),
        (
            f"{frames} frames decoded, {stats.bad_checksum} checksum errors, {stats.bytes_skipped}"
            f" of {stats.bytes_in} bytes skipped"
        ),
    ]
    facts = _result_to_dict(result, whole)
    if facts["rate_hz"]:
        rate = f" at {facts['rate_hz']:.1f} Hz"
    else:
        rate = ""
    lines.append(
        f"{len(whole)} complete scan{'s' * (len(whole) != 1)}{rate}, {facts['points']} points; the"
        " last scan:"
        f" {whole[-1]}"
    )
    if result.digest == result.recorded_digest:
        same = "the same points"
    else:
        same = "DIFFERENT points"
    lines.append(
        f"recorded ({format_size(result.recorded_bytes)}) and read again: {same},"
        f" SHA-256 {result.recorded_digest[:16]}..."
    )
    return [*lines, f"next: lidarspec view sim:{name}"]


def _result_to_dict(result: Demonstration, whole: list[Scan]) -> dict[str, object]:
    rates = [scan.rate_hz for scan in whole if np.isfinite(scan.rate_hz)]
    return {
        "sensor": result.sensor.id,
        "sent": result.sent,
        "intact": result.intact,
        "scans": len(whole),
        "rate_hz": float(np.mean(rates)) if rates else None,
        "place": result.address,
        "replies": [reply.command for reply in result.replies if reply.confirmed],
        "recorded": result.recorded_bytes,
        "sha256": result.digest,
        "same_when_replayed": result.digest == result.recorded_digest,
        "points": sum(int(scan.points.valid.sum()) for scan in whole),
        "stats": result.stats.to_dict(),
    }
