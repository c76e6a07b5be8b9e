"""Pepperl+Fuchs R2000: 360 degree scanner with the protocol PFSDP, over HTTP and UDP or TCP.

A program requests a handle from the scanner over HTTP, and starts the output with this handle. With
UDP, the request names the receiver of the data. With TCP, the reply contains the port of the data.
Without ``feed_watchdog``, the output ends after a minute.

Source: R2000 Ethernet communication protocol, version 1.04, chapters 1 and 3, as repeated in the
vendor's drivers: pf_lidar_ros_driver (PFHeader.msg, PFR2000Header.msg, pf_r2000_packet_a, _b and
_c.cpp, pfsdp_base.cpp, PFDriverR2000.cfg, and for `status_flags` the driver's tables of topics) and
the older pepperl_fuchs_r2000 (packet_structure.h). The range is assumed to be that of an OMD30M. An
R2300 has packets of another type.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any, Literal

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    ByteSwapped,
    Const,
    Construct,
    Int16ul,
    Int32sl,
    Int32ul,
    OneOf,
    Struct,
    this,
)

from lidarspec.spec import (
    Clock,
    Command,
    Fields,
    Frame,
    Http,
    HttpReply,
    HttpRequest,
    OnChange,
    Polar,
    Scaled,
    Sensor,
    Simulation,
    SizeOf,
    Tcp,
    Template,
    Udp,
    hookimpl,
)

#: The size of the header up to the angular increment. The next constant has the header sizes in
#: drivers: 60 bytes with two status words, and 76 bytes with the inputs and outputs and their
#: times.
MIN_HEADER_BYTES = 52
KNOWN_HEADER_BYTES = (60, 76)
#: The header is padded to a multiple of 4 bytes; later versions may add more fields.
HEADER_SIZES = range(MIN_HEADER_BYTES, 129, 4)
#: An Ethernet frame without the headers of IP and UDP; 1404 bytes are the usual maximum.
MAX_PACKET_BYTES = 1472
#: Amplitudes below this are error codes (packet_structure.h).
MIN_AMPLITUDE = 32
#: The distance without an echo (pf_data_publisher.cpp); packets of type C have 20 bits.
NO_ECHO = 0xFFFFFFFF
NO_ECHO_20_BITS = 0xFFFFF
MM = 0.001  # m
#: The samples per scan, packets per scan, scans per second and amplitude of a simulated scanner.
SAMPLES = 1440
PACKETS = 8
SCAN_RATE_HZ = 20
SIMULATED_AMPLITUDE = 500
#: The seconds between two commands `feed_watchdog`; without them, the output ends after 60 seconds
#: (r2000_params.yaml).
FEED_INTERVAL_S = 20.0

SAMPLES_BY_TYPE: Mapping[str, Construct] = {
    "A": Struct("distance" / Scaled(Int32ul, MM, "m") * "FFFFFFFF: no echo"),
    "B": Struct(
        "distance" / Scaled(Int32ul, MM, "m") * "FFFFFFFF: no echo",
        "amplitude" / Int16ul * "below 32: error code",
    ),
    "C": ByteSwapped(
        BitStruct(
            "amplitude" / BitsInteger(12) * "below 32: error code",
            "distance" / Scaled(BitsInteger(20), MM, "m") * "FFFFF: no echo",
        )
    ),
}


#: A status word of 32 bits, little-endian. Bit 0 is the last field.
STATUS_FLAGS = ByteSwapped(
    BitStruct(
        "reserved_31" / BitsInteger(1),
        "device_defect" / BitsInteger(1) * "1: the device has a defect that cannot be repaired",
        "reserved_21" / BitsInteger(9),
        "overload_error" / BitsInteger(1),
        "high_temperature_error" / BitsInteger(1),
        "low_temperature_error" / BitsInteger(1),
        "lens_contamination_error" / BitsInteger(1),
        "device_error" / BitsInteger(1) * "1: at least one of the four errors above",
        "reserved_13" / BitsInteger(3),
        "overload_warning" / BitsInteger(1),
        "high_temperature_warning" / BitsInteger(1),
        "low_temperature_warning" / BitsInteger(1),
        "lens_contamination_warning" / BitsInteger(1),
        "device_warning" / BitsInteger(1) * "1: at least one of the four warnings above",
        "reserved_5" / BitsInteger(3),
        "skipped_packets" / BitsInteger(1) * "1: packets before this one were not sent",
        "unstable_rotation"
        / BitsInteger(1)
        * "1: the scan frequency differs from the configured one",
        "invalid_data" / BitsInteger(1),
        "new_settings" / BitsInteger(1) * "1: settings changed during this packet",
        "scan_data_info" / BitsInteger(1) * "1: at least one of the four flags above",
    )
)


def make_time() -> Construct:
    """Return the struct of a time in NTP's 64-bit format, with the fraction first."""
    return Struct("fraction" / Scaled(Int32ul, 2.0**-32, "s"), "seconds" / Scaled(Int32ul, 1, "s"))


def make_packet(letter: str) -> Construct:
    """Return the struct of a packet of type A, B or C."""
    return Struct(
        "magic" / Const(b"\x5c\xa2"),
        "packet_type" / Const(ord(letter), Int16ul),
        "packet_size" / SizeOf(Int32ul),
        "header_size" / OneOf(Int16ul, HEADER_SIZES) * "a multiple of 4",
        "scan_number" / Int16ul * "scan counter",
        "packet_number" / Int16ul * "number of the packet in its scan; the first is 1",
        "timestamp_raw" / make_time() * "time of the first sample, counted from power-on",
        "timestamp_sync"
        / make_time()
        * "synchronized time of the first sample; 0 if the clock is not synchronized",
        "status_flags" / STATUS_FLAGS,
        "scan_frequency" / Scaled(Int32ul, 0.001, "Hz"),
        "num_points_scan" / Int16ul,
        "num_points_packet" / Int16ul,
        "first_index" / Int16ul * "index of the first sample in its scan",
        "first_angle" / Scaled(Int32sl, 0.0001, "deg") * "counter-clockwise",
        "angular_increment" / Scaled(Int32sl, 0.0001, "deg") * "negative: clockwise",
        "more"
        / Bytes(this.header_size - MIN_HEADER_BYTES)
        * "state and times of the inputs and outputs, if the model has inputs and outputs",
        "samples" / Array(this.num_points_packet, SAMPLES_BY_TYPE[letter]),
    )


def plausible(f: Fields) -> Any:
    """Return whether sizes, counts and angles are valid."""
    return (
        (f.packet_number >= 1)
        & (f.num_points_scan >= 1)
        & (f.first_index + f.num_points_packet <= f.num_points_scan)
        & (f.scan_frequency > 0)
        & (np.abs(f.first_angle) <= 360)
        & (np.abs(f.angular_increment) <= 360)
    )


def sample_interval(f: Fields) -> Any:
    """Return the seconds from one sample to the next."""
    return np.abs(f.angular_increment) / 360 / f.scan_frequency


def pace(f: Fields) -> Any:
    """Return the seconds since the previous packet."""
    interval = sample_interval(f)
    samples_before = f.first_index / np.maximum(f.packet_number - 1, 1)
    last_samples = (f.num_points_scan - 1) % np.maximum(f.num_points_packet, 1) + 1
    last_index = f.num_points_scan - last_samples
    since_last_scan = 1 / f.scan_frequency - last_index * interval
    return np.where(f.packet_number == 1, since_last_scan, samples_before * interval)


def points(f: Fields, letter: str) -> Polar:
    """Return the samples of a packet, which are evenly spaced in angle and in time."""
    sample = f.samples
    if letter == "A":
        amplitude = None
        invalid = sample.distance >= NO_ECHO * MM
    elif letter == "B":
        amplitude = sample.amplitude
        invalid = (sample.distance >= NO_ECHO * MM) | (amplitude < MIN_AMPLITUDE)
    else:
        amplitude = sample.amplitude
        invalid = (sample.distance >= NO_ECHO_20_BITS * MM) | (amplitude < MIN_AMPLITUDE)
    return Polar(
        range=sample.distance,
        azimuth=np.deg2rad(f.first_angle + sample.index * f.angular_increment),
        intensity=amplitude,
        time=sample.index * sample_interval(f),
        invalid=invalid,
    )


def sweep(i: int, letter: str) -> dict[str, Any]:
    """Return the values of simulated packet i; a scan begins at -180 degrees."""
    count = SAMPLES // PACKETS
    turn, part = divmod(i, PACKETS)
    seconds, fraction = divmod(i / PACKETS / SCAN_RATE_HZ, 1.0)
    values: dict[str, Any] = {
        "header_size": KNOWN_HEADER_BYTES[0],
        "more": bytes(KNOWN_HEADER_BYTES[0] - MIN_HEADER_BYTES),
        "scan_number": turn % 65536,
        "packet_number": part + 1,
        "timestamp_raw.seconds": seconds,
        "timestamp_raw.fraction": fraction,
        "scan_frequency": SCAN_RATE_HZ,
        "num_points_scan": SAMPLES,
        "num_points_packet": count,
        "first_index": part * count,
        "first_angle": -180 + part * 360 / PACKETS,
        "angular_increment": 360 / SAMPLES,
    }
    if letter != "A":
        values["samples.amplitude"] = np.full(count, SIMULATED_AMPLITUDE)
    return values


def make_data_frame(letter: str) -> Frame:
    """Return the frame type of packets of type A, B or C."""
    return Frame(
        make_packet(letter),
        data=True,
        max_length=MAX_PACKET_BYTES,
        plausible=plausible,
        points=partial(points, letter=letter),
        simulation=Simulation(partial(sweep, letter=letter)),
    )


#: The first type is requested by default.
DATA_FRAMES = {f"packet_{letter.lower()}": make_data_frame(letter) for letter in "CBA"}
HTTP_FRAMES = {
    "ask": Frame(HttpRequest, direction="out", max_length=4096),
    "reply": Frame(HttpReply, max_length=1 << 16),
}


def read_reply(reply: Any) -> dict[str, Any]:
    """Return the handle and the port in a reply; both may be missing.

    Raises:
        ValueError: if the scanner reports an error.
    """
    try:
        page = json.loads(reply.body)
        code = page["error_code"]
    except (ValueError, KeyError, TypeError):
        raise ValueError(
            f"expected a JSON object with error_code, got HTTP status {reply.status}"
        ) from None
    if code != 0:
        raise ValueError(f"{page.get('error_text')} (error {code})")
    return {name: page[name] for name in ("handle", "port") if name in page}


def make_request(command: str, **more: Any) -> Command:
    """Return the command for a request, for example "reboot_device".

    Names in braces are replaced by values, as in "start_scanoutput?handle={handle}".
    """
    path = f"/cmd/{command}"
    values = {
        "method": "GET",
        "path": Template(path) if "{" in path else path.encode(),
        "body": b"",
    }
    return Command(
        "ask", values, reply="reply", link="http", timeout=5.0, provides=read_reply, **more
    )


def make_handle_request(letter: str, transport: str) -> Command:
    """Return the command that asks for a handle for packets of this type."""
    if transport == "tcp":
        return make_request(f"request_handle_tcp?packet_type={letter}")
    return make_request(
        f"request_handle_udp?address={{own_address}}&port={{own_port}}&packet_type={letter}"
    )


def make_parameter(name: str, low: int, high: int) -> Command:
    """Return the command that sets a parameter."""
    return make_request(f"set_parameter?{name}={{value}}", args={"value": ("path", low, high)})


COMMANDS = {
    "request_handle": make_handle_request("C", "udp"),
    "start": make_request("start_scanoutput?handle={handle}", starts=True),
    "feed_watchdog": make_request("feed_watchdog?handle={handle}", every=FEED_INTERVAL_S),
    "stop": make_request("stop_scanoutput?handle={handle}", stops=True),
    "release_handle": make_request("release_handle?handle={handle}"),
    "set_scan_frequency": make_parameter("scan_frequency", 10, 50),
    "set_samples_per_scan": make_parameter("samples_per_scan", 72, 25_200),
    "get_scan_parameters": make_request(
        "get_parameter?list=scan_frequency;samples_per_scan;angular_fov;radial_range_min"
        ";radial_range_max"
    ),
    "get_product": make_request("get_parameter?list=product;device_family"),
    "get_protocol_info": make_request("get_protocol_info"),
    "reboot": make_request("reboot_device"),
}


def make_answer(**values: Any) -> list[Any]:
    """Return a simulated reply without an error."""
    page = {**values, "error_code": 0, "error_text": "success"}
    return [("reply", {"status": 200, "body": json.dumps(page).encode()})]


SIMULATED_HANDLE = "s10"
ANSWERS: Mapping[str, Any] = {
    **{name: make_answer() for name in COMMANDS},
    "request_handle": lambda request: make_answer(
        handle=SIMULATED_HANDLE, port=request["{data_port}"] or 1
    ),
    "get_scan_parameters": make_answer(
        scan_frequency=SCAN_RATE_HZ,
        samples_per_scan=SAMPLES,
        angular_fov=360,
        radial_range_min=0.1,
        radial_range_max=30,
    ),
    "get_product": make_answer(product="OMD30M-R2000", device_family=1),
    "get_protocol_info": make_answer(protocol_name="pfsdp", version_major=1, version_minor=4),
}


def configure(
    sensor: Sensor,
    *,
    packet: Literal["A", "B", "C"] = "C",
    transport: Literal["udp", "tcp"] = "udp",
) -> Sensor:
    """Return the sensor for packets of this type over UDP or TCP.

    Packets of type A have distances. Packets of types B and C have distances and amplitudes.
    """
    first = f"packet_{packet.lower()}"
    frames = {first: sensor.frames[first], **sensor.frames}
    data = Tcp(reported="port") if transport == "tcp" else Udp()
    return dataclasses.replace(
        sensor,
        frames=frames,
        links={**sensor.links, "data": data},
        commands={**sensor.commands, "request_handle": make_handle_request(packet, transport)},
    )


R2000 = Sensor(
    "pepperl-fuchs-r2000",
    vendor="Pepperl+Fuchs",
    model="R2000 (OMD10M, OMD30M)",
    frames={**DATA_FRAMES, **HTTP_FRAMES},
    points=None,
    scan=OnChange("scan_number"),
    links={"data": Udp(), "http": Http(80)},
    commands=COMMANDS,
    clock=Clock(("timestamp_raw.seconds", "timestamp_raw.fraction"), wraps_at=2.0**32, pace=pace),
    simulation=Simulation(answers=ANSWERS),
    configure=configure,
    on_open=("request_handle", "start", "feed_watchdog"),
    on_close=("stop", "release_handle"),
    range_limits=(0.1, 30.0),
    vendor_axes=("forward", "left", "up"),
    turn=(10, 50),
    status="manual",
    source="R2000 Ethernet communication protocol 1.04; pf_lidar_ros_driver; pepperl_fuchs_r2000",
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Pepperl+Fuchs scanners."""
    return [R2000]
