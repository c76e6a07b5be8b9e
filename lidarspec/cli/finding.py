"""`ports`, `detect`, `doctor`, `crc`: find ports, sensors, faults and checksums."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from shlex import quote
from textwrap import indent
from typing import Any

import click

from lidarspec.cli.clock import diagnose_clock
from lidarspec.cli.failures import DEVICE, FINDINGS, NO_DATA
from lidarspec.cli.inputs import read_sample
from lidarspec.cli.options import DURATION, sensor_option
from lidarspec.cli.output import Progress, emit, emit_json, output_options, table
from lidarspec.cli.terminal import note, verbosity
from lidarspec.detect.doctor import examine, examine_computer
from lidarspec.detect.identification import (
    Verdict,
    describe_unsupported_models,
    format_sensor_options,
    identify_sample,
    identify_senders,
    list_candidates,
    select_best,
    verb_to_show,
)
from lidarspec.detect.listen import (
    LISTEN_S,
    ignore_progress,
    list_start_required,
    list_udp_ports,
    probe,
    read_samples,
)
from lidarspec.detect.sample_bytes import SampleBytes
from lidarspec.detect.uninstalled_sensors import describe, make_install_command, recognize
from lidarspec.drafting.checksum_search import search
from lidarspec.drafting.periods import FrameStructure, find_structure, split_frames
from lidarspec.drafting.samples import ChecksumMatch
from lidarspec.errors import SourceError, UsageError, WireError, suggest
from lidarspec.known_sensors import KnownSensor, find_known_sensor, install_command, no_sensors_text
from lidarspec.plugins import sensor as named_sensor, sensors
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Serial, Udp
from lidarspec.transports.addresses import with_option
from lidarspec.transports.base import find_data_link
from lidarspec.transports.open_url import live_address, resolve_device_name
from lidarspec.transports.ports import PortUser, SerialPort, find_udp_users, list_serial_ports
from lidarspec.transports.protocol import no_bytes_message

#: A match with fewer bits of evidence may be a coincidence.
WEAK_BITS = 12
#: Maximum number of matches to print.
MAX_PRINTED_MATCHES = 4
HEX = (".hex", ".txt")
MAX_DATAGRAM_BYTES = 1 << 16
#: Maximum number of checksums to print for unknown bytes.
MAX_PRINTED_CHECKSUMS = 2


@click.command()
@output_options
def ports(as_json: bool, output: str | None) -> None:
    """List the serial ports of this computer, and the UDP ports of installed sensors."""
    serial = list_serial_ports()
    udp = {port: find_udp_users(port) for port in list_udp_ports()}
    if as_json:
        listed = [{**vars(port), "users": [vars(user) for user in port.users]} for port in serial]
        emit_json(
            {"serial": listed, "udp": [_udp_to_dict(port, users) for port, users in udp.items()]},
            output,
        )
        return
    rows = [
        [port.path, port.description or "serial port", _describe_port(port), port.lasting]
        for port in serial
    ]
    rows += [
        [f"udp://:{port}", ", ".join(_list_sensors_at_port(port)), _describe_udp_port(users), ""]
        for port, users in udp.items()
    ]
    emit(table(["port", "description", "state", "stable name"], rows, output), output)
    if not serial:
        note("no serial port found: check that the device is plugged in")
    note(
        f"next: lidarspec detect{f' {serial[0].path}' if len(serial) == 1 else ''}"
        if sensors()
        else no_sensors_text()
    )


def _list_sensors_at_port(port: int) -> list[str]:
    """Return the installed sensors that send data to a UDP port."""
    return [
        sensor.id
        for sensor in sensors().values()
        if (link := find_data_link(sensor, Udp)) and port in link.ports
    ]


def _describe_port(port: SerialPort) -> str:
    if not port.allowed:
        return "no permission; next: lidarspec doctor"
    if port.users:
        return f"in use by {', '.join(map(str, port.users))}"
    return "free"


def _describe_udp_port(users: tuple[PortUser, ...] | None) -> str:
    if users is None:
        return "free"
    return f"in use by {', '.join(map(str, users)) or 'another user'}"


def _udp_to_dict(port: int, users: tuple[PortUser, ...] | None) -> dict[str, Any]:
    return {
        "port": port,
        "sensors": _list_sensors_at_port(port),
        "free": users is None,
        "users": [vars(user) for user in users or ()],
    }


@click.command()
@click.argument("words", metavar="HEX...|FILE|-", nargs=-1, required=True)
@click.option(
    "--period",
    type=click.IntRange(min=3),
    metavar="N",
    help="Length of a frame in bytes, if the file consists of frames of equal length.",
)
@click.option(
    "--offset",
    type=click.IntRange(min=0),
    metavar="N",
    default=0,
    help="Offset of the first frame.",
)
@output_options
def crc(
    words: Sequence[str], period: int | None, offset: int, as_json: bool, output: str | None
) -> None:
    """Find the checksum of sample frames: XOR, sums, or a CRC of 8, 16 or 32 bits.

    Each argument is a frame in hexadecimal digits. Frames can also be read from a text file with
    one frame per line (.hex, .txt), a capture, or raw bytes. In raw bytes, frames are found by
    their structure, or by their length with --period. More frames give a more certain result; a
    dozen is enough. Only the beginning of a long file is read.
    """
    frames = _parse_frames(words, period, offset)
    matches = search(frames)
    if as_json:
        emit_json(
            {"frames": len(frames), "matches": [match_to_dict(match) for match in matches]}, output
        )
    elif matches:
        shown = [match for match in matches if match.is_ambiguous == matches[0].is_ambiguous][
            :MAX_PRINTED_MATCHES
        ]
        emit("\n\n".join(_describe_match(match, len(frames[0])) for match in shown), output)
    if not matches:
        note(
            f"no checksum found in {len(frames)} frame{'s' * (len(frames) != 1)}: check that the"
            " frames are complete"
        )
        raise click.exceptions.Exit(FINDINGS)
    if matches[0].evidence_bits < WEAK_BITS:
        note("the match may be a coincidence: repeat with more frames")


def _parse_frames(words: Sequence[str], period: int | None, offset: int) -> list[bytes]:
    if len(words) == 1 and (words[0] == "-" or os.path.exists(words[0])):
        return _read_frames(words[0], period, offset)
    whole = read_sample(words).data
    if period is not None:
        return split_frames(whole, period, offset)
    each = [read_sample([word]).data for word in words]
    if min(map(len, each)) > 2:
        return each
    return [whole]


def _read_frames(path: str, period: int | None, offset: int) -> list[bytes]:
    if path != "-" and not path.endswith(HEX):
        sample = max(read_samples(path), key=lambda sample: sample.size)
        if not sample.size:
            raise suggest(WireError(no_bytes_message(path, sample.warnings)), "lidarspec sensors")
        for warning in sample.warnings:
            note(warning)
        chunks = sample.chunks
        datagrams = sample.datagrams
    else:
        sample_bytes = read_sample([path])
        chunks = tuple(chunk for chunk in sample_bytes.chunks if chunk)
        datagrams = (
            path.endswith(HEX) and len(chunks) > 1 and max(map(len, chunks)) < MAX_DATAGRAM_BYTES
        )
    if period is not None:
        return split_frames(b"".join(chunks), period, offset)
    if datagrams and path.endswith(HEX):
        return list(chunks)
    structure = find_structure(chunks, datagrams=datagrams)
    if structure is None:
        raise suggest(
            UsageError(f"{path}: no repeated structure found, so the starts of frames are unknown"),
            f"lidarspec crc {quote(path)} --period BYTES --offset BYTES",
        )
    if structure.period:
        length = f"{structure.period} bytes"
    else:
        length = f"{structure.length} bytes"
    note(
        f"found {len(structure.frames)} frames of {length}, beginning with"
        f" {structure.sync.hex(' ')}"
    )
    return list(structure.frames)


def match_to_dict(match: ChecksumMatch) -> dict[str, Any]:
    """Return a match as a JSON object."""
    return {
        "checksum": match.algorithm.describe(),
        "name": match.name,
        "paste": match.source,
        "field": {"offset": match.place.offset, "size": match.place.size, "order": match.order},
        "over": {"part": match.span.part, "head": match.span.head, "tail": match.span.tail},
        "right": match.right,
        "frames": match.total,
        "evidence_bits": round(match.evidence_bits, 1),
        "remarks": list(match.remarks),
    }


def _describe_match(match: ChecksumMatch, length: int) -> str:
    if match.place.size > 1:
        order = f", {match.order}-endian"
    else:
        order = ""
    name = f" ({match.name})" if match.name else ""
    if match.evidence_bits >= WEAK_BITS:
        chance = f"probability of a coincidence: 1 in {match.odds}"
    else:
        chance = "may be a coincidence"
    lines = [
        (
            f"{match.algorithm.describe()}{name}: correct in {match.right} of {match.total} frames;"
            f" {chance}"
        ),
        f"  field:  {match.place}{order}",
        f"  covers: {match.span.describe(match.place, length)}",
        *(f"  note:   {remark}" for remark in match.remarks),
    ]
    if "\n" in match.source:
        paste = f"\n{indent(match.source, '    ')}"
    else:
        paste = f"  {match.source}"
    return "\n".join([*lines, f"  paste:{paste}"])


@click.command()
@click.argument("source", required=False)
@click.option(
    "-t",
    "--duration",
    type=DURATION,
    default=LISTEN_S,
    metavar="TIME",
    help="Time to listen at each port and baud rate.",
)
@click.option(
    "--start",
    is_flag=True,
    help="Also send the start commands of sensors that are silent until started.",
)
@output_options
def detect(
    source: str | None, duration: float, start: bool, as_json: bool, output: str | None
) -> None:
    """Identify the sensor that sends data, its port and its baud rate.

    SOURCE is a port, a file or a capture. Without SOURCE, all serial ports are tried at the baud
    rates of the installed sensors, and the UDP ports of these sensors are tried as well. Sensors
    are ranked by the share of the bytes that are in frames with a valid checksum and plausible
    values. Models with the same frames are distinguished, if possible, by packets that only one
    model sends, by the clock step per packet, by a model name in the frames, or by the baud rate.
    -v also lists the sensors that were ruled out.
    """
    if source == "-":
        raise suggest(
            UsageError("standard input can be read only once: write it to a file first"),
            "lidarspec detect FILE",
        )
    if source is None:
        found_verdicts = list(_detect_all_ports(duration, start=start))
    else:
        source = resolve_device_name(source)
        with Progress() as progress:
            found_verdicts = _detect_source(
                source,
                duration,
                start=start,
                on_progress=lambda text: progress(lambda: f"listening to {text}"),
            )
    fitting = [verdict for verdict in found_verdicts if verdict.scores]
    if fitting or any(verdict.fault for verdict in found_verdicts):
        unknown = None
    else:
        unknown = _find_structure(found_verdicts)
    if as_json:
        emit_json(
            {
                "sources": [_verdict_to_dict(verdict) for verdict in found_verdicts],
                "structure": _structure_to_dict(unknown),
            },
            output,
        )
    elif fitting:
        emit(_format_detected(found_verdicts, output), output)
    elif unknown is not None:
        emit(_format_structure(unknown), output)
    for line in _iter_conclusions(source, found_verdicts, unknown, start=start):
        note(line)
    if not any(verdict.candidates for verdict in fitting):
        raise click.exceptions.Exit(_find_exit_code(source, found_verdicts))


def _find_exit_code(source: str | None, verdicts: Sequence[Verdict]) -> int:
    """Return the exit code of `detect` for input that no sensor fits."""
    is_live = source is None or live_address(source) is not None
    is_silent = is_live and not any(verdict.sample.size for verdict in verdicts)
    if is_silent:
        return DEVICE
    return NO_DATA


def _detect_source(
    source: str,
    duration: float,
    *,
    start: bool,
    on_progress: Callable[[str], None] = ignore_progress,
) -> list[Verdict]:
    verdicts = identify_senders(source, seconds=duration, on_progress=on_progress)
    if start and not any(verdict.scores for verdict in verdicts):
        for sample in probe(source):
            verdicts = [select_best([*verdicts, identify_sample(sample)])]
            if verdicts[0].is_clear:
                break
    return verdicts


def _detect_all_ports(duration: float, *, start: bool) -> Iterator[Verdict]:
    """Listen to all ports at the same time, and yield a verdict for each port."""
    serial = [port.path for port in list_serial_ports()]
    udp = list_udp_ports()
    note(
        f"listening to {len(serial)} serial port{'s' * (len(serial) != 1)} and UDP"
        f" {', '.join(map(str, udp))}"
    )

    def listen(source: str) -> list[Verdict]:
        try:
            return _detect_source(source, duration, start=start)
        except (SourceError, UsageError) as error:
            if isinstance(error, SourceError):
                failure = error
            else:
                failure = SourceError(str(error))
            return [Verdict(SampleBytes(source, failure=failure))]

    sources = [*serial, *(f"udp://:{port}" for port in udp)]
    with ThreadPoolExecutor(max_workers=len(sources) or 1) as pool:
        yield from itertools.chain.from_iterable(pool.map(listen, sources))


def _find_structure(verdicts: Sequence[Verdict]) -> FrameStructure | None:
    """Return the structure of the largest sample of bytes; None if none is found."""
    sample = max(
        (verdict.sample for verdict in verdicts), key=lambda sample: sample.size, default=None
    )
    if sample is not None and sample.size:
        return find_structure(sample.chunks, datagrams=sample.datagrams)
    return None


def _format_detected(verdicts: Sequence[Verdict], output: str | None) -> str:
    """Return a table of the sensors that fit each source."""
    rows = []
    for verdict in verdicts:
        alike = {score.sensor.id for score in verdict.candidates}
        listed = verdict.scores
        if verbosity.loudness <= 0 and (verdict.candidates or verdict.others):
            listed = verdict.candidates  # without the sensors that were ruled out
        for score in listed:
            if score.sensor.id not in alike:
                verdict_of = "no"
            elif verdict.sensor is not None:
                verdict_of = "yes"
            else:
                verdict_of = "perhaps"
            rows.append(
                [
                    _describe_place(verdict.sample),
                    score.sensor.id,
                    verdict_of,
                    f"{score.share:.1%}",
                    str(score.data_frames),
                    score.evidence,
                ]
            )
        verdict_of = "perhaps" if alike else "yes"
        rows += [
            [_describe_place(verdict.sample), f"{name}, not installed", verdict_of, "", "", why]
            for name, why in verdict.others.items()
        ]
    return table(
        ["source", "sensor", "match", "in frames", "data frames", "evidence"], rows, output
    )


def _describe_place(sample: SampleBytes) -> str:
    where = sample.source + (f" from {sample.sender}" if sample.sender else "")
    if sample.baud is not None:
        return f"{where} at {sample.baud} baud"
    return where


def _iter_conclusions(
    source: str | None, verdicts: Sequence[Verdict], unknown: FrameStructure | None, *, start: bool
) -> Iterator[str]:
    missing = _find_uninstalled(verdicts)
    if not sensors() and not missing:
        yield no_sensors_text()
    yield from dict.fromkeys(warning for verdict in verdicts for warning in verdict.sample.warnings)
    for verdict in verdicts:
        if verdict.sample.failure is not None:
            yield f"{verdict.sample.failure}"
        elif verdict.sensor is not None:
            options = format_sensor_options(verdict.sensor)
            yield f"next: lidarspec {_find_verb(verdict)} {_format_source(verdict)} {options}"
        elif verdict.candidates:
            yield (
                f"{_describe_place(verdict.sample)}: choose the model, because these models send"
                f" the same frames: {', '.join(list_candidates(verdict))}"
            )
            if files := [
                name
                for name in verdict.candidates[0].sensor.configure.files
                if verdict.candidates[0].sensor.recognise is not None
            ]:
                yield f"the packets do not contain the beam angles: add -O {files[0]}=FILE"
            options = format_sensor_options(verdict.candidates[0].sensor)
            yield f"next: lidarspec {_find_verb(verdict)} {_format_source(verdict)} {options}"
        elif verdict.others:
            yield f"{_describe_place(verdict.sample)}: {describe_unsupported_models(verdict)}"
            relative = next(iter(verdict.others))
            known_sensor = find_known_sensor(relative)
            if known_sensor is not None:
                yield f"next: {install_command(known_sensor.distribution)}"
            else:
                source_word = quote(verdict.sample.source)
                yield f"next: lidarspec new {relative} --from-capture {source_word}"
    if any(verdict.scores for verdict in verdicts):
        return
    size = sum(verdict.sample.size for verdict in verdicts)
    faulty = [verdict for verdict in verdicts if verdict.fault]
    for verdict in faulty:
        yield f"{_describe_place(verdict.sample)}: {verdict.fault}"
        yield f"next: lidarspec crc {quote(verdict.sample.source)}"
    if faulty:
        return
    if missing:
        yield describe(missing)
        yield f"next: {make_install_command(missing)}"
        return
    if size:
        if any(verdict.sample.is_text for verdict in verdicts):
            kind = " of text"
        else:
            kind = ""
        if unknown:
            structure_note = ""
        else:
            structure_note = ", and have no repeated structure"
        yield f"{size} bytes{kind} contain no frame of an installed sensor{structure_note}"
        yield f"next: {_find_next_command(source, unknown)}"
        return
    has_warnings = any(verdict.sample.warnings for verdict in verdicts)
    if source is not None and live_address(source) is None:
        if not has_warnings:
            yield no_bytes_message(source, ())
        yield "next: lidarspec sensors"
        return
    if not has_warnings:
        yield "no data received"
    is_serial = source is None or (
        (address := live_address(source)) is not None and address.scheme == "serial"
    )
    if is_serial and not start and list_start_required():
        yield (
            "these sensors send nothing until they are started:"
            f" {', '.join(sensor.id for sensor in list_start_required())}"
        )
        yield f"next: lidarspec detect {source or ''}".rstrip() + " --start"
    else:
        yield f"next: lidarspec doctor {quote(source) if source else ''}".rstrip()


def _find_uninstalled(verdicts: Sequence[Verdict]) -> list[KnownSensor]:
    """Return sensors that are not installed but may have sent most of the bytes."""
    if any(verdict.scores or verdict.fault for verdict in verdicts):
        return []
    largest = max(
        (verdict.sample for verdict in verdicts), key=lambda sample: sample.size, default=None
    )
    if largest is not None and largest.size:
        return recognize(largest)
    return []


def _find_verb(verdict: Verdict) -> str:
    verb = "view"
    if verdict.candidates:
        verb = verb_to_show(verdict.candidates[0].sensor)
    if verb == "view" and live_address(verdict.sample.source) is None:
        return "read"
    return verb


def _find_next_command(source: str | None, unknown: FrameStructure | None) -> str:
    """Return the command to suggest if the bytes fit no installed sensor."""
    if source is None or live_address(source) is not None:
        return f"lidarspec doctor {quote(source) if source else ''}".rstrip()
    if unknown is None or unknown.checksums:
        return "lidarspec sensors"
    if unknown.period:
        period = f" --period {unknown.period}"
    else:
        period = ""
    return f"lidarspec crc {quote(source)}{period}"


def _format_source(verdict: Verdict) -> str:
    """Return the SOURCE of a verdict, with baud rate and sender, for use in a command."""
    source = verdict.sample.source
    sample = verdict.sample
    link = find_data_link(verdict.sensor, Serial)
    if (
        sample.baud is not None
        and "baud=" not in source
        and not (link and link.baud == sample.baud)
    ):
        source = with_option(source, "baud", sample.baud)
    if sample.sender and "src=" not in source:
        source = with_option(source, "src", sample.sender)
    return quote(source)


def _verdict_to_dict(verdict: Verdict) -> dict[str, Any]:
    """Return a verdict as a JSON object."""
    sample = verdict.sample
    return {
        "source": sample.source,
        "baud": sample.baud,
        "sender": sample.sender or None,
        "bytes": sample.size,
        "failure": str(sample.failure) if sample.failure else None,
        "sensor": verdict.sensor.id if verdict.sensor is not None else None,
        "alike": [score.sensor.id for score in verdict.candidates],
        "not_installed": dict(verdict.others),
        "fault": verdict.fault or None,
        "fits": [
            {
                "sensor": score.sensor.id,
                "share": round(score.share, 4),
                "data_frames": score.data_frames,
                "told_by": score.evidence,
            }
            for score in verdict.scores
        ],
    }


def _structure_to_dict(structure: FrameStructure | None) -> dict[str, Any] | None:
    if structure is None:
        return None
    return {
        "sync": structure.sync.hex(" "),
        "period": structure.period,
        "length": str(structure.length) if structure.length else None,
        "share": round(structure.share, 4),
        "frames": len(structure.frames),
        "checksums": [match_to_dict(match) for match in structure.checksums],
    }


def _format_structure(structure: FrameStructure) -> str:
    if structure.period:
        length = f"{structure.period} bytes each"
    else:
        length = f"of {structure.length} bytes"
    lines = [
        "unknown frames:",
        f"  sync      {structure.sync.hex(' ') or 'unknown'}",
        f"  length    {length}: {len(structure.frames)} frames, {structure.share:.0%} of the bytes",
    ]
    for match in structure.checksums[:MAX_PRINTED_CHECKSUMS]:
        if "\n" not in match.source:
            checksum = match.source
        else:
            checksum = match.algorithm.describe()
        lines.append(
            f"  checksum  {checksum} in {match.place}: correct in {match.right} of {match.total}"
        )
    return "\n".join(lines if structure.checksums else [*lines, "  checksum  not found"])


@click.command()
@click.argument("source", required=False)
@sensor_option
@click.option(
    "-t",
    "--duration",
    type=DURATION,
    default=LISTEN_S,
    metavar="TIME",
    help="Time to listen at each port and baud rate.",
)
@output_options
def doctor(
    source: str | None,
    sensor_id: str | Sensor | None,
    duration: float,
    as_json: bool,
    output: str | None,
) -> None:
    """Diagnose why no data arrives from a sensor, and suggest a fix.

    The checks find missing ports, missing permissions, ports in use, small buffers, sensors that
    send nothing, a wrong baud rate and a wrong interface. Without SOURCE, all ports of this
    computer are checked. The exit code is 1 if a fault is found.
    """
    if sensor_id is None:
        sensor = None
    else:
        sensor = named_sensor(sensor_id)
    if source is not None and not as_json:
        note(f"listening to {source}")
    if source is None:
        diagnoses = list(examine_computer())
    else:
        diagnoses = list(examine(source, sensor, seconds=duration))
        if all(finding.ok for finding in diagnoses):
            about_clock = diagnose_clock(source, sensor_id, duration)
            diagnoses += [] if about_clock is None else [about_clock]
    if as_json:
        emit_json([finding.to_dict() for finding in diagnoses], output)
    else:
        lines = [
            f"{'ok   ' if finding.ok else 'wrong'}  {finding.text}"
            + (f"\n       next: {finding.fix}" if finding.fix else "")
            for finding in diagnoses
        ]
        emit("\n".join(lines) or "no problem found with the ports of this computer", output)
    if sensor is None and not sensors():
        note(no_sensors_text())
    if any(not finding.ok for finding in diagnoses):
        raise click.exceptions.Exit(FINDINGS)
