"""Prepare construct structs for lidarspec, and translate them to the frame tree.

`prepare` returns a copy of a plugin's struct, in which lidarspec's own classes replace some classes
of construct. `check_struct` raises an error if the struct is not supported, and `frame_tree`
returns the tree of the struct. Modules in reading order:

* `replacements`: classes that replace classes of construct, and additional classes.
* `adapters`: converts adapters and text fields to functions of raw values.
* `raw_checksums`: replaces construct's Checksum of a RawCopy by a struct with a checksum.
* `structs`: prepares a struct, finds properties of a construct, and draws random values.
* `refusals`: raises errors for unsupported structs.
* `meaning`: translates a struct to nodes.
"""

from __future__ import annotations

from lidarspec.spec.syntax.meaning import (
    bytes_of as bytes_of,
    frame_tree as frame_tree,
)
from lidarspec.spec.syntax.refusals import check_struct as check_struct
from lidarspec.spec.syntax.replacements import (
    ChecksummedBase as ChecksummedBase,
    DescribedField as DescribedField,
    Fault as Fault,
    MeasuredStruct as MeasuredStruct,
    MismatchError as MismatchError,
    ParsedParts as ParsedParts,
    Partition as Partition,
    SizeField as SizeField,
    WireNaN as WireNaN,
    check_bound as check_bound,
    get_member as get_member,
    is_verifying as is_verifying,
)
from lidarspec.spec.syntax.structs import (
    bit_width as bit_width,
    field_path as field_path,
    fixed_size as fixed_size,
    has_member as has_member,
    is_expression as is_expression,
    is_struct as is_struct,
    iter_checksummed as iter_checksummed,
    iter_leaves as iter_leaves,
    prepare as prepare,
    random_value as random_value,
    to_public as to_public,
    unwrap as unwrap,
)
