"""A count that Python computes from a number with some billion values: it is computed for each
false header.
"""

from __future__ import annotations

from construct import Array, Int8ul, Int32ul, Struct

from lidarspec.spec import Checksummed, Sum, hookimpl
from tests.broken import sound


def digits(this):
    return sum(int(digit) for digit in f"{this.serial:04000}") % 3


@hookimpl
def lidarspec_sensors():
    fields = {
        "header": sound.FIELDS["header"],
        "serial": Int32ul,
        "extra": Array(digits, Int8ul),
        **sound.FIELDS,
    }
    struct = Struct(*(name / part for name, part in fields.items()))
    return [
        sound.sensor(
            sound.frame(
                Checksummed(struct, field="sum", algorithm=Sum(16)), max_length=sound.SIZE + 8
            )
        )
    ]
