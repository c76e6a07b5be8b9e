"""`info`, `convert` and `plot`: what is in a file, from file to file, and a scan as a picture."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import Any

import click

from lidarspec import batch
from lidarspec.cli.failures import FINDINGS, NO_DATA
from lidarspec.cli.inputs import (
    PATIENCE,
    again,
    conclude,
    fits_instead,
    nearest_fault,
    no_frame,
    nothing_came,
    refuse_overwriting,
    scans_of,
)
from lidarspec.cli.options import (
    BYTES,
    DURATION,
    colour_option,
    count_option,
    points_option,
    selecting,
    sensor_option,
)
from lidarspec.cli.output import Progress, emit, emit_json, emit_parts, output_options, size
from lidarspec.cli.terminal import note
from lidarspec.detect.identification import detected
from lidarspec.device.device import Device, open as open_device
from lidarspec.device.source_recording import recorder_like
from lidarspec.errors import UsageError, WireError, WriteError, suggest, suggestion
from lidarspec.explaining.contents import contents, shown
from lidarspec.formats import check_holds, format_of, targets, write, write_imu
from lidarspec.formats.writing import replacing
from lidarspec.packets.imu import joined
from lidarspec.plugins import sensor as named_sensor
from lidarspec.points.look import fit, look
from lidarspec.recording.recorders import SUFFIXES
from lidarspec.scans.scans import Scan
from lidarspec.scans.selection import EVERYTHING, Selection, Times, received
from lidarspec.spec.sensor import Sensor
from lidarspec.stores import found
from lidarspec.transports.open_url import is_live, transport
from lidarspec.transports.protocol import Chunk, no_bytes
from lidarspec.view import figures
from lidarspec.view.feed import Feed
from lidarspec.view.svg import svg

#: of files that hold packets as they were received; bytes alone have the suffix of KITTI's points.
PACKETS = tuple(suffix for suffix in SUFFIXES if suffix != ".bin")


@dataclass
class Written:
    """What has gone through so far, and said on a terminal while it does."""

    device: Device
    target: str
    scans: int = 0
    points: int = 0
    units: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.target}: {self.points} points of {self.scans} scan{'s' * (self.scans != 1)}"

    def counting(
        self, scans: Iterable[Scan], progress: Progress, *, every_point: bool
    ) -> Iterator[Scan]:
        """The scans, counted on their way."""
        for scan in scans:
            self.scans += 1
            self.units = self.units or scan.points.units
            self.points += len(scan) if every_point else int(scan.points.valid.sum())
            progress(lambda: str(self), self.device.place)
            yield scan


@click.command()
@click.argument("sources", metavar="IN...", nargs=-1)
@click.argument("target", metavar="OUT")
@sensor_option
@count_option("scans")
@selecting("times", "scans", "every", "ranges", "columns", "time", "beams", "frame_id")
@points_option
@click.option(
    "--organized",
    is_flag=True,
    help="All points of a scan, as rows and columns; missing ones are nan.",
)
@click.option(
    "--packets",
    "with_packets",
    is_flag=True,
    help="The packets of IN as well, in a log of ROS, which is a SOURCE then.",
)
@click.option(
    "--imu", "is_imu", is_flag=True, help="What the sensor's IMU felt, in place of the points."
)
@click.option("--force", is_flag=True, help="Overwrite OUT; with --to also what was done before.")
@click.option(
    "--to",
    "suffix",
    metavar="FORMAT",
    help="Write each IN to a file of this format in the folder OUT, such as parquet.",
)
@click.option(
    "--jobs", type=click.IntRange(min=1), metavar="N", help="With --to: so many processes."
)
@click.option(
    "--dask", "scheduler", metavar="ADDRESS", help="With --to: the workers of this Dask scheduler."
)
@click.option(
    "--piece",
    "piece_size",
    type=BYTES,
    metavar="SIZE",
    help="With --to: cut larger files into such pieces.  [default: 256MB]",
)
@click.option("--json", "as_json", is_flag=True, help="Print a summary as JSON.")
def convert(
    sources: Sequence[str],
    target: str,
    sensor_id: str | Sensor | None,
    count: int | None,
    selection: Selection,
    every_point: bool,
    organized: bool,
    with_packets: bool,
    is_imu: bool,
    force: bool,
    suffix: str | None,
    jobs: int | None,
    scheduler: str | None,
    piece_size: float | None,
    as_json: bool,
) -> None:
    """Write the points of a capture or raw file to a file, in the format of its suffix.

    .csv and .npz hold x y z range azimuth elevation intensity time ring return_index column, those
    that the sensor has, its further columns, and the number of the scan; metres, radians, and
    seconds since the scan's stamp. .npy, .ply, .pcd and .lzf.pcd, which is compressed, hold x y z
    intensity ring time, further columns and, of several scans, their number; .bin, as KITTI has it,
    x y z intensity; .xyz x y z. For a file each scan put the place of a number into the name,
    scans/%05d.pcd; %F, %H, %M and %S stand for date, hour, minute and second of the scans that
    share a file.

    .lsr, .pcap and .pcapng hold the packets themselves, as they were received.

    Tables (.parquet, .arrow, .feather), surveys (.las, .laz, .e57), .zarr, logs of ROS (.mcap,
    .bag, .rosbag2, .db3), of Foxglove (.foxglove.mcap) and of Rerun (.rrd) take libraries that are
    not installed by default: lidarspec[arrow,las,e57,zarr,ros,foxglove,rerun].

    With --to each IN is a file, a pattern in quotes, 'drives/**/*.pcap', or a URL,
    s3://bucket/a.pcap, and OUT a folder. What is done is written down there, in manifest.jsonl: the
    same command again does what is missing. A file that fails stops no other.
    """
    asked = {
        "beams": selection.beams,
        "frame-id": selection.frame_id,
        "organized": organized,
        "packets": with_packets,
    }
    for what in (what for what, is_asked in asked.items() if is_asked):
        check_holds(target if suffix is None else f"{target}.{suffix.removeprefix('.')}", what)
    if not sources:
        raise UsageError(f"Missing argument 'OUT': where the points of {target} are to go")
    if suffix is not None:
        if count or is_imu or organized or with_packets:
            raise UsageError("-n, --imu, --organized and --packets are for one file, without --to")
        if jobs and scheduler:
            raise UsageError("--dask has its own workers: leave out --jobs")
        how: dict[str, Any] = {
            "jobs": jobs or 1,
            "scheduler": scheduler or "",
            "size": int(piece_size or batch.PIECE),
        }
        how |= {"every_point": every_point, "select": selection, "force": force}
        records = batch.convert(sources, target, suffix.removeprefix("."), sensor_id, **how)
        _convert_all(
            records,
            target,
            len({path for pattern in sources for path, _ in found(pattern)}),
            as_json=as_json,
        )
        return
    if len(sources) > 1 or jobs or scheduler or piece_size:
        error = UsageError(
            "several files, and --jobs, --dask and --piece, go into a folder in one format"
        )
        raise suggest(error, "the same with --to parquet")
    if Path(target).suffix.lower() in PACKETS:
        if count or is_imu or replace(selection, times=(None, None), time="device") != EVERYTHING:
            raise UsageError(f"{target} holds packets, which are selected by --slice alone")
        refuse_overwriting([target], sources[0], sensor_id, force=force)
        _write_packets(sources[0], target, sensor_id, selection.times, as_json=as_json)
        return
    format_of(target)
    refuse_overwriting(targets(target), sources[0], sensor_id, force=force)
    sensor = _detected(sources[0], target) if sensor_id is None else named_sensor(sensor_id)
    with open_device(sources[0], sensor) as device:
        if is_imu:
            summary = _write_imu(device, target, count)
        else:
            scans = itertools.islice(scans_of(device, sources[0], selection), count)
            summary = _write_points(
                device,
                target,
                scans,
                every_point=every_point,
                organized=organized,
                with_packets=with_packets,
            )
        if as_json:
            emit_json(
                {
                    "sensor": device.sensor.id,
                    "output": target,
                    **summary,
                    "stats": device.stats.to_dict(),
                },
                None,
            )
        conclude(device)


def _write_imu(device: Device, target: str, count: int | None) -> dict[str, Any]:
    """Write what the IMU felt; what is to be said of it."""
    samples = joined(list(device.imu()))[:count]
    if not len(samples):
        raise _no_data(device, target)
    write_imu(target, samples)
    note(f"{target}: {len(samples)} samples of the IMU of {device.sensor.id}; {device.stats}")
    return {"samples": len(samples)}


def _write_packets(
    source: str, target: str, sensor_id: str | Sensor | None, times: Times, *, as_json: bool
) -> None:
    """Write what was received, as it came."""
    if is_live(source):
        raise suggest(
            UsageError(f"{source} is no file"),
            f"lidarspec record {quote(source)} -o {quote(target)}",
        )
    with (
        contextlib.closing(transport(source)) as opened,
        Progress(size) as progress,
        replacing(Path(target)) as part,
    ):
        needs_sensor = (
            not opened.datagrams and Path(target).suffix.lower() != ".lsr"
        )  # whose frames are the packets
        sensor = (
            named_sensor(sensor_id)
            if sensor_id is not None
            else _detected(source, target)
            if needs_sensor
            else None
        )
        try:
            with recorder_like(opened, source, str(part), sensor, overwrite=True) as file:
                for chunk in received(opened, times, source):
                    file.keep_up()
                    file.write(chunk)
                    progress(lambda: f"{target}: {file.records} packets", opened.place)
        except WriteError as error:  # its text names the temporary file
            raise WriteError(target, error.reason, "nothing was written") from None
        if not file.records:
            raise suggest(
                WireError(no_bytes(source, opened.warnings)), f"lidarspec info {quote(source)}"
            )
    for remark in (f"{target}: {file.records} packets, {size(file.bytes)}", *opened.warnings):
        note(remark)
    if as_json:
        emit_json({"output": target, "packets": file.records, "bytes": file.bytes}, None)


def _write_points(
    device: Device,
    target: str,
    scans: Iterator[Scan],
    *,
    every_point: bool,
    organized: bool,
    with_packets: bool,
) -> dict[str, Any]:
    """Write the points of scans; what is to be said of them."""
    written = Written(device, target)
    with Progress(size) as progress, _packets(str(device.source), wanted=with_packets) as packets:
        first = next(scans, None)
        if first is None:
            raise _no_data(device, target)
        counted = written.counting(
            itertools.chain([first], scans), progress, every_point=every_point or organized
        )
        write(target, counted, every_point=every_point, organized=organized, packets=packets)
    note(f"{written} of {device.sensor.id}; {device.stats}")
    if written.units:
        note(
            "further columns:"
            f" {', '.join(f'{name} [{unit}]' if unit else name for name, unit in written.units.items())}"
        )
    return {"scans": written.scans, "points": written.points, "units": dict(written.units)}


@contextlib.contextmanager
def _packets(source: str, *, wanted: bool) -> Iterator[Iterator[Chunk] | None]:
    """The packets of a file, which is read a second time for them; None where they are not wanted."""
    if not wanted:
        yield None
        return
    if is_live(source) or source == "-":
        raise UsageError(
            f"--packets reads IN twice, and {source} can be read only once: record it first"
        )
    with contextlib.closing(transport(source)) as opened:
        if not opened.datagrams:
            raise UsageError(f"{source} is a stream of bytes: packets are those of datagrams")
        yield opened.chunks()


def _convert_all(
    records: Iterable[tuple[batch.Record, bool]], folder: str, files: int, *, as_json: bool
) -> None:
    """Say what becomes of each piece, and in the end of all; exit code 1 where one has failed."""
    totals, before, failed = Counter[str](), 0, list[batch.Record]()
    with Progress("{:.1f} files".format) as progress:
        for record, is_old in records:
            before += is_old
            if "error" in record:
                failed.append(record)
                reason = record["error"].removeprefix(f"{record['source']}: ")
                progress.note(f"{record['source']}: {reason}")
                continue
            totals.update(
                {
                    "files": int(record["last"]),
                    "pieces": 1,
                    "scans": record["scans"],
                    "points": record["points"],
                }
            )
            progress(
                lambda: f"{folder}: {totals['points']} points",
                (totals["files"] + len(failed), files),
            )
    told = ", ".join(
        f"{number} {what}"
        for what, number in totals.items()
        if what != "pieces" or number > totals["files"]
    )
    note(
        f"{folder}: {told or 'nothing'}"
        + f"; {before} pieces were done before" * bool(before)
        + f"; {len(failed)} failed" * bool(failed)
    )
    if as_json:
        emit_json(
            {
                "output": folder,
                **totals,
                "before": before,
                "failed": {one["source"]: one["error"] for one in failed},
            },
            None,
        )
    if failed:
        raise click.exceptions.Exit(FINDINGS)


def _detected(source: str, target: str) -> Sensor:
    try:
        return detected(source)
    except UsageError as error:
        raise suggest(error, f"lidarspec convert {quote(source)} {quote(target)} -s ID") from None
    except WireError as error:
        given = None if suggestion(error) else again(source)
        raise error if given is None else nearest_fault(given) from None


def _no_data(device: Device, target: str) -> Exception:
    """Why nothing came out: an empty file, a damaged frame, another sensor's bytes, or no lidar's
    at all.
    """
    sensor, stats, source = device.sensor, device.stats, str(device.source)
    if stats.bytes_in == 0:
        return suggest(
            WireError(no_bytes(source, device.warnings), sensor=sensor.id),
            f"lidarspec show {sensor.id}",
        )
    if (failure := stats.failure(sensor.id)) is not None:
        return failure
    instead = fits_instead(sensor, source)
    if instead is not None:
        error = WireError(f"{source} {instead[0]}", sensor=sensor.id)
        return suggest(error, f"lidarspec convert {quote(source)} {quote(target)} {instead[1]}")
    given = again(source) if not stats.frames else None
    if given is not None:
        return no_frame(sensor, given)
    return suggest(
        WireError(f"no data frame in {source}: {stats}", sensor=sensor.id),
        f"lidarspec explain {quote(source)} -s {sensor.id}",
    )


@click.command()
@click.argument("files", metavar="FILE...", nargs=-1, required=True)
@output_options
def info(files: Sequence[str], as_json: bool, output: str | None) -> None:
    """What is in a file: kind, times, senders, sensor, rates, loss, and how it is read.

    FILE is anything that is read: a recording, a capture, a robotics log, bytes. Of a long one the
    beginning is looked at, and when it ends. Several files are printed in turn.
    """
    unknown = []

    def texts() -> Iterator[str]:
        for file in files:
            held = contents(file)
            if as_json:
                yield json.dumps(held.to_dict(), indent=2, allow_nan=False)
            else:
                yield f"{held.path}: {held.kind}, {size(held.size)}"
                yield from (f"  {word:<8}  {text}" for word, text in shown(held))
            for warning in held.warnings:
                note(warning)
            if not any(content.sensors for content in held.contents):
                unknown.append(file)

    emit_parts(texts(), output)
    if unknown:
        raise click.exceptions.Exit(NO_DATA)


@click.command()
@click.argument("source", metavar="IN")
@click.option(
    "-o",
    "--output",
    metavar="FILE",
    required=True,
    help="Where to: .svg, .png or .pdf; - is standard output, as SVG.",
)
@sensor_option
@click.option(
    "--kind",
    type=click.Choice(["scan", "intensity", "ranges", "rates"]),
    default="scan",
    show_default=True,
    help="What of it.",
)
@click.option(
    "--scan",
    "number",
    type=click.IntRange(min=1),
    metavar="NUMBER",
    default=1,
    show_default=True,
    help="Which whole scan.",
)
@click.option(
    "-t",
    "--duration",
    type=DURATION,
    help="Of a live source so long.  [default: 10s, but for a scan]",
)
@selecting("times", "scans", "every", "ranges", "time")
@colour_option
@click.option(
    "--max-range",
    type=click.FloatRange(min=0, min_open=True),
    metavar="METRES",
    help="From the middle to the edge.",
)
def plot(
    source: str,
    output: str,
    sensor_id: str | Sensor | None,
    kind: str,
    number: int,
    duration: float | None,
    selection: Selection,
    ramp: str,
    max_range: float | None,
) -> None:
    """A scan as a picture; or intensities, ranges and rates over time.

    A scan is drawn to scale, from above, and from the side where the points are not in one plane.
    --kind intensity counts how often each intensity comes, ranges says how many returns there are
    at each range over time, and rates how many packets and scans a second, with what is lost or
    wrong among them. All but the SVG of a scan takes matplotlib: lidarspec[plot].
    """
    suffix = ".svg" if output == "-" else Path(output).suffix.lower()
    if suffix not in figures.SUFFIXES:
        raise UsageError(f"{output}: pictures are written as {', '.join(figures.SUFFIXES)}")
    refuse_overwriting(output, source, sensor_id)
    with open_device(source, sensor_id) as device:
        if kind == "scan":
            chosen = _numbered(device, source, selection, number)
            conclude(device)  # before a picture is drawn, while a live source goes on
            how = look(chosen.points, ramp=ramp, reach=max_range)
            if max_range is None:
                how = fit(chosen.points, how)
            title = f"{device.sensor.id}: {chosen}"
            if suffix == ".svg":
                emit(svg(chosen.points, how, title), output)
            else:
                _save(figures.of_scan(chosen, how, title), output, suffix)
            drawn = title
        else:
            until = time.monotonic() + (duration or (PATIENCE if device.is_live else math.inf))
            _save(_over_time(device, source, selection, kind, until), output, suffix)
            drawn = f"{kind} of {device.sensor.id}"
        if output != "-":
            note(f"{output}: {drawn}")


def _numbered(device: Device, source: str, selection: Selection, number: int) -> Scan:
    """A whole scan by its number; the last piece that could be drawn, where there are fewer."""
    chosen: Scan | None = None
    whole = 0
    for scan in scans_of(device, source, selection):
        whole += scan.whole
        chosen = scan if scan.whole or chosen is None or not chosen.whole else chosen
        if whole == number:
            break
    if chosen is None:
        raise nothing_came(device, source)
    if whole < number:
        note(
            f"{source} has {whole} whole scan{'s' * (whole != 1)}; drawn is the last piece of it"
            " that could be"
        )
    return chosen


def _over_time(device: Device, source: str, selection: Selection, kind: str, until: float) -> Any:
    """A figure of what comes up to a time of `time.monotonic`."""
    title = f"{device.sensor.id}, {Path(source).name if device.place else source}"
    if kind == "rates":
        rates = figures.Rates(Feed(device, select=selection), until)
        conclude(device)
        return figures.of_rates(rates, title)

    if (first := next(scans := scans_of(device, source, selection, until=until), None)) is None:
        raise nothing_came(device, source)

    def every() -> Iterator[Scan]:
        yield first
        yield from scans
        conclude(device)

    return (figures.of_ranges if kind == "ranges" else figures.of_intensities)(every(), title)


def _save(figure: Any, output: str, suffix: str) -> None:
    if output == "-":
        text = io.BytesIO()
        figures.save(figure, text, suffix)
        emit(text.getvalue().decode(), output)
        return
    with replacing(Path(output)) as part:
        figures.save(figure, part, suffix)
