"""A C99 header for a sensor: accessors, lengths, checksums and scaling, as functions of bytes; nothing in it depends on struct packing."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from lidarspec._version import __version__
from lidarspec.checksums import Checksum
from lidarspec.export.c_checksums import checksum
from lidarspec.export.c_fields import fields
from lidarspec.export.c_frames import frame
from lidarspec.export.c_places import Places
from lidarspec.export.c_text import comment, identifier
from lidarspec.export.messages import Message, messages
from lidarspec.export.tree import Sealed
from lidarspec.spec import Sensor

_HEAD = """\
/* {title}: its frames as functions of bytes, made by lidarspec {version}.
 * Source: {source}
 *
 * For every frame type F:
 *   {prefix}_F_frame_length(p, n)  bytes of the frame that begins at p, of which n are there; 0 where the header does not tell
 *   {prefix}_F_is_frame(p, n)      whether a whole, sound frame begins at p
 *   {prefix}_F_checksum_ok(p)      whether its checksum is right; ..._computed(p), ..._stored(p)
 *   {prefix}_F_FIELD(p, i, ...)    the raw number of a field, with an index for each array that it is in
 *   {prefix}_F_FIELD_present(p)    whether a field that not every header has is there; without, it reads as 0
 *   {prefix}_F_ARRAY_count(p)      elements of an array
 *   {prefix}_F_FIELD_to_UNIT(raw)  the physical value
 *
 * All but frame_length and is_frame take a whole frame: ask is_frame first. What only Python decides (whether values are plausible, which
 * frames wait for others) is not asked. C99 and C++11; nothing is allocated.
 */
#ifndef {guard}
#define {guard}

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {{
#endif
"""

_HELPERS = """\
#ifndef LIDARSPEC_BYTES
#define LIDARSPEC_BYTES
static inline uint64_t lidarspec_le(const uint8_t *p, int size)
{
    uint64_t value = 0;
    while (size-- > 0)
        value = value << 8 | p[size];
    return value;
}
static inline uint64_t lidarspec_be(const uint8_t *p, int size)
{
    uint64_t value = 0;
    while (size-- > 0)
        value = value << 8 | *p++;
    return value;
}
static inline int64_t lidarspec_signed(uint64_t value, int width)
{
    const uint64_t sign = UINT64_C(1) << (width - 1);
    return value & sign ? -(int64_t)(~value & (sign - 1)) - 1 : (int64_t)value;
}
static inline float lidarspec_float(uint64_t bits)
{
    const uint32_t word = (uint32_t)bits;
    float value;
    memcpy(&value, &word, sizeof value);
    return value;
}
static inline double lidarspec_double(uint64_t bits)
{
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}
static inline float lidarspec_half(uint64_t bits)
{
    const uint32_t sign = (uint32_t)(bits & 0x8000) << 16, exponent = (uint32_t)(bits >> 10) & 31, fraction = (uint32_t)bits & 0x3ff;
    if (exponent == 0) return (sign ? -1.0f : 1.0f) * (float)fraction / 16777216.0f;
    return lidarspec_float(sign | (exponent == 31 ? 0x7f800000u : (exponent + 112) << 23) | fraction << 13);
}
static inline int64_t lidarspec_int(int64_t value) { return value; }
static inline int lidarspec_within(int64_t value, int64_t most) { return value >= 0 && value <= most; }
static inline int64_t lidarspec_floor_div(int64_t a, int64_t b)
{
    return b == 0 ? 0 : a / b - (a % b != 0 && (a % b < 0) != (b < 0));
}
static inline int64_t lidarspec_floor_mod(int64_t a, int64_t b)
{
    return b == 0 ? 0 : a - b * lidarspec_floor_div(a, b);
}
static inline uint64_t lidarspec_mirrored(uint64_t value, int width)
{
    uint64_t found = 0;
    for (; width > 0; --width, value >>= 1)
        found = found << 1 | (value & 1);
    return found;
}
#endif
"""

_TAIL = """\
#ifdef __cplusplus
}
#endif
#endif
"""
#: functions of a whole frame, whose names no field may take.
_OWN = ("frame_length", "is_frame", "checksum_computed", "checksum_stored", "checksum_ok")


def header(sensor: Sensor) -> str:
    """A C99 header that reads the frames of a sensor.

    Raises:
        Refused: where only Python code can decide what a frame is made of, or its places cannot be computed in C.
    """
    prefix = identifier(sensor.id if sensor.id[0].isalpha() else f"lidar_{sensor.id}")
    title, source = f"{sensor.vendor} {sensor.model}", " ".join(sensor.source.split()).replace("*/", "* /")
    names, algorithms = _Names(prefix), _Algorithms(prefix)
    frames = ["\n".join(_frame(message, names, algorithms)) for message in messages(sensor)]
    head = _HEAD.format(title=title, version=__version__, source=source, prefix=prefix, guard=f"{prefix.upper()}_H")
    return "\n".join([head, _HELPERS, *algorithms.texts, *frames, _TAIL])


def _frame(message: Message, names: _Names, algorithms: _Algorithms) -> Iterator[str]:
    places = Places(message, names.of(message))
    longest = f"#define {names.prefix.upper()}_{identifier(message.name).upper()}_MAX_LENGTH {message.frame.max_length}"
    yield comment(f"---- {message.name}: {'from' if message.frame.direction == 'in' else 'to'} the sensor ----")
    yield longest
    yield from (text for text in fields(places) if text)
    yield ""
    yield from frame(places, algorithms.of)


class _Names:
    """C names of what stands in frames, each given once."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self._given: dict[str, tuple[str, str, str]] = {}

    def of(self, message: Message) -> Callable[[str, str], str]:
        """The names in one frame type: (path, ending) -> name."""
        for own in _OWN:
            self._name(message.name, "", own)
        return lambda path, ending: self._name(message.name, path, ending)

    def _name(self, frame: str, path: str, ending: str) -> str:
        name = "_".join(identifier(part) for part in (self.prefix, frame, path, ending) if part)
        while self._given.setdefault(name, (frame, path, ending)) != (frame, path, ending):
            name += "_"
        return name


class _Algorithms:
    """The checksum functions that are needed, each once."""

    def __init__(self, prefix: str) -> None:
        self._prefix, self._names = prefix, dict[Checksum, str]()
        self.texts: list[str] = []

    def of(self, node: Sealed) -> str:
        """The name of the function for a seal."""
        if node.algorithm not in self._names:
            name = f"{self._prefix}_checksum_{len(self._names) + 1}"
            self.texts.append(checksum(node.algorithm, name))
            self._names[node.algorithm] = name
        return self._names[node.algorithm]
