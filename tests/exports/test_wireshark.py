"""Tests of Wireshark dissectors: tshark shows the values that lidarspec parses."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import lidarspec
from lidarspec import Sensor
from lidarspec.captures.pcap import CaptureReader
from lidarspec.exports import ExportError, export
from lidarspec.framing.frame_engine import get_codec
from lidarspec.spec import Udp
from lidarspec.testing import sensor_under_test as material
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests import made_captures as made
from tests.exports.sharks import (
    columns,
    dissector,
    needs_tshark,
    tshark,
    write_capture,
    write_dissector,
)
from tests.exports.trees import SHAPED, find_recoded, is_recoded, values
from tests.installed import distinct_sensors_in, sensor_modules
from tests.representatives import REPRESENTATIVES, load_sensor

#: the shapes that Wireshark cannot be told, with the reason.
REFUSED = {
    "shape-text": "Decimal is Python code",
    "shape-names": "does not support bytes whose size depends on their content",
    "shape-fragments": "messages that consist of several datagrams",
    **find_recoded(SHAPED.values()),
}
#: The installed sensors that Wireshark does not support, for the same reason as shape-fragments.
REFUSED_INSTALLED = {"sick-microscan3"}
#: the shapes that tshark reads in `make test-all`; the others are for the long run.
FEW = {"shape-oddities", "shape-options", "shape-segments", "shape-tags", "shape-channels"}
READ = [
    pytest.param(name, marks=() if name in FEW else pytest.mark.soak)
    for name in SHAPED
    if name not in REFUSED
]

#: The representatives without the one whose frames are text, which Wireshark cannot be told.
READ_REPRESENTATIVES = [name for name in REPRESENTATIVES if name != "hokuyo-ust10lx"]

CAPTURES = [
    ("velodyne-vlp16", "velodyne/vlp16_old_firmware/vlp-16-test-90deg-1-50-frames.pcap"),
    ("velodyne-hdl32e", "velodyne/hdl32e/sample_velodyne_hdl32.pcap"),
    ("hesai-xt32", "hesai/xt32/packets.derived.pcap"),
    ("hesai-qt64", "hesai/qt64/packets.derived.pcap"),
    ("hesai-pandar40p", "hesai/40p_20hz/lidar_20Hz.pcapng"),
]

LATER, LONG = {"velodyne-hdl32e", "hesai-xt32", "hesai-qt64"}, pytest.mark.soak

#: what is said of a frame that may be of another type, too.
UNSURE = "these bytes do not distinguish the types"


@pytest.mark.parametrize("name", [name for name in SHAPED if name not in REFUSED])
def test_a_dissector_has_a_field_for_every_field_of_every_frame(name: str) -> None:
    sensor = SHAPED[name]
    text = dissector(sensor)
    for frame, value in sensor.frames.items():
        for path in get_codec(value).schema.fields:
            assert f"{name.replace('-', '_')}.{frame}.{path}" in text, path


def test_python_conditions_are_refused_with_the_reason() -> None:
    for name, reason in REFUSED.items():
        with pytest.raises(ExportError, match=reason):
            export(SHAPED[name], "wireshark")


@needs_tshark
@pytest.mark.parametrize("name", READ)
def test_every_field_of_a_shape_reads_as_lidarspec_reads_it(name: str, tmp_path: Path) -> None:
    assert_fields_are_read(SHAPED[name], tmp_path)


@needs_tshark
@pytest.mark.parametrize("name", READ_REPRESENTATIVES)
def test_every_field_of_a_representative_reads_as_lidarspec_reads_it(
    name: str, tmp_path: Path
) -> None:
    assert_fields_are_read(load_sensor(name), tmp_path, rounds=1)


@needs_tshark
@pytest.mark.soak
@pytest.mark.parametrize("module", sensor_modules())
def test_every_field_of_every_sensor_reads_as_lidarspec_reads_it(
    module: str, tmp_path: Path
) -> None:
    for sensor in distinct_sensors_in(module):
        if not is_recoded(sensor) and sensor.id not in REFUSED_INSTALLED:
            assert_fields_are_read(sensor, tmp_path)


@needs_tshark
def test_datagrams_of_a_sensor_without_a_fixed_port_are_found_by_constants(tmp_path: Path) -> None:
    sensor = replace(SHAPED["shape-datagrams"], links={"data": Udp()})
    assert_fields_are_read(sensor, tmp_path)


def assert_fields_are_read(sensor: Sensor, tmp_path: Path, rounds: int | None = None) -> None:
    """Fail unless tshark reads every frame of a sensor as lidarspec does."""
    outgoing = [
        (name, sensor.example(name, seed=seed))
        for seed in range(3)
        for name in sensor.frames
        if name not in sensor.incoming
    ]
    frames = [
        (_answer(sensor, name, data), data)
        for name, data in [*SensorUnderTest(sensor).conversation(rounds=rounds), *outgoing]
    ]
    capture = write_capture(sensor, [data for _, data in frames], tmp_path / "frames.pcap")
    script = write_dissector(sensor, tmp_path)
    assert_shown(sensor, capture, script, frames)


def _answer(sensor: Sensor, name: str, data: bytes) -> str:
    """Return the frame type that a dissector is expected to report for a frame.

    For a command, this is the reply with the same bytes, if there is one. For other frames, it is
    the first frame type that matches, in the order of the dissector, and that the last announcement
    permits. It may differ from the type of the frame, because a dissector does not evaluate
    `plausible`.
    """
    if name not in sensor.incoming:
        return next((other for other in sensor.incoming if _reads(sensor, other, data)), name)
    in_turn = sorted(
        sensor.incoming, key=lambda other: -len(get_codec(sensor.frames[other]).prefix)
    )  # as the dissector tries them
    awaited = [
        other
        for other in in_turn
        if sensor.frames[other].after in (None, sensor.frames[name].after)
    ]
    untold = (
        other
        for other in awaited
        if other == name or (sensor.frames[other].plausible and _reads(sensor, other, data))
    )
    return next(untold, name)


def _reads(sensor: Sensor, name: str, data: bytes) -> bool:
    try:
        sensor.parse(data, frame=name)
    except lidarspec.WireError:
        return False
    return True


def assert_shown(
    sensor: Sensor,
    capture: Path,
    script: Path,
    frames: Sequence[tuple[str, bytes]],
    *arguments: str,
) -> None:
    """Fail unless tshark shows each packet as this frame without warnings.

    The values must be those that lidarspec parses.
    """
    prefix = sensor.id.replace("-", "_")
    paths = [
        (name, path)
        for name in dict.fromkeys(name for name, _ in frames)
        for path in get_codec(sensor.frames[name]).schema.fields
    ]
    wanted_names = [
        "_ws.expert.message",
        f"{prefix}.frame",
        *(f"{prefix}.{name}.{path}" for name, path in paths),
    ]
    shown = list(columns(capture, script, wanted_names, *arguments))
    assert [kind for _, kind, *_ in shown] == [[name] for name, _ in frames]
    assert not any(
        message for messages, *_ in shown for message in messages if UNSURE not in message
    )
    for (name, data), (_, _, *found) in zip(frames, shown, strict=True):
        parsed = values(sensor.parse(data, frame=name, verify=False))
        for (other, path), printed in zip(paths, found, strict=True):
            wanted = parsed.get(path, []) if other == name else []
            full = [value for value in wanted if value != b""]
            assert len([text for text in printed if text != "<MISSING>"]) == len(full), (
                f"{name}.{path}"
            )
            assert all(_same(text, value) for text, value in zip(printed, full, strict=False)), (
                f"{name}.{path}: {printed} is not {full}"
            )


def _same(text: str, value: Any) -> bool:
    if isinstance(value, bytes):
        return text == value.hex()
    if isinstance(value, float):
        return float(text) == pytest.approx(value, rel=1e-5, nan_ok=True)
    return int(text, 0) == int(value)


@needs_tshark
def test_physical_values_are_fields_too(tmp_path: Path) -> None:
    sensor = lidarspec.sensor("ldrobot-stl27l")
    frame = sensor.build(
        "data", sensor.parse(sensor.example("data")), units=False, start_angle=32427
    )
    capture, script = (
        write_capture(sensor, [frame], tmp_path / "it.pcap"),
        write_dissector(sensor, tmp_path),
    )
    (row,) = columns(
        capture,
        script,
        ["ldrobot_stl27l.data.start_angle", "ldrobot_stl27l.data.start_angle.physical"],
    )
    assert row == [["32427"], ["324.27"]]
    assert tshark(capture, "-Y", "ldrobot_stl27l.data.start_angle.physical > 324", scripts=[script])
    assert not tshark(
        capture, "-Y", "ldrobot_stl27l.data.start_angle.physical > 325", scripts=[script]
    )
    assert "start_angle: 32427 (324.27 deg)" in tshark(capture, "-V", scripts=[script])


@needs_tshark
@pytest.mark.parametrize(
    "name", ["ldrobot-stl27l", "shape-nested", "shape-twice", "shape-nibbles", "shape-oddities"]
)
def test_a_wrong_checksum_is_marked(name: str, tmp_path: Path) -> None:
    sensor = SHAPED.get(name) or lidarspec.sensor(name)
    checksummed = [
        kind
        for kind in sensor.incoming
        if material.find_checksum_paths(sensor, kind, sensor.example(kind))
    ]
    frames = []
    for kind in checksummed:
        good = sensor.example(kind, seed=3)
        place = next(
            spot
            for spot in reversed(range(len(good)))
            if _only_the_checksum(sensor, kind, _flip(good, spot))
        )
        frames += [good, _flip(good, place)]
    capture, script = (
        write_capture(sensor, frames, tmp_path / "it.pcap"),
        write_dissector(sensor, tmp_path),
    )
    prefix = name.replace("-", "_")
    rows = list(
        columns(
            capture,
            script,
            [f"{prefix}.frame", f"{prefix}.checksum.status", f"{prefix}.checksum.bad"],
        )
    )
    assert [kind for kind, _, _ in rows] == [[kind] for kind in checksummed for _ in range(2)]
    for number, (_, status, bad) in enumerate(rows):
        assert ("0" in status) == bool(bad) == bool(number % 2), f"packet {number + 1}"


def _flip(data: bytes, spot: int) -> bytes:
    return bytes([*data[:spot], data[spot] ^ 0x01, *data[spot + 1 :]])


def _only_the_checksum(sensor: Sensor, kind: str, data: bytes) -> bool:
    try:
        sensor.parse(data, frame=kind)
    except lidarspec.WireError as error:
        return "checksum" in str(error)
    return False


@needs_tshark
def test_frames_one_after_another_and_bytes_between_them(tmp_path: Path) -> None:
    sensor = lidarspec.sensor("ldrobot-stl27l")
    frames = [sensor.example("data", seed=seed) for seed in range(3)]
    packet = b"\x01\x02\x54" + frames[0] + frames[1] + _flip(frames[2], 20) + b"\x54\x2c\x99"
    capture, script = (
        write_capture(sensor, [packet, bytes(40)], tmp_path / "it.pcap"),
        write_dissector(sensor, tmp_path),
    )
    names = ["frame", "checksum.status", "skipped", "cut_off", "data.end_angle"]
    first, second = columns(capture, script, [f"ldrobot_stl27l.{name}" for name in names])
    angles = [sensor.parse(frame).end_angle for frame in frames]
    assert (first[0], first[1], len(first[2]), len(first[3])) == (
        ["data"] * 4,
        ["1", "1", "0"],
        1,
        1,
    )
    assert first[4] == [str(angle) for angle in angles]
    assert second == [[]] * 5


@needs_tshark
def test_a_frame_after_a_descriptor_is_recognized(tmp_path: Path) -> None:
    sensor = SHAPED["shape-modes"]
    frames = [
        (name, sensor.example(name, seed=1))
        for name in ("begin_express", "express", "express", "begin_plain", "plain")
    ]
    capture, script = (
        write_capture(sensor, [data for _, data in frames], tmp_path / "it.pcap"),
        write_dissector(sensor, tmp_path),
    )
    assert_shown(sensor, capture, script, frames)
    run = write_capture(sensor, [b"".join(data for _, data in frames)], tmp_path / "run.pcap")
    ((kinds,),) = columns(run, script, ["shape_modes.frame"])
    assert kinds == [name for name, _ in frames]


@needs_tshark
def test_frames_without_a_descriptor_are_marked_uncertain(tmp_path: Path) -> None:
    sensor = lidarspec.sensor("slamtec-rplidar-t1")
    capsule, announcement = (
        sensor.example("dense", seed=1),
        sensor.example("dense_descriptor", seed=1),
    )
    capture = write_capture(sensor, [capsule, announcement, capsule], tmp_path / "it.pcap")
    before, _, behind = columns(
        capture,
        write_dissector(sensor, tmp_path),
        ["slamtec_rplidar_t1.frame", "_ws.expert.message"],
    )
    assert before[0] == ["express"]
    assert [message.partition(":")[0] for message in before[1]] == ["express or dense"]
    assert behind == [["dense"], []]


@needs_tshark
def test_frames_of_one_size_are_distinguished_by_conditions(tmp_path: Path) -> None:
    sensor = lidarspec.sensor("robosense-m1")
    names = ["difop_guide", "difop", "difop_other", "difop_fov"]
    capture = write_capture(
        sensor, [sensor.example(name, seed=2) for name in names], tmp_path / "it.pcap"
    )
    shown = columns(
        capture, write_dissector(sensor, tmp_path), ["robosense_m1.frame", "_ws.expert.message"]
    )
    assert list(shown) == [[[name], []] for name in names]


@needs_tshark
def test_two_dissectors_share_ports_and_link_types(tmp_path: Path) -> None:
    sensors = [
        lidarspec.sensor(name)
        for name in ("velodyne-vlp16", "hesai-xt32", "ldrobot-stl27l", "cspc-m1c1-mini")
    ]
    scripts = [write_dissector(sensor, tmp_path) for sensor in sensors]
    for sensor in sensors:
        capture = write_capture(
            sensor, [sensor.example(sensor.data_frame)], tmp_path / f"{sensor.id}.pcap"
        )
        assert f"{sensor.vendor} {sensor.model}" in tshark(
            capture, "-T", "fields", "-e", "_ws.col.Protocol", scripts=scripts
        )


@needs_tshark
@pytest.mark.parametrize(
    ("name", "path"),
    [pytest.param(*case, id=case[0], marks=LONG if case[0] in LATER else ()) for case in CAPTURES],
)
def test_real_captures(name: str, path: str, tmp_path: Path) -> None:
    capture = made.CAPTURES / path
    if not os.path.exists(capture):
        pytest.skip(f"no capture {path} in {made.CAPTURES} (set LIDARSPEC_CAPTURES)")
    sensor = lidarspec.sensor(name)
    with CaptureReader(capture) as reader:
        datagrams = [datagram.data for datagram, _ in zip(reader, range(12), strict=False)]
    frames = [(found[0].frame, data) for data in datagrams if (found := sensor.split([data]))]
    assert frames
    script = write_dissector(sensor, tmp_path)
    again = write_capture(sensor, [data for _, data in frames], tmp_path / "again.pcap")
    assert_shown(sensor, again, script, frames)
    shown = tshark(
        capture,
        "-c",
        "12",
        "-T",
        "fields",
        "-e",
        f"{name.replace('-', '_')}.frame",
        scripts=[script],
    )
    assert {name for name, _ in frames} <= set(shown.split())


@needs_tshark
@pytest.mark.parametrize(
    ("name", "path"), [("ldrobot-ld06", "ldrobot/ld06_3_consecutive_frames.bin")]
)
def test_a_real_serial_recording(name: str, path: str, tmp_path: Path) -> None:
    source = made.CAPTURES / path
    if not source.exists():
        pytest.skip(f"no capture {path} in {made.CAPTURES} (set LIDARSPEC_CAPTURES)")
    sensor = lidarspec.sensor(name)
    frames = [(found.frame, found.data) for found in sensor.split(source.read_bytes())]
    capture = write_capture(sensor, [source.read_bytes()], tmp_path / "it.pcap")
    ((kinds, angles),) = columns(
        capture,
        write_dissector(sensor, tmp_path),
        ["ldrobot_ld06.frame", "ldrobot_ld06.data.end_angle"],
    )
    assert kinds == [kind for kind, _ in frames]
    assert angles == [str(sensor.parse(data).end_angle) for _, data in frames]


def test_a_dissector_is_lua_that_names_its_source() -> None:
    sensor = lidarspec.sensor("ldrobot-stl27l")
    assert sensor.source in dissector(sensor).splitlines()[1]
