"""`ports`, `detect`, `doctor` and `crc`: find ports, sensors, faults, checksums."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from shlex import quote
from textwrap import indent
from typing import Any

import click

from lidarspec.cli.failures import DEVICE, FINDINGS, NO_DATA
from lidarspec.cli.inputs import read
from lidarspec.cli.options import DURATION, sensor_option
from lidarspec.cli.output import Progress, emit, emit_json, output_options, table
from lidarspec.cli.terminal import note, voice
from lidarspec.detect.doctor import examine, examine_computer
from lidarspec.detect.identification import (
    Verdict,
    describe_unsupported_models,
    format_sensor_options,
    identify_sample,
    identify_senders,
    list_candidates,
    select_best,
)
from lidarspec.detect.listen import (
    LISTEN,
    ignore_progress,
    list_start_required,
    list_udp_ports,
    probe,
    read_samples,
)
from lidarspec.detect.sample_bytes import SampleBytes
from lidarspec.detect.uninstalled_sensors import describe, install_commands, recognize
from lidarspec.drafting.checksum_search import search
from lidarspec.drafting.periods import FrameStructure, find_structure, split_frames
from lidarspec.drafting.samples import ChecksumMatch
from lidarspec.errors import SourceError, UsageError, WireError, suggest
from lidarspec.known_sensors import KnownSensor, find_known_sensor, install_command, no_sensors
from lidarspec.plugins import sensor as named_sensor, sensors
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Serial, Udp
from lidarspec.transports.addresses import with_option
from lidarspec.transports.base import data_link
from lidarspec.transports.open_url import live_address, resolve
from lidarspec.transports.ports import PortUser, SerialPort, find_udp_users, list_serial_ports
from lidarspec.transports.protocol import no_bytes

#: Bits of evidence below which a match may be chance.
WEAK = 12
#: Maximum number of matches to print.
PRINTED = 4
HEX = (".hex", ".txt")
LONGEST = 1 << 16
#: Maximum number of checksums to print for unknown bytes.
TOLD = 2


@click.command()
@output_options
def ports(as_json: bool, output: str | None) -> None:
    """List the serial ports of this computer, and the UDP ports of installed sensors."""
    serial = list_serial_ports()
    udp = {port: find_udp_users(port) for port in list_udp_ports()}
    if as_json:
        listed = [{**vars(port), "users": [vars(user) for user in port.users]} for port in serial]
        emit_json(
            {"serial": listed, "udp": [_udp(port, users) for port, users in udp.items()]}, output
        )
        return
    rows = [
        [port.path, port.description or "serial port", _state(port), port.lasting]
        for port in serial
    ]
    rows += [
        [f"udp://:{port}", ", ".join(_senders(port)), _udp_state(users), ""]
        for port, users in udp.items()
    ]
    emit(table(["port", "description", "state", "stable name"], rows, output), output)
    if not serial:
        note("no serial port found: check that the device is plugged in")
    note(
        f"next: lidarspec detect{f' {serial[0].path}' if len(serial) == 1 else ''}"
        if sensors()
        else no_sensors()
    )


def _senders(port: int) -> list[str]:
    """Return the installed sensors that send data to a UDP port."""
    return [
        sensor.id
        for sensor in sensors().values()
        if (link := data_link(sensor, Udp)) and port in link.ports
    ]


def _state(port: SerialPort) -> str:
    if not port.allowed:
        return "no permission: lidarspec doctor"
    if port.users:
        return f"in use by {', '.join(map(str, port.users))}"
    return "free"


def _udp_state(users: tuple[PortUser, ...] | None) -> str:
    if users is None:
        return "free"
    return f"in use by {', '.join(map(str, users)) or 'another user'}"


def _udp(port: int, users: tuple[PortUser, ...] | None) -> dict[str, Any]:
    return {
        "port": port,
        "sensors": _senders(port),
        "free": users is None,
        "users": [vars(user) for user in users or ()],
    }


@click.command()
@click.argument("words", metavar="HEX...|FILE|-", nargs=-1, required=True)
@click.option(
    "--period",
    type=click.IntRange(min=3),
    help="Length of the frames in bytes, for a file of consecutive frames.",
)
@click.option("--offset", type=click.IntRange(min=0), default=0, help="Offset of the first frame.")
@output_options
def crc(
    words: Sequence[str], period: int | None, offset: int, as_json: bool, output: str | None
) -> None:
    """Find the checksum of sample frames: XOR, sums, or a CRC of 8, 16 or 32 bits.

    Frames are arguments of hexadecimal digits, one frame each; a text file with one frame on each
    line (.hex, .txt); or a capture. In raw bytes the frames are found by their structure, or by
    their length with --period. More frames give a more certain result; a dozen is enough. Only the
    beginning of a long file is read.
    """
    frames = _frames(words, period, offset)
    matches = search(frames)
    if as_json:
        emit_json(
            {"frames": len(frames), "matches": [match_to_dict(match) for match in matches]}, output
        )
    elif matches:
        shown = [match for match in matches if match.open == matches[0].open][:PRINTED]
        emit("\n\n".join(_text(match, len(frames[0])) for match in shown), output)
    if not matches:
        note(
            f"no checksum found in {len(frames)} frame{'s' * (len(frames) != 1)}: check that each"
            " is"
            " complete and begins at its first byte"
        )
        raise click.exceptions.Exit(FINDINGS)
    if matches[0].doubt < WEAK:
        note("the match may be chance: give more frames")


def _frames(words: Sequence[str], period: int | None, offset: int) -> list[bytes]:
    if len(words) == 1 and (words[0] == "-" or os.path.exists(words[0])):
        return _read_frames(words[0], period, offset)
    whole = read(words).data
    if period is not None:
        return split_frames(whole, period, offset)
    each = [read([word]).data for word in words]
    if min(map(len, each)) > 2:
        return each
    return [whole]


def _read_frames(path: str, period: int | None, offset: int) -> list[bytes]:
    if path != "-" and not path.endswith(HEX):
        heard = max(read_samples(path), key=lambda one: one.size)
        if not heard.size:
            raise suggest(WireError(no_bytes(path, heard.warnings)), "lidarspec sensors")
        for warning in heard.warnings:
            note(warning)
        chunks = heard.chunks
        datagrams = heard.datagrams
    else:
        given = read([path])
        chunks = tuple(chunk for chunk in given.chunks if chunk)
        datagrams = path.endswith(HEX) and len(chunks) > 1 and max(map(len, chunks)) < LONGEST
    if period is not None:
        return split_frames(b"".join(chunks), period, offset)
    if datagrams and path.endswith(HEX):
        return list(chunks)
    found = find_structure(chunks, datagrams=datagrams)
    if found is None:
        raise suggest(
            UsageError(f"{path}: cannot find where its frames begin"),
            f"lidarspec crc {quote(path)} --period BYTES --offset BYTES",
        )
    if found.period:
        length = f"{found.period} bytes"
    else:
        length = f"{found.length} bytes"
    note(f"{len(found.frames)} frames that begin with {found.sync.hex(' ')}, {length} long")
    return list(found.frames)


def match_to_dict(match: ChecksumMatch) -> dict[str, Any]:
    """Return a match as a JSON object."""
    return {
        "checksum": match.algorithm.describe(),
        "name": match.name,
        "paste": match.paste,
        "field": {"offset": match.place.offset, "size": match.place.size, "order": match.order},
        "over": {"part": match.span.part, "head": match.span.head, "tail": match.span.tail},
        "right": match.right,
        "frames": match.total,
        "evidence_bits": round(match.doubt, 1),
        "remarks": list(match.remarks),
    }


def _text(match: ChecksumMatch, length: int) -> str:
    if match.place.size > 1:
        order = f", {match.order}-endian"
    else:
        order = ""
    name = f" ({match.name})" if match.name else ""
    if match.doubt >= WEAK:
        chance = f"1 in {match.odds} by chance"
    else:
        chance = "may be chance"
    lines = [
        (
            f"{match.algorithm.describe()}{name}: correct in {match.right} of {match.total} frames;"
            f" {chance}"
        ),
        f"  field: {match.place}{order}",
        f"  over:  {match.span.describe(match.place, length)}",
        *(f"  note:  {remark}" for remark in match.remarks),
    ]
    if "\n" in match.paste:
        paste = f"\n{indent(match.paste, '    ')}"
    else:
        paste = f" {match.paste}"
    return "\n".join([*lines, f"  paste:{paste}"])


@click.command()
@click.argument("source", required=False)
@click.option(
    "-t",
    "--duration",
    type=DURATION,
    default=LISTEN,
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
    """Identify the installed sensor that sends, its port and its baud rate.

    SOURCE is a port, a file or a capture; by default every serial port at every baud rate that
    installed sensors declare, and every UDP port. Sensors are ranked by the share of the bytes that
    are in frames with valid checksum and plausible values. Sensors with the same frames are
    distinguished by their clocks, names in their frames and baud rates, if possible; -v also lists
    the sensors that were ruled out.
    """
    if source == "-":
        raise suggest(
            UsageError("standard input can be read only once: write it to a file first"),
            "lidarspec detect FILE",
        )
    if source is None:
        found = list(_detect_all_ports(duration, start=start))
    else:
        source = resolve(source)
        with Progress() as progress:
            found = _detect_source(
                source,
                duration,
                start=start,
                tell=lambda text: progress(lambda: f"listening to {text}"),
            )
    fitting = [one for one in found if one.scores]
    if fitting or any(one.fault for one in found):
        unknown = None
    else:
        unknown = _find_structure(found)
    if as_json:
        emit_json(
            {
                "sources": [_verdict_to_dict(one) for one in found],
                "structure": _structure_to_dict(unknown),
            },
            output,
        )
    elif fitting:
        emit(_detected_text(found, output), output)
    elif unknown is not None:
        emit(_structure_text(unknown), output)
    for line in _conclusions(source, found, unknown, start=start):
        note(line)
    if not any(one.candidates for one in fitting):
        raise click.exceptions.Exit(_code(source, found))


def _code(source: str | None, found: Sequence[Verdict]) -> int:
    """Return the exit code if no sensor fits.

    It is `DEVICE` if every live source was silent, else `NO_DATA`.
    """
    is_live = source is None or live_address(source) is not None
    is_silent = is_live and not any(one.sample.size for one in found)
    if is_silent:
        return DEVICE
    return NO_DATA


def _detect_source(
    source: str, duration: float, *, start: bool, tell: Callable[[str], None] = ignore_progress
) -> list[Verdict]:
    found = identify_senders(source, seconds=duration, tell=tell)
    if start and not any(one.scores for one in found):
        for heard in probe(source):
            found = [select_best([*found, identify_sample(heard)])]
            if found[0].is_clear:
                break
    return found


def _detect_all_ports(duration: float, *, start: bool) -> Iterator[Verdict]:
    """Listen to all ports at the same time, and yield a verdict for each."""
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


def _find_structure(found: Sequence[Verdict]) -> FrameStructure | None:
    """Return the structure of the bytes that fit no sensor."""
    heard = max((one.sample for one in found), key=lambda heard: heard.size, default=None)
    if heard is not None and heard.size:
        return find_structure(heard.chunks, datagrams=heard.datagrams)
    return None


def _detected_text(found: Sequence[Verdict], output: str | None) -> str:
    rows = []
    for one in found:
        alike = {score.sensor.id for score in one.candidates}
        listed = one.scores
        if voice.loudness <= 0 and (one.candidates or one.others):
            listed = one.candidates  # without the sensors that were ruled out
        for score in listed:
            if score.sensor.id not in alike:
                verdict_of = "no"
            elif one.sensor is not None:
                verdict_of = "yes"
            else:
                verdict_of = "perhaps"
            rows.append(
                [
                    _place(one.sample),
                    score.sensor.id,
                    verdict_of,
                    f"{score.share:.1%}",
                    str(score.data_frames),
                    score.why,
                ]
            )
        verdict_of = "perhaps" if alike else "yes"
        rows += [
            [_place(one.sample), f"{name}, not installed", verdict_of, "", "", why]
            for name, why in one.others.items()
        ]
    return table(
        ["source", "sensor", "match", "in frames", "data frames", "evidence"], rows, output
    )


def _place(heard: SampleBytes) -> str:
    where = heard.source + (f" from {heard.sender}" if heard.sender else "")
    if heard.baud is not None:
        return f"{where} at {heard.baud} baud"
    return where


def _conclusions(
    source: str | None, found: Sequence[Verdict], unknown: FrameStructure | None, *, start: bool
) -> Iterator[str]:
    missing = _find_uninstalled(found)
    if not sensors() and not missing:
        yield no_sensors()
    yield from dict.fromkeys(warning for one in found for warning in one.sample.warnings)
    for one in found:
        if one.sample.failure is not None:
            yield f"{one.sample.failure}"
        elif one.sensor is not None:
            options = format_sensor_options(one.sensor)
            yield f"next: lidarspec {_verb(one)} {_format_source(one)} {options}"
        elif one.candidates:
            yield (
                f"{_place(one.sample)}: {', '.join(list_candidates(one))} send the same frames,"
                " which do not identify the model: choose one"
            )
            if files := [
                name
                for name in one.candidates[0].sensor.configure.files
                if one.candidates[0].sensor.recognise is not None
            ]:
                yield (f"the packets do not contain beam angles: pass -O {files[0]}=FILE")
            options = format_sensor_options(one.candidates[0].sensor)
            yield f"next: lidarspec {_verb(one)} {_format_source(one)} {options}"
        elif one.others:
            yield f"{_place(one.sample)}: {describe_unsupported_models(one)}"
            relative = next(iter(one.others))
            known = find_known_sensor(relative)
            if known is not None:
                yield f"next: {install_command(known.distribution)}"
            else:
                yield f"next: lidarspec new {relative} --from-capture {quote(one.sample.source)}"
    if any(one.scores for one in found):
        return
    size = sum(one.sample.size for one in found)
    for one in (faulty := [one for one in found if one.fault]):
        yield f"{_place(one.sample)}: {one.fault}"
        yield f"next: lidarspec crc {quote(one.sample.source)}"
    if faulty:
        return
    if missing:
        yield describe(missing)
        yield f"next: {install_commands(missing)}"
        return
    if size:
        if any(one.sample.is_text for one in found):
            kind = " of text"
        else:
            kind = ""
        if unknown:
            structure_note = ""
        else:
            structure_note = "; no repeated structure found"
        yield f"{size} bytes{kind} without a frame of an installed sensor{structure_note}"
        yield f"next: {_following(source, unknown)}"
        return
    if source is not None and live_address(source) is None:
        yield from [no_bytes(source, ())] * (not any(one.sample.warnings for one in found))
        yield "next: lidarspec sensors"
        return
    yield from [] if any(one.sample.warnings for one in found) else ["no data received"]
    is_serial = source is None or (
        (address := live_address(source)) is not None and address.scheme == "serial"
    )
    if is_serial and not start and list_start_required():
        yield (
            f"{', '.join(sensor.id for sensor in list_start_required())} send nothing until they"
            " are started"
        )
        yield f"next: lidarspec detect {source or ''}".rstrip() + " --start"
    else:
        yield f"next: lidarspec doctor {quote(source) if source else ''}".rstrip()


def _find_uninstalled(found: Sequence[Verdict]) -> list[KnownSensor]:
    """Return the sensors that are not installed and may have sent most of the bytes.

    Returns an empty list if an installed sensor fits.
    """
    if any(one.scores or one.fault for one in found):
        return []
    largest = max((one.sample for one in found), key=lambda heard: heard.size, default=None)
    if largest is not None and largest.size:
        return recognize(largest)
    return []


def _verb(one: Verdict) -> str:
    if live_address(one.sample.source) is None:
        return "read"
    return "view"


def _following(source: str | None, unknown: FrameStructure | None) -> str:
    """Return the next command for bytes that fit no sensor."""
    if source is None or live_address(source) is not None:
        return f"lidarspec doctor {quote(source) if source else ''}".rstrip()
    if unknown is None or unknown.checksums:
        return "lidarspec sensors"
    if unknown.period:
        period = f" --period {unknown.period}"
    else:
        period = ""
    return f"lidarspec crc {quote(source)}{period}"


def _format_source(one: Verdict) -> str:
    """Return the source with the baud rate and the sender that were found."""
    source = one.sample.source
    heard = one.sample
    link = data_link(one.sensor, Serial)
    if heard.baud is not None and "baud=" not in source and not (link and link.baud == heard.baud):
        source = with_option(source, "baud", heard.baud)
    if heard.sender and "src=" not in source:
        source = with_option(source, "src", heard.sender)
    return quote(source)


def _verdict_to_dict(one: Verdict) -> dict[str, Any]:
    """Return a verdict as a JSON object."""
    heard = one.sample
    return {
        "source": heard.source,
        "baud": heard.baud,
        "sender": heard.sender or None,
        "bytes": heard.size,
        "failure": str(heard.failure) if heard.failure else None,
        "sensor": one.sensor.id if one.sensor is not None else None,
        "alike": [score.sensor.id for score in one.candidates],
        "not_installed": dict(one.others),
        "fault": one.fault or None,
        "fits": [
            {
                "sensor": score.sensor.id,
                "share": round(score.share, 4),
                "data_frames": score.data_frames,
                "told_by": score.why,
            }
            for score in one.scores
        ],
    }


def _structure_to_dict(found: FrameStructure | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        "sync": found.sync.hex(" "),
        "period": found.period,
        "length": str(found.length) if found.length else None,
        "share": round(found.share, 4),
        "frames": len(found.frames),
        "checksums": [match_to_dict(match) for match in found.checksums],
    }


def _structure_text(found: FrameStructure) -> str:
    if found.period:
        length = f"{found.period} bytes each"
    else:
        length = f"of {found.length} bytes"
    lines = [
        "unknown frames:",
        f"  sync      {found.sync.hex(' ') or 'unknown'}",
        f"  length    {length}: {len(found.frames)} frames, {found.share:.0%} of the bytes",
    ]
    for match in found.checksums[:TOLD]:
        if "\n" not in match.paste:
            checksum = match.paste
        else:
            checksum = match.algorithm.describe()
        lines.append(
            f"  checksum  {checksum} in {match.place}: correct in {match.right} of {match.total}"
        )
    return "\n".join(
        lines if found.checksums else [*lines, "  checksum  not found at the usual places"]
    )


@click.command()
@click.argument("source", required=False)
@sensor_option
@click.option(
    "-t",
    "--duration",
    type=DURATION,
    default=LISTEN,
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

    Checks for missing ports and permissions, ports in use, small buffers, silence, a wrong baud
    rate and a wrong interface. Without SOURCE it checks all ports of this computer. The exit code
    is 1 if something is wrong.
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
    if as_json:
        emit_json([vars(finding) for finding in diagnoses], output)
    else:
        lines = [
            f"{'ok   ' if one.ok else 'wrong'}  {one.text}"
            + (f"\n       next: {one.fix}" if one.fix else "")
            for one in diagnoses
        ]
        emit("\n".join(lines) or "no problem found with the ports of this computer", output)
    if sensor is None and not sensors():
        note(no_sensors())
    if any(not finding.ok for finding in diagnoses):
        raise click.exceptions.Exit(FINDINGS)
