"""The fuzz targets: each reader with its valid examples and documented exceptions.

They read frames and streams of every sensor and shape, captures, recordings, settings, scenes,
vectors, calibration and command lines.
"""

from __future__ import annotations

import contextlib
import functools
import gzip
import io
import json
import lzma
import random
import re
import struct
import tempfile
import zlib
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lidarspec as ls
from lidarspec import Sensor
from lidarspec.batch import MANIFEST, FilePiece, Manifest
from lidarspec.captures.bulk import CaptureBatches
from lidarspec.captures.pcap import CaptureReader, StreamReader
from lidarspec.device.named_devices import FILE as SETTINGS, read_devices
from lidarspec.frames.layout import Layout
from lidarspec.framing.frame_engine import get_codec
from lidarspec.recording.format import (
    DATAGRAM,
    EVENT,
    HEADER,
    MAGIC,
    RECEIVED,
    Header,
    Recording,
    pack_record,
)
from lidarspec.remote_files import hash_ends, read_stamp
from lidarspec.simulation.scenes import read_scene
from lidarspec.testing import sensor_under_test as material
from lidarspec.testing.findings import ViolationError
from lidarspec.testing.sensor_under_test import SensorUnderTest
from lidarspec.testing.vectors import vectors_hold
from lidarspec.transports.hex_text import parse_hex
from lidarspec.transports.open_url import is_port, live_address
from tests import made_captures as made
from tests.calibration_files import write_velodyne_xml
from tests.engine.streams import cut_randomly
from tests.every_sensor import distinct_frames, distinct_sensors
from tests.fuzz.words import HOSTILE, make_first_inputs, run_command
from tests.shapes import SHAPES
from tests.transports import test_robotics_logs

#: longest input.
LONGEST = 1 << 16
#: values at the edges of integers, of every width and both byte orders.
EDGES: tuple[bytes, ...] = tuple(
    (value % (1 << 8 * width)).to_bytes(width, order)
    for width in (1, 2, 4, 8)
    for value in (0, 1, -1, -2, (1 << 8 * width - 1) - 1, 1 << 8 * width - 1, 100, 36_000)
    for order in ("little", "big")
)
#: a number, a text or a list of TOML, JSON or CSV.
VALUE = re.compile(rb'"[^"\n]*"|-?\d[\w.]*|\[[^\[\]]*\]|\{[^{}]*\}')
STL, VLP = "ldrobot-stl27l", "velodyne-vlp16"


@dataclass(frozen=True)
class Target:
    """A reader under test.

    Attributes:
        name: its group, then the sensor or format.
        run: reads one input; an undocumented exception is a finding.
        examples: returns valid inputs, made by the project itself.
        documented: the documented exceptions.
        words: returns byte strings that mutations insert; `EDGES` by default.
        spots: returns the offsets of the fields of an input.
        correct_checksums: returns the input with its checksums corrected, if it has some.
        is_text: whether mutations may replace numbers, texts and lists.
        cost: relative cost of an input within the group; expensive ones are read less often.
    """

    name: str
    run: Callable[[bytes], object]
    examples: Callable[[], list[bytes]]
    documented: tuple[type[Exception], ...] = ()
    words: Callable[[], Sequence[bytes]] = lambda: EDGES
    spots: Callable[[bytes], Sequence[int]] = lambda data: ()
    correct_checksums: Callable[[bytes], bytes] = lambda data: data
    is_text: bool = False
    cost: float = 1.0

    @property
    def group(self) -> str:
        return self.name.partition(" ")[0]

    def mutation(self, data: bytes, other: bytes, source: random.Random) -> bytes:
        """Return a mutation of an input, sometimes with a piece of another one.

        Half of the mutations have correct checksums.
        """
        if self.is_text and source.random() < 0.5 and (values := list(VALUE.finditer(data))):
            start, end = source.choice(values).span()
            return data[:start] + source.choice(self.words()) + data[end:]
        start = source.randrange(len(other) + 1)
        words = (
            self.words()
            if source.random() < 0.8
            else [other[start : start + source.choice((4, 64, LONGEST))]]
        )
        found = material.mutate(data, source, words, self.spots(data))[:LONGEST]
        return self.correct_checksums(found) if source.random() < 0.5 else found


#: group -> its share of all inputs, from what an input costs and how much there is to get wrong.
SHARES = {
    "frame": 0.53,
    "stream": 0.02,
    "capture": 0.15,
    "file": 0.02,
    "log": 0.01,
    "manifest": 0.03,
    "recording": 0.05,
    "settings": 0.03,
    "scene": 0.03,
    "vectors": 0.005,
    "calibration": 0.03,
    "hex": 0.05,
    "source": 0.04,
    "arguments": 0.005,
}


def targets(folder: Path, sensors: Collection[Sensor]) -> dict[str, Target]:
    """Return the targets by name.

    Args:
        folder: an empty folder for the files of the targets. It is also their working directory.
        sensors: the sensors whose frames, streams and calibration files are read.
    """
    found = [_frame(sensor, name) for sensor, name in distinct_frames(sensors)]
    found += [_stream(sensor) for sensor in distinct_sensors(sensors)]
    found += [
        _capture(),
        _file(folder),
        _recording(folder),
        _settings(folder),
        _scene(folder),
        _vectors(folder),
    ]
    found += [_manifest(folder), *(_log(folder, kind) for kind in ("mcap", "bag", "db3"))]
    found += [
        _calibration(sensor, option, folder)
        for sensor in sensors
        if sensor.id not in SHAPES
        for option in sensor.configure.files
    ]
    text = [word.encode() for word in HOSTILE]
    printed = [
        b"54 2c",
        b"0: {0x54, 0x2C}; // one",
        b"0000  54 2c  T,\n0002",
        b"[12:00:01.5] 54 /* */",
    ]
    printed += [b"(1.5) can0 044#1122", b"time,value\n1,0x54"]
    found.append(
        Target(
            "hex",
            lambda data: parse_hex(data.decode("latin-1")),
            lambda: printed,
            (ValueError,),
            lambda: text,
        )
    )
    found.append(
        Target(
            "source",
            _resolve_text,
            lambda: [
                b"udp://:2368?src=192.0.2.1",
                b"serial:///dev/ttyUSB0?baud=9600&dtr=on",
                *(word for word in text if b":" in word),
            ],
            (ls.UsageError,),
            lambda: text,
        )
    )
    found.append(Target("arguments", functools.partial(run_command, folder), make_first_inputs))
    return {target.name: target for target in found}


def _frame(sensor: Sensor, name: str) -> Target:
    """Return the target that parses and explains frames of one type.

    A frame is parsed as this type, and as any type.
    """
    subject = SensorUnderTest(sensor)

    def run(data: bytes) -> None:
        parse = functools.partial(sensor.parse, data)
        for call in (
            lambda: parse(frame=name),
            lambda: parse(frame=name, verify=False, units=bool(len(data) & 1)),
        ):
            _but(ls.WireError, call)
        if zlib.crc32(data) % (64 + len(data)) == 0:
            _but(ls.WireError, parse)
            _but(ls.WireError, lambda: str(ls.explain(data, sensor)))

    @functools.lru_cache(maxsize=256)
    def layout(data: bytes) -> Layout | None:
        tree = getattr(get_codec(sensor.frames[name]), "tree", None)
        found = tree.layout(data) if tree is not None else None
        return found if isinstance(found, Layout) and found.size <= len(data) else None

    def spots(data: bytes) -> list[int]:
        found = layout(data)
        return [] if found is None else sorted({start for start, _ in found.places.values()})

    def correct_checksums(data: bytes) -> bytes:
        found = layout(data)
        if found is None:
            return data
        rows = np.frombuffer(data[: found.size], np.uint8).reshape(1, -1).copy()
        for checksum in found.checksums:
            checksum.fill(rows)
        return rows.tobytes() + data[found.size :]

    def made() -> list[bytes]:
        return [subject.example(name, seed=seed) for seed in range(6)]

    return Target(
        f"frame {sensor.id} {name}",
        run,
        made,
        spots=spots,
        correct_checksums=correct_checksums,
        cost=100 + sensor.frames[name].max_length,
    )


def _stream(sensor: Sensor) -> Target:
    """Return the target that decodes a stream in pieces, or datagrams, to scans.

    No exception is documented.
    """
    subject = SensorUnderTest(sensor)

    def run(data: bytes) -> None:
        source = random.Random(zlib.crc32(data))
        chunks = _datagrams(data) if sensor.datagrams else list(cut_randomly(data, source))
        decoder = sensor.decoder()
        for chunk in chunks:
            decoder.feed(chunk)
            if source.random() < 0.02:
                decoder.idle()
        decoder.finish()
        for scan in (
            sensor.scans(chunks if sensor.datagrams else data) if sensor.points is not None else ()
        ):
            scan.points.to_structured()

    def examples() -> list[bytes]:
        talks = [
            [data for _, data in subject.conversation(seed=seed, rounds=2)][:12]
            for seed in range(3)
        ]
        return [
            b"".join(
                struct.pack("<H", len(data)) + data if sensor.datagrams else data for data in talk
            )
            for talk in talks
        ]

    @functools.cache
    def words() -> list[bytes]:
        pieces = [subject.example(name, seed=seed) for name in sensor.incoming for seed in range(2)]
        return [*EDGES, *pieces, *(piece[:size] for piece in pieces for size in (1, 2, 4, 7))]

    return Target(f"stream {sensor.id}", run, examples, words=words)


def _datagrams(data: bytes) -> list[bytes]:
    """Return the datagrams in some bytes; two bytes before each are its length."""
    found = []
    while data:
        size = int.from_bytes(data[:2], "little")
        found.append(data[2 : 2 + size])
        data = data[2 + size :]
    return found


#: Link types of captures that are read, and some that are not.
LINKS = (0, 1, 12, 101, 108, 113, 228, 229, 276, 9, 105, 147, 999)


def _capture() -> Target:
    """Return the target that reads captures with all three readers.

    The captures have every link type and both formats.
    """

    def run(data: bytes) -> None:
        for reader in (CaptureReader, StreamReader):
            _but(ls.SourceError, lambda reader=reader: list(reader(io.BytesIO(data))))
        _but(
            ls.SourceError,
            lambda: [batch.data(0) for batch in CaptureBatches(io.BytesIO(data)).batches()],
        )

    blocks = [
        made.section(),
        made.section(">"),
        made.interface(options=made.option(9, b"\x09")),
        made.packet(made.frame(b"x")),
        made.record(b""),
    ]
    packets = [
        made.ipv4(made.udp(b"payload")),
        made.ipv6(made.udp(b"payload")),
        made.ethernet(made.ipv4(made.udp(b"x")), ethertype=0x8100),
    ]
    return Target(
        "capture",
        run,
        _captures,
        words=lambda: [*EDGES, *blocks, *packets, *(struct.pack("<I", link) for link in LINKS)],
    )


def _captures() -> list[bytes]:
    packets = [
        made.frame(b"payload"),
        made.ipv4(made.udp(b"raw")),
        b"\x02\0\0\0" + made.ipv4(made.udp(b"loop")),
        made.ethernet(made.ipv6(made.udp(b"six")), ethertype=0x86DD),
    ]
    found = [made.pcap(*packets, link=link) for link in LINKS]
    for order in ("<", ">"):
        kinds = [
            made.packet(packet, order, kind=kind)
            for packet in packets
            for kind in (made.ENHANCED, made.SIMPLE, made.OBSOLETE)
        ]
        found.append(
            made.section(order)
            + made.interface(order, options=made.option(9, b"\x06", order))
            + b"".join(kinds)
        )
    parts = [
        made.ipv4(part, place=place)
        for part, place in ((made.udp(bytes(32), length=40)[:24], 0x2000), (bytes(16), 3))
    ]
    return [
        *found,
        made.pcap(*map(made.ethernet, parts)),
        b"".join([made.pcap(), *[made.record(made.frame(b"same"))] * 20]),
    ]


def _file(folder: Path) -> Target:
    """Return the target that reads files of every kind to packets and scans.

    If no sensor is given, it is detected.
    """

    def run(data: bytes) -> None:
        path = folder / ("some.hex" if zlib.crc32(data) & 3 == 0 else "some.bin")
        path.write_bytes(data)
        sensor = VLP if b"\xff\xee" in data else STL
        with ls.open(path, sensor) as device:
            for scan in device.scans():
                len(scan.points.x)
            str(device.stats)

    def examples() -> list[bytes]:
        velodyne = [ls.sensor(VLP).example("data", seed=seed) for seed in range(3)]
        frames = [ls.sensor(STL).example("data", seed=seed) for seed in range(3)]
        with tempfile.TemporaryDirectory() as place:
            topics = {"/p": ("nebula_msgs/msg/NebulaPackets", velodyne)}
            logs = [
                test_robotics_logs.write_log(Path(place), kind, topics).read_bytes()
                for kind in ("bag", "mcap")
            ]
        return [
            *logs,
            made.pcap(*map(made.frame, velodyne)),
            write_recording(STL, frames),
            write_recording(VLP, velodyne),
            b"".join(frames),
            frames[0].hex(" ").encode(),
            gzip.compress(made.pcap(*map(made.frame, velodyne))),
            lzma.compress(write_recording(VLP, velodyne)),
        ]

    return Target(
        "file",
        run,
        examples,
        (ls.LidarSpecError,),
        lambda: [*EDGES, *(word.encode() for word in HOSTILE)],
    )


def _log(folder: Path, kind: str) -> Target:
    """Return the target that reads logs of ROS or Foxglove with packets of a sensor."""
    path = folder / f"some.{kind}"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        with ls.open(path, VLP) as device:
            for packets in device.packets():
                len(packets)

    def examples() -> list[bytes]:
        frames = [ls.sensor(VLP).example("data", seed=seed) for seed in range(3)]
        with tempfile.TemporaryDirectory() as place:
            log = test_robotics_logs.write_log(
                Path(place), kind, {"/p": ("nebula_msgs/msg/NebulaPackets", frames)}
            )
            return [log.read_bytes()]

    return Target(f"log {kind}", run, examples, (ls.LidarSpecError,))


def _manifest(folder: Path) -> Target:
    """Return the target that reads the manifest of an earlier run.

    The result of that run is beside the manifest.
    """
    results = folder / "results"
    source = folder / "drive.bin"
    piece = FilePiece(str(source), STL, {}, str(results / "drive.ply"), True, 10**9)

    def run(data: bytes) -> None:
        results.mkdir(exist_ok=True)
        source.write_bytes(b"")
        Path(piece.target).touch()
        (results / MANIFEST).write_bytes(data)
        with contextlib.closing(Manifest(str(results))) as manifest:
            manifest.find_records(piece)
            manifest.remove_outdated_outputs(piece)

    def examples() -> list[bytes]:
        source.write_bytes(b"")
        made_of = read_stamp(str(source))
        counts = {"first_scan": 0, "scans": 3, "points": 900, "warnings": []}
        done = piece.make_record(
            **made_of, digest=hash_ends(str(source)), **counts, output=piece.output
        )
        failed = replace(piece, number=1).describe_failure(ls.SourceError("gone"))
        return [b"".join(json.dumps(record).encode() + b"\n" for record in (done, failed))]

    return Target(
        "manifest",
        run,
        examples,
        (ls.SourceError,),
        lambda: [b"[" * 5000, b"null", *TOML],
        is_text=True,
    )


def write_recording(sensor: str, frames: Iterable[bytes]) -> bytes:
    """Write a recording of these frames."""
    datagrams = ls.sensor(sensor).datagrams
    sender = {"sender": ("192.0.2.1", 2368), "receiver": ("192.0.2.2", 2368)} if datagrams else {}
    records = [
        pack_record(RECEIVED, frame, 10**18 + index, flags=DATAGRAM * datagrams, **sender)
        for index, frame in enumerate(frames)
    ]
    event = pack_record(EVENT, json.dumps({"event": "disconnected"}).encode(), 10**18)
    return b"".join(
        [
            MAGIC,
            pack_record(HEADER, Header(sensor, source="x", datagrams=datagrams).to_json(), 10**18),
            *records,
            event,
        ]
    )


def _recording(folder: Path) -> Target:
    """Return the target that reads and salvages recordings.

    The checksums of half of them are correct.
    """
    path = folder / "some.lsr"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        for salvage in (False, True):
            with Recording(path, salvage=salvage) as recording:
                for record in recording:
                    str(record)

    def correct_checksums(data: bytes) -> bytes:
        """Return the input with a correct checksum in each record.

        The length in a record gives the offset of the next one.
        """
        found, place = bytearray(data), len(MAGIC)
        while place + 21 <= len(found):
            end = (
                place
                + 17
                + found[place + 6]
                + int.from_bytes(found[place + 7 : place + 9], "little")
            )
            found[end : end + 4] = zlib.crc32(found[place:end]).to_bytes(4, "little")
            place = end + 4
        return bytes(found)

    def examples() -> list[bytes]:
        return [
            write_recording(name, [ls.sensor(name).example("data", seed=seed) for seed in range(2)])
            for name in (STL, VLP)
        ]

    values = [
        value.encode()
        for value in (
            '"a"',
            "[]",
            "{}",
            "null",
            "1e999",
            "true",
            "-1",
            "[" * 2000,
            '{"event": []}',
            '{"a":' * 300,
        )
    ]
    return Target(
        "recording",
        run,
        examples,
        (ls.SourceError, ls.WireError),
        lambda: [*EDGES, *values],
        correct_checksums=correct_checksums,
    )


def _settings(folder: Path) -> Target:
    def run(data: bytes) -> None:
        path = folder / SETTINGS
        path.write_bytes(data)
        try:
            read_devices()
        finally:
            path.unlink()

    text = f"""
[device.front]
source = "serial:///dev/ttyUSB0"
sensor = "{STL}"
mount = {{x = 0.2, yaw_deg = 90, inverted = true}}
[device.rear]
source = "./rear.lsr"
sensor = "{VLP}"
options = {{calibration = "./angles.csv"}}
"""
    return Target(
        "settings",
        run,
        lambda: [text.encode()],
        (ls.UsageError, ls.SourceError),
        lambda: TOML,
        is_text=True,
    )


#: pieces of TOML and JSON that make trouble.
TOML = [
    word.encode()
    for word in (
        *(
            "inf",
            "nan",
            "-1",
            "0x7f",
            "1e400",
            '""',
            "[]",
            "{}",
            "true",
            "'''",
            "1979-05-27T07:32:00Z",
            "99999999999999999999",
            "\\u0000",
        ),
        *(
            '"\\u001b[2J"',
            "[[box]]",
            "[device]",
            "[device.a.b]",
            "a.b.c=1",
            "[" * 3000,
            "a=" + "{b=" * 500,
            "x=[" + "[" * 1500,
            "\ud7ff",
            "#",
        ),
        *(
            "source=1",
            "device=[]",
            "mount=[]",
            "options={a=[{}]}",
            'sensor=""',
            "low=[0,0]",
            "path=[[1,1],[1,1]]",
            "speed=1e5",
            "size=[1,1,1]",
        ),
    )
]


def _scene(folder: Path) -> Target:
    path = folder / "scene.toml"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        room = read_scene(path)
        room.measure(np.linspace(-3, 3, 8), np.linspace(-1, 1, 8), time=np.linspace(0, 9, 8))

    text = (
        b"[room]\nlow=[-3.0,-2.2,-1.2]\nhigh=[4.6,3.1,1.6]\n"
        b"[[box]]\nlow=[2.0,0.8,-1.2]\nhigh=[2.7,1.6,0.9]\n"
    )
    mover = b"[[mover]]\nsize=[0.4,0.5,1.7]\npath=[[1.4,-1.5],[0.8,1.9]]\nspeed=0.8\nfloor=-1.2\n"
    return Target(
        "scene",
        run,
        lambda: [text + mover],
        (ls.UsageError, ls.SourceError),
        lambda: TOML,
        is_text=True,
    )


def _vectors(folder: Path) -> Target:
    path, sensor = (
        folder / "vectors.json",
        SHAPES["shape-datagrams"],
    )  # without a checksum, which would be searched for
    subject = SensorUnderTest(sensor, vectors=path)

    def run(data: bytes) -> None:
        path.write_bytes(data)
        vectors_hold(subject)

    frame = sensor.example("data", seed=1)
    vector = {
        "source": "manual 3.2",
        "frame": "data",
        "hex": frame.hex(" "),
        "values": {"number": sensor.parse(frame).number},
    }
    cloud = sensor.decode([frame]).points()
    points = {
        str(index): {name: float(getattr(cloud, name)[index]) for name in ("range", "x", "y")}
        for index in (0, 3)
    }
    units = {"blocks[0].azimuth": sensor.parse(frame, units=True).blocks[0].azimuth}
    more = {"units": units, "points": points, "sensor": [sensor.id], "note": "x"}
    words = [
        *TOML,
        b'"command":"start"',
        b'"args":{"a":1}',
        b'"points":{"0":{"range":[]}}',
        b'"points":{"-1":{"x":1}}',
        b'"values":{"points[0]":1}',
    ]
    words += [
        b'"frame":[]',
        b'"sensor":1',
        b'"hex":1',
        b'"units":[]',
        b'"reply":"54"',
        b"NaN",
        b"null",
        b"1e999",
    ]
    return Target(
        "vectors",
        run,
        lambda: [json.dumps([vector, {**vector, **more}]).encode()],
        (ViolationError,),
        lambda: words,
        is_text=True,
    )


def _calibration(sensor: Sensor, option: str, folder: Path) -> Target:
    """Return the target that reads calibration files of a sensor."""
    path = folder / "angles.csv"

    def run(data: bytes) -> None:
        path.write_bytes(data)
        sensor.configure(**{option: path})

    def examples() -> list[bytes]:
        if option == "metadata":
            return [_metadata(rows) for rows in (16, 32)]
        if sensor.id == "hesai-at128" and option == "calibration":
            from lidarspec_hesai import at128

            return [at128.TABLE.to_file()]
        if sensor.id.startswith("velodyne-hdl64e"):
            return [write_velodyne_xml(folder / "db.xml").read_bytes()]
        heading = (
            "Channel,Elevation,Azimuth" if option == "calibration" else "Channel,fire time(us)"
        )
        rows = [
            f"{channel},{20.5 - channel / 2}"
            f"{f',{channel % 5 * 15 - 30}' * heading.count('Azimuth')}"
            for channel in range(1, 129)
        ]
        return ["\n".join([heading, *rows[:number]]).encode() for number in (16, 32, 40, 64, 128)]

    words = [
        word.encode()
        for word in (
            "nan",
            "inf",
            "-inf",
            "1e999",
            ",",
            "\n",
            '"',
            "\x00",
            "1_0",
            "\u0661",
            "EEFF",
            "414",
            "0",
            "-0",
            ",,,,",
            "9" * 5000,
        )
    ]
    return Target(
        f"calibration {sensor.id} {option}",
        run,
        examples,
        (ls.UsageError, ls.SourceError),
        lambda: words,
        is_text=sensor.id != "hesai-at128",
    )


def _metadata(rows: int) -> bytes:
    """Return the metadata that the web server of a unit with these rows would send."""
    numbers, still = (
        [float(row) for row in range(rows)],
        [float(spot % 5 == 0) for spot in range(16)],
    )
    layout = {
        "columns_per_frame": 1024,
        "columns_per_packet": 16,
        "pixels_per_column": rows,
        "udp_profile_lidar": "RNG19_RFL8_SIG16_NIR16",
    }
    beams = {
        "beam_altitude_angles": numbers,
        "beam_azimuth_angles": numbers,
        "beam_to_lidar_transform": still,
    }
    return json.dumps(
        {
            "sensor_info": {},
            "lidar_data_format": {
                **layout,
                "column_window": [0, 1023],
                "pixel_shift_by_row": [0] * rows,
            },
            "beam_intrinsics": beams,
            "lidar_intrinsics": {"lidar_to_sensor_transform": still},
            "imu_intrinsics": {"imu_to_sensor_transform": still},
            "config_params": {"lidar_mode": "1024x10"},
        }
    ).encode()


def _resolve_text(data: bytes) -> None:
    """Parse the text of a SOURCE without opening it."""
    text = data.decode("utf-8", "replace")
    is_port(text)
    if (address := live_address(text)) is not None:
        address.check(["src", "baud"])
        address.number("baud", 1, 10**7)
        address.switch("dtr")
        address.host_and_port()


def _but(documented: type[Exception], call: Callable[[], object]) -> None:
    """Make a call that may raise a documented exception."""
    with contextlib.suppress(documented):
        call()
