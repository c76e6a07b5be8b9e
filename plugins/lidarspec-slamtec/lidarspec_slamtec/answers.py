"""Single replies with their descriptors, and the descriptors before a stream of data frames.

Every descriptor is ``A5 5A``, 30 bits of length, 2 bits of mode (0 for one reply, 1 for an endless
stream) and a type. A single reply and its descriptor are one frame. The descriptor of a stream is a
frame of its own. After this frame, the decoder searches for the announced kind of data frames until
another descriptor arrives.

Source: RPLIDAR interface protocol, "response descriptors" and "requests with single response";
configuration keys and the widths of their values from the vendor's SDK (sl_lidar_cmd.h).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import (
    BitsInteger,
    BitStruct,
    Bytes,
    ByteSwapped,
    Const,
    Construct,
    Enum,
    Int8ul,
    Int16ul,
    Int32ul,
    Struct,
    Switch,
    this,
)

from lidarspec.spec import Fields, Frame, Scaled, take

# modes of a descriptor
SINGLE = 0
STREAM = 1
MAX_MODE_NAME_BYTES = 64  # SDK, LidarScanMode
#: High nibble of the model number -> series, low nibbles of its models; an A2M8 is 28 (SDK,
#: GetModelNameStringByModelID).
SERIES = {
    0x1: ("A1", (8,)),
    0x2: ("A2", (4, 6, 7, 8, 12)),
    0x3: ("A3", (1,)),
    0x4: ("C1", (1,)),
    0x6: ("S1", (1,)),
    0x7: ("S2", (1, 2)),
    0x8: ("S3", (1, 2)),
    0x9: ("T1", (1,)),
}


def name_model(series: str, models: tuple[int, ...], low: int) -> str:
    """Return the name of a model, for example "RPLIDAR S2, S2M1"."""
    if len(models) > 1:
        return f"RPLIDAR {series}, {series}M{low}"
    return f"RPLIDAR {series}"


MODEL_NUMBERS = {
    name_model(series, models, low): high << 4 | low
    for high, (series, models) in SERIES.items()
    for low in models
}
STATUSES = Enum(Int8ul, good=0, warning=1, error=2)

#: The keys of configuration values. The first two are values of the sensor, and the others are
#: values of one of its scan modes.
MODE_COUNT = 0x70
TYPICAL_MODE = 0x7C
US_PER_SAMPLE = 0x71
MAX_DISTANCE = 0x74
ANSWER_TYPE = 0x75
MODE_NAME = 0x7F

KEYS = {
    "mode_count": MODE_COUNT,
    "typical_mode": TYPICAL_MODE,
    "us_per_sample": US_PER_SAMPLE,
    "max_distance": MAX_DISTANCE,
    "answer_type": ANSWER_TYPE,
    "mode_name": MODE_NAME,
}
KEY = Enum(Int32ul, **KEYS)

#: Kind of data frames -> type of the descriptor that announces them.
STREAMS = {
    "node": 0x81,
    "express": 0x82,
    "hq": 0x83,
    "ultra": 0x84,
    "dense": 0x85,
    "ultra_dense": 0x86,
}

#: The configuration values of fixed width, by key.
VALUES: dict[int, Construct] = {
    MODE_COUNT: "mode_count" / Int16ul,
    TYPICAL_MODE: "typical_mode" / Int16ul,
    US_PER_SAMPLE: "us_per_sample" / Scaled(Int32ul, 1 / 256, "us"),
    MAX_DISTANCE: "max_distance" / Scaled(Int32ul, 1 / 256, "m"),
    ANSWER_TYPE: "answer_type"
    / Enum(Int8ul, **STREAMS)
    * "type of the data frames of this mode, as in the descriptor before the data frames",
}
_VALUE_BYTES = np.full(MODE_NAME + 1, np.nan)
_VALUE_BYTES[list(VALUES)] = [value.sizeof() for value in VALUES.values()]


def make_descriptor(kind: int, mode: int, length: Construct) -> tuple[Construct, ...]:
    """Return the fields of a descriptor of this type and mode."""
    block = BitStruct(
        "mode" / Const(mode, BitsInteger(2)) * "0: one reply follows; 1: an endless stream follows",
        "length" / length,
    )
    return (
        "start" / Const(b"\xa5\x5a"),
        "descriptor" / ByteSwapped(block),
        "type" / Const(kind, Int8ul),
    )


def make_reply(kind: int, size: int, *fields: Construct) -> Frame:
    """Return the frame of a single reply: its descriptor and `size` bytes of fields."""
    return Frame(Struct(*make_descriptor(kind, SINGLE, Const(size, BitsInteger(30))), *fields))


def make_stream_descriptor(kind: int, size: int) -> Frame:
    """Return the descriptor frame of an endless stream of frames of `size` bytes."""
    return Frame(Struct(*make_descriptor(kind, STREAM, Const(size, BitsInteger(30)))))


def is_config_plausible(f: Fields) -> Any:
    """Return whether a reply has the length that its key requires."""
    size = take(_VALUE_BYTES, f.key)
    return np.isnan(size) | (f.descriptor.length == 4 + size)


def make_config(key: int, value: Any) -> tuple[str, dict[str, Any]]:
    """Return frame name and values of a simulated reply with a configuration value.

    `value` is a number in the unit of the key, or bytes if the key has no fixed width.
    """
    field = VALUES.get(key)
    name, size = (field.name, field.sizeof()) if field else ("data", len(value))
    return "config", {"descriptor.length": 4 + size, "key": key, f"value.{name}": value}


CONFIG = Struct(
    *make_descriptor(0x20, SINGLE, BitsInteger(30)),
    "key" / KEY,
    "value"
    / Switch(
        this.key,
        {name: Struct(VALUES[key]) for name, key in KEYS.items() if key in VALUES},
        default=Struct(
            "data" / Bytes(this._.descriptor.length - 4) * "mode_name: text, terminated by 00"
        ),
    ),
)
CONFIG_SET = Struct(
    *make_descriptor(0x21, SINGLE, BitsInteger(30)),
    "key" / KEY,
    "data" / Bytes(this.descriptor.length - 4),
)

ANSWERS = {
    "info": make_reply(
        0x04,
        20,
        "model"
        / Enum(Int8ul, **MODEL_NUMBERS)
        * "the high nibble is the series, the low nibble is the model",
        "firmware_minor" / Int8ul,
        "firmware_major" / Int8ul,
        "hardware" / Int8ul,
        "serial" / Bytes(16),
    ),
    "health": make_reply(0x06, 3, "status" / STATUSES, "error" / Int16ul),
    "sample_rate": make_reply(
        0x15, 4, "standard" / Scaled(Int16ul, 1, "us"), "express" / Scaled(Int16ul, 1, "us")
    ),
    "config": Frame(CONFIG, max_length=7 + 4 + MAX_MODE_NAME_BYTES, plausible=is_config_plausible),
    "config_set": Frame(CONFIG_SET, max_length=7 + 4 + MAX_MODE_NAME_BYTES),
    "accessory": make_reply(
        0xFF,
        4,
        "flags"
        / ByteSwapped(
            BitStruct(
                "reserved" / BitsInteger(31),
                "pwm" / BitsInteger(1) * "1: the accessory board drives the motor by PWM",
            )
        ),
    ),
}

DESCRIPTORS = {
    "scan_descriptor": make_stream_descriptor(0x81, 5),
    "express_descriptor": make_stream_descriptor(0x82, 84),
    "hq_descriptor": make_stream_descriptor(0x83, 781),
    "ultra_descriptor": make_stream_descriptor(0x84, 132),
    "dense_descriptor": make_stream_descriptor(0x85, 84),
    "ultra_dense_descriptor": make_stream_descriptor(0x86, 170),
}
