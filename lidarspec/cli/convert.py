"""`convert`: write the points, packets or IMU samples of a file to other files."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import Any

import click
import numpy as np

from lidarspec import batch
from lidarspec.cli.failures import FINDINGS
from lidarspec.cli.inputs import (
    exit_if_damaged,
    identify_file,
    iter_device_scans,
    make_no_frame_error,
    make_no_sensor_error,
    refuse_overwriting,
    report_outcome,
    reread,
)
from lidarspec.cli.options import (
    BYTES,
    count_option,
    points_option,
    selection_options,
    sensor_option,
)
from lidarspec.cli.output import Progress, emit_json, format_size
from lidarspec.cli.terminal import note
from lidarspec.detect.identification import detect
from lidarspec.device.device import Device, open as open_device
from lidarspec.device.source_recording import make_recorder
from lidarspec.errors import (
    UnknownField,
    UnknownFrame,
    UsageError,
    WireError,
    WriteError,
    suggest,
    suggestion,
)
from lidarspec.formats import find_replaceable_files, format_of, require_feature, write, write_imu
from lidarspec.formats.common import replace_file
from lidarspec.formats.frame_tables import holds_several_types, write_frames
from lidarspec.framing.frame_engine import get_codec
from lidarspec.packets.imu import ImuSamples, join_samples
from lidarspec.packets.packet_type import find_clock
from lidarspec.packets.packets import Packets
from lidarspec.packets.stream import read_imu
from lidarspec.plugins import sensor as named_sensor
from lidarspec.recording.recorders import SUFFIXES
from lidarspec.remote_files import find_files
from lidarspec.scans.scan import Scan
from lidarspec.scans.selection import (
    EVERYTHING,
    PacketTimes,
    Selection,
    Times,
    TimeSlice,
    iter_received,
)
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.open_url import is_live, open_transport
from lidarspec.transports.protocol import Chunk, no_bytes_message

#: The maximum number of kinds of parts that a remark lists.
MAX_LISTED_PARTS = 3
#: The suffixes of files with packets. In `convert`, `.bin` is a file with points, as in KITTI.
_PACKET_SUFFIXES = tuple(suffix for suffix in SUFFIXES if suffix != ".bin")


@dataclass
class _Counts:
    """Counts the scans and points that are written, and shows them as progress."""

    device: Device
    target: str
    scans: int = 0
    points: int = 0
    units: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        plural = "" if self.scans == 1 else "s"
        return f"{self.target}: {self.points} points of {self.scans} scan{plural}"

    def count(
        self, scans: Iterable[Scan], progress: Progress, *, every_point: bool
    ) -> Iterator[Scan]:
        """Yield the scans, count them, and show the progress."""
        for scan in scans:
            self.scans += 1
            self.units = self.units or scan.points.units
            self.points += len(scan) if every_point else int(scan.points.valid.sum())
            progress(lambda: str(self), self.device.progress)
            yield scan


@click.command()
@click.argument("sources", metavar="IN...", nargs=-1)
@click.argument("target", metavar="OUT")
@sensor_option
@count_option("scans (-f: frames, --imu: samples)")
@selection_options(
    "times", "scans", "every", "ranges", "returns", "columns", "time", "beams", "frame_id"
)
@points_option
@click.option(
    "--organized",
    is_flag=True,
    help="Write all points of a scan in rows and columns; missing points are nan.",
)
@click.option(
    "--packets",
    "with_packets",
    is_flag=True,
    help="Also write the packets of IN, so that lidarspec can read the ROS log.",
)
@click.option("--imu", "is_imu", is_flag=True, help="Write the IMU samples instead of the points.")
@click.option(
    "-f",
    "--frame",
    metavar="NAME",
    help="Write the fields of this frame type, one row per frame, instead of the points."
    " If a field contains elements of several kinds, FRAME.FIELD.KIND writes one row per element of"
    " this kind.",
)
@click.option(
    "--force",
    is_flag=True,
    help="Overwrite OUT; with --to, repeat conversions that are already finished.",
)
@click.option(
    "--to",
    "suffix",
    metavar="FORMAT",
    help="Convert each IN to this format, such as parquet, in the folder OUT.",
)
@click.option(
    "--jobs", type=click.IntRange(min=1), metavar="N", help="With --to: number of processes."
)
@click.option(
    "--dask",
    "scheduler",
    metavar="ADDRESS",
    help="With --to: address of a Dask scheduler whose workers convert.",
)
@click.option(
    "--piece",
    "piece_size",
    type=BYTES,
    metavar="SIZE",
    help="With --to: split larger files into pieces of this size.  [default: 256MB]",
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
    frame: str | None,
    force: bool,
    suffix: str | None,
    jobs: int | None,
    scheduler: str | None,
    piece_size: float | None,
    as_json: bool,
) -> None:
    """Write the points of a recording or capture to a file of another format.

    The suffix of OUT selects the format. .csv and .npz contain all columns of the sensor, such as
    x, y, z, range, azimuth, elevation, intensity, time, ring, return_index and column, and the
    number of the scan. Units are metres, radians, and seconds since the scan's stamp. .npy, .ply,
    .pcd and the compressed .lzf.pcd contain x, y, z, intensity, ring, time and the sensor's own
    columns, such as velocity. These files also contain the number of the scan if several scans
    share a file. .bin contains x, y, z and intensity, as in KITTI. .xyz contains x, y and z.

    If OUT contains a number format, as in scans/%05d.pcd, each scan is written to a file of its
    own. With %F, %H, %M or %S in OUT, all scans of one date, hour, minute or second share a file.

    If -f selects a frame type, or if the sensor has no points, .csv, .parquet, .arrow, .feather and
    .mcap contain the fields of frames, in physical units.

    .lsr, .pcap and .pcapng contain the packets as they were received.

    Tables (.parquet, .arrow, .feather), surveys (.las, .laz, .e57), .zarr, and logs of ROS (.mcap,
    .bag, .rosbag2, .db3), Foxglove (.foxglove.mcap) and Rerun (.rrd) require optional libraries:
    lidarspec[arrow,las,e57,zarr,ros,foxglove,rerun].

    With --to, each IN is a file, a quoted pattern ('drives/**/*.pcap') or a URL
    (s3://bucket/a.pcap), and OUT is a folder. Large files are converted in pieces (--piece).
    OUT/manifest.jsonl lists the finished pieces. If the command is repeated, it converts only the
    missing pieces. If a file fails, the others are still converted.
    """
    chooses_scans = replace(selection, times=(None, None), time="sensor") != EVERYTHING
    properties = {
        "beams": selection.beams,
        "frame-id": selection.frame_id,
        "organized": organized,
        "packets": with_packets,
    }
    for name, is_requested in properties.items():
        if is_requested:
            require_feature(
                target if suffix is None else f"{target}/*.{suffix.removeprefix('.')}", name
            )
    if not sources:
        raise UsageError(f"Missing argument 'OUT': the output file for the points of {target}")
    if suffix is not None:
        if count or is_imu or frame or organized or with_packets:
            raise UsageError("--to cannot be combined with -n, --imu, -f, --organized or --packets")
        if jobs and scheduler:
            raise UsageError(
                "--jobs cannot be combined with --dask, which uses the workers of the scheduler"
            )
        records = batch.convert(
            sources,
            target,
            suffix.removeprefix("."),
            sensor_id,
            jobs=jobs or 1,
            scheduler=scheduler or "",
            size=int(piece_size or batch.PIECE_BYTES),
            every_point=every_point,
            select=selection,
            force=force,
        )
        file_count = len({path for pattern in sources for path, _ in find_files(pattern)})
        _follow_batch(records, target, file_count, as_json=as_json)
        return
    if len(sources) > 1 or jobs or scheduler or piece_size:
        error = UsageError(
            "--to FORMAT is required for several input files, --jobs, --dask and --piece"
        )
        raise suggest(error, "repeat with --to parquet")
    source = sources[0]
    if Path(target).suffix.lower() in _PACKET_SUFFIXES:
        if count or is_imu or frame or chooses_scans:
            raise UsageError(
                f"packets are written to {target}, and they can be selected only by --slice"
            )
        refuse_overwriting([target], source, sensor_id, force=force)
        _write_packets(source, target, sensor_id, selection.times, as_json=as_json)
        return
    if frame is None:
        format_of(target)
    refuse_overwriting(find_replaceable_files(target), source, sensor_id, force=force)
    if sensor_id is None:
        sensor = _detect_sensor(source, target)
    else:
        sensor = named_sensor(sensor_id)
    with open_device(source, sensor) as device:
        if is_imu and frame is not None:
            raise UsageError("--imu cannot be combined with -f")
        writes_frames = frame is not None or not (is_imu or device.sensor.has_points)
        if (writes_frames or is_imu) and (organized or with_packets or chooses_scans):
            items = "frames" if writes_frames else "IMU samples"
            raise UsageError(f"{items} can be selected only by -n, --slice and --time")
        if writes_frames:
            frames = _choose_frames(device, target, frame)
            summary = _write_frames(device, target, frames, selection, count)
        elif is_imu:
            summary = _write_imu(device, target, selection, count)
        else:
            summary = _write_points(
                device,
                target,
                itertools.islice(iter_device_scans(device, source, selection), count),
                every_point=every_point,
                organized=organized,
                with_packets=with_packets,
            )
        if as_json:
            stats = device.stats.to_dict()
            emit_json(
                {"sensor": device.sensor.id, "output": target, **summary, "stats": stats}, None
            )
        report_outcome(device)


def _write_imu(
    device: Device, target: str, selection: Selection, count: int | None
) -> dict[str, Any]:
    """Write IMU samples; return the entries of the summary."""
    device.sensor.require_imu()
    batches = list[ImuSamples]()
    number = 0
    with contextlib.closing(_iter_imu(device, selection)) as arriving:
        for samples in arriving:
            batches.append(samples)
            number += len(samples)
            if count is not None and number >= count:
                break
    if not number:
        raise _make_no_data_error(device, target, "IMU samples")
    samples = join_samples(batches)[:count]
    write_imu(target, samples)
    note(f"{target}: {len(samples)} IMU samples from {device.sensor.id}; {device.stats}")
    return {"samples": len(samples)}


def _iter_imu(device: Device, selection: Selection) -> Generator[ImuSamples]:
    """Yield the IMU samples of the selected packets, with times by the selected clock."""
    batches = _select_frames(device, device.sensor.imu_frames, selection, None)
    frames_by_clock = dict[bool, str]()
    with contextlib.closing(batches):
        for selected in batches:
            for packets in selected.values():
                if selection.time == "sensor":
                    _refuse_mixed_clocks(packets, frames_by_clock)
                samples = read_imu(packets)
                yield samples if device.mount is None else samples.turn(device.mount.rotation)


def _refuse_mixed_clocks(packets: Packets, frames_by_clock: dict[bool, str]) -> None:
    """Raise UsageError if only some of the frame types so far have a clock.

    Args:
        packets: the next packets to check.
        frames_by_clock: True -> a frame type with a clock, False -> a frame type without a clock.
            This function adds the type of `packets`.
    """
    has_clock = find_clock(packets.sensor, packets.frame) is not None
    frames_by_clock.setdefault(has_clock, packets.frame)
    if len(frames_by_clock) > 1:
        reason = (
            f"the IMU samples of {frames_by_clock[True]} frames have the sensor's time, but those"
            f" of {frames_by_clock[False]} frames do not, so one file cannot contain both"
        )
        raise suggest(UsageError(reason), "repeat with --time host")


def _choose_frames(device: Device, target: str, frame: str | None) -> Sequence[str]:
    """Return the frame types to write.

    Args:
        frame: the requested frame type, such as "report". If a field of the frame type contains
            elements of several kinds, FRAME.FIELD.KIND requests the elements of one kind, such as
            "report.tags.temperature". None for all frame types that the sensor sends.
    """
    sensor = device.sensor
    frames = sensor.incoming
    if frame is not None:
        name = frame.partition(".")[0]
        if name not in frames:
            raise UnknownFrame(name, frames, place=sensor.id)
        known = [name, *_list_parts(sensor, name)]
        if frame not in known:
            raise UnknownField(frame, known, place=sensor.id)
        return [frame]
    if len(frames) > 1 and not holds_several_types(target):
        error = UsageError(
            f"{sensor.id} has no points, and {target} can contain only one frame type: choose"
            f" one of {', '.join(frames)}"
        )
        raise suggest(error, f"repeat with -f {next(iter(frames))}")
    return list(frames)


def _write_frames(
    device: Device,
    target: str,
    frames: Sequence[str],
    selection: Selection,
    count: int | None,
) -> dict[str, Any]:
    """Write the fields of frames; return the entries of the summary."""
    sensor = device.sensor
    types = list(frames)
    parts = [
        part for frame in frames if frame in sensor.frames for part in _list_parts(sensor, frame)
    ]
    if holds_several_types(target):
        types += parts
    elif parts:
        shown = " or ".join(f"-f {part}" for part in parts[:MAX_LISTED_PARTS])
        if len(parts) > MAX_LISTED_PARTS:
            shown += f" (lidarspec show {sensor.id} lists {len(parts)} kinds of parts)"
        note(
            f"{target} has no columns for the parts of {frames[0]}: repeat with {shown},"
            " or write an .mcap file"
        )
    batches = _select_frames(device, types, selection, count)
    first = next(batches, None)
    if first is None:
        raise _make_no_data_error(device, target, " or ".join(frames))
    written = write_frames(target, itertools.chain([first], batches))
    noun = "rows" if any("." in name for name in frames) else "frames"
    note(f"{target}: {written} {noun} from {sensor.id}; {device.stats}")
    return {noun: written}


def _list_parts(sensor: Sensor, frame: str) -> list[str]:
    """Return the kinds of parts in a frame type, for example "report.tags.temperature"."""
    schema = get_codec(sensor.frames[frame]).schema
    return [f"{frame}.{path}" for path in schema.part_kinds]


def _select_frames(
    device: Device, types: Sequence[str], selection: Selection, count: int | None
) -> Generator[dict[str, Packets]]:
    """Yield batches with the selected frames and their parts, without empty batches."""
    frames = list(dict.fromkeys(name.partition(".")[0] for name in types))
    slices = {frame: TimeSlice(selection.times) for frame in frames}
    clocks = {frame: PacketTimes(selection.time, device.source) for frame in frames}
    number = 0
    limit = math.inf if count is None else count
    try:
        for arrived in device.packets_by_frame(frames):
            selected = dict[str, Packets]()
            for frame, packets in arrived.items():
                times = clocks[frame].read(packets)
                which = np.flatnonzero(slices[frame].select_times(times))
                which = which[: int(min(limit - number, len(which)))]
                number += len(which)
                if len(which):
                    chosen = packets.with_times(times).take(which)
                    selected |= _take_types(chosen, types)
            if selected:
                yield selected
            if number >= limit or all(wanted.ended for wanted in slices.values()):
                break
    finally:
        for warning in dict.fromkeys(text for clock in clocks.values() for text in clock.warnings):
            note(warning)
    for wanted in slices.values():
        if wanted.first is not None and not number:
            raise wanted.make_no_data_error(device.source, "frames")


def _take_types(packets: Packets, types: Sequence[str]) -> dict[str, Packets]:
    """Return the packets of the requested types, by type, without empty packets.

    Args:
        types: the requested frame types, and kinds of parts such as "report.tags.temperature".
    """
    found = dict[str, Packets]()
    for name in types:
        frame, _, path = name.partition(".")
        if frame != packets.frame:
            continue
        chosen = packets.parts(path) if path else packets
        if len(chosen):
            found[name] = chosen
    return found


def _write_packets(
    source: str, target: str, sensor_id: str | Sensor | None, times: Times, *, as_json: bool
) -> None:
    """Write packets as they were received, and print a summary."""
    if is_live(source):
        raise suggest(
            UsageError(f"{source} is not a file"),
            f"lidarspec record {quote(source)} -o {quote(target)}",
        )
    with (
        contextlib.closing(open_transport(source)) as opened,
        Progress(format_size) as progress,
        replace_file(Path(target)) as part,
    ):
        sensor: Sensor | None = None
        if sensor_id is not None:
            sensor = named_sensor(sensor_id)
        elif not opened.datagrams and Path(target).suffix.lower() != ".lsr":
            # Each packet of the new file is a frame of the sensor.
            sensor = _detect_sensor(source, target)
        try:
            with make_recorder(opened, source, str(part), sensor, overwrite=True) as file:
                for chunk in iter_received(opened, times, source):
                    file.wait_for_room()
                    file.write(chunk)
                    progress(lambda: f"{target}: {file.records} packets", opened.progress)
        except WriteError as error:  # its message names the temporary file
            raise WriteError(target, error.reason, "nothing was written") from None
        if not file.records:
            raise suggest(
                WireError(no_bytes_message(source, opened.warnings)),
                f"lidarspec info {quote(source)}",
            )
    note(f"{target}: {file.records} packets, {format_size(file.bytes)}")
    for warning in opened.warnings:
        note(warning)
    if as_json:
        emit_json({"output": target, "packets": file.records, "bytes": file.bytes}, None)
    exit_if_damaged(opened.unread)


def _write_points(
    device: Device,
    target: str,
    scans: Iterator[Scan],
    *,
    every_point: bool,
    organized: bool,
    with_packets: bool,
) -> dict[str, Any]:
    """Write the points of scans; return the entries of the summary."""
    counts = _Counts(device, target)
    with (
        Progress(format_size) as progress,
        _open_packets(str(device.source), wanted=with_packets) as packets,
    ):
        first = next(scans, None)
        if first is None:
            raise _make_no_data_error(device, target)
        counted = counts.count(
            itertools.chain([first], scans), progress, every_point=every_point or organized
        )
        write(target, counted, every_point=every_point, organized=organized, packets=packets)
    note(f"{counts} of {device.sensor.id}; {device.stats}")
    if counts.units:
        columns = [f"{name} [{unit}]" if unit else name for name, unit in counts.units.items()]
        note(f"{device.sensor.id} has columns that not every sensor has: {', '.join(columns)}")
    return {"scans": counts.scans, "points": counts.points, "units": dict(counts.units)}


@contextlib.contextmanager
def _open_packets(source: str, *, wanted: bool) -> Iterator[Iterator[Chunk] | None]:
    """Open a file a second time, and yield an iterator over its datagrams.

    Args:
        wanted: if False, the file is not opened and None is yielded.

    Raises:
        UsageError: if the source can be read only once, or is a byte stream.
    """
    if not wanted:
        yield None
        return
    if is_live(source) or source == "-":
        raise UsageError(
            f"--packets requires reading IN twice, but {source} can be read only once: record it"
            " first"
        )
    with contextlib.closing(open_transport(source)) as opened:
        if not opened.datagrams:
            raise UsageError(f"--packets requires datagrams, but {source} is a byte stream")
        yield opened.chunks()


def _follow_batch(
    records: Iterable[tuple[batch.Record, bool]], folder: str, file_count: int, *, as_json: bool
) -> None:
    """Print the progress and the result of a batch.

    Exit with 1 if a piece has failed, or if a corrupt part of a file could not be read.
    """
    totals: Counter[str] = Counter()
    failed: list[batch.Record] = []
    done_before = 0
    unread = 0
    with Progress("{:.1f} files".format) as progress:
        for record, is_old in records:
            if is_old:
                done_before += 1
            if "error" in record:
                failed.append(record)
                reason = record["error"].removeprefix(f"{record['source']}: ")
                progress.note(f"{record['source']}: {reason}")
                continue
            totals["files"] += int(record["last"])
            totals["pieces"] += 1
            totals["scans"] += record["scans"]
            totals["points"] += record["points"]
            lost = record.get("unread", 0)  # records of earlier versions lack it
            if lost:
                progress.note(f"{record['source']} is corrupt: some bytes were not read")
                unread += lost
            progress(
                lambda: f"{folder}: {totals['points']} points",
                (totals["files"] + len(failed), file_count),
            )
    note(f"{folder}: {_describe_batch(totals, done_before, len(failed))}")
    if as_json:
        summary = {
            "output": folder,
            **totals,
            "before": done_before,
            "failed": {record["source"]: record["error"] for record in failed},
        }
        emit_json(summary, None)
    if failed:
        raise click.exceptions.Exit(FINDINGS)
    exit_if_damaged(unread)


def _describe_batch(totals: Counter[str], done_before: int, failed_count: int) -> str:
    # The number of pieces is printed only if a file was split into several pieces.
    names = [name for name in totals if name != "pieces" or totals[name] > totals["files"]]
    parts = [", ".join(f"{totals[name]} {name}" for name in names) or "nothing"]
    if done_before:
        parts.append(f"{done_before} pieces were already converted by an earlier run")
    if failed_count:
        parts.append(f"{failed_count} failed")
    return "; ".join(parts)


def _detect_sensor(source: str, target: str) -> Sensor:
    try:
        return detect(source)
    except UsageError as error:
        raise suggest(error, f"lidarspec convert {quote(source)} {quote(target)} -s ID") from None
    except WireError as error:
        sample = None if suggestion(error) else reread(source)
        raise error if sample is None else make_no_sensor_error(sample) from None


def _make_no_data_error(device: Device, target: str, content: str = "") -> Exception:
    """Return the error that explains why a file contains no data of the sensor.

    Args:
        content: the searched content, such as a frame type or "IMU samples"; "" for points.
    """
    sensor = device.sensor
    stats = device.stats
    source = str(device.source)
    if stats.bytes_in == 0:
        return suggest(
            WireError(no_bytes_message(source, device.warnings), sensor=sensor.id),
            f"lidarspec show {sensor.id}",
        )
    failure = stats.failure(sensor.id)
    if failure is not None:
        return failure
    if content and stats.frames:
        reason = f"{source} has no {content}; it has {', '.join(stats.frames)}"
        return suggest(
            WireError(reason, sensor=sensor.id), f"lidarspec stats {quote(source)} -s {sensor.id}"
        )
    instead = identify_file(sensor, source)
    if instead is not None:
        error = WireError(f"{source} {instead[0]}", sensor=sensor.id)
        return suggest(error, f"lidarspec convert {quote(source)} {quote(target)} {instead[1]}")
    sample = reread(source) if not stats.frames else None
    if sample is not None:
        return make_no_frame_error(sensor, sample)
    return suggest(
        WireError(f"no data frame in {source}: {stats}", sensor=sensor.id),
        f"lidarspec explain {quote(source)} -s {sensor.id}",
    )
