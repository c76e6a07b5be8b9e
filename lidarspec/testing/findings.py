"""The findings of `lidarspec check` and the test kit, and their rules.

A property that does not hold raises `ViolationError`, which becomes a `Finding`.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from lidarspec.sensor_operations import Sensor


class Rule(NamedTuple):
    """A rule: its code, a short description of the fault, the consequence, the remedy."""

    code: str
    title: str
    why: str
    fix: str


#: Code, title, consequence and remedy of each rule. LS0xx: loading, LS1xx: the struct, LS2xx: the
#: declaration, LS3xx: single frames, LS4xx: streams, LS5xx: points, LS6xx: commands, LS7xx: golden
#: vectors, LS8xx: the source of modules.
_TABLE = """
LS001 the plugin cannot be imported | none of its sensors can be used | fix the error that is printed
LS002 the hook does not exist | pluggy ignores misspelt names without a message | use a name of the hook reference
LS003 the hook is not marked | lidarspec never calls it | put @hookimpl above it
LS004 the hook has a wrong signature | lidarspec cannot call it | use the arguments of the hook reference
LS005 another sensor has this id | lidarspec can select only one of the two | choose another id
LS006 the list of sensors cannot be read | all sensors of this hook are missing | return a list of Sensor values
LS007 the declaration is invalid | the sensor is refused when it is declared | correct it as the message says
LS008 sizeof is used on an optional part | construct raises KeyError for If and Switch | write the longest length as a number
LS009 the longest length of the frame is unknown | a damaged length would block the decoder | declare max_length= of the Frame, in bytes
LS010 the hook raises an error | its result is missing | return None for arguments that the hook does not know
LS101 construct hides this field name | `parsed.items` is a method of the Container | choose another name
LS102 the field name is reserved | `f.state` and `column.on` have another meaning in `points` | choose another name
LS103 the field name is not a public identifier | == ignores names that begin with _ | choose an identifier without a leading _
LS104 two fields have the same name | the last one replaces the others | number the names: reserved_1, reserved_2
LS105 the field has no name | its bytes are lost when a parsed frame is built again | declare "reserved" / Bytes(n)
LS106 the parsed value does not contain all bytes of a part | a parsed frame that is built again has other bytes
      | end the part with "rest" / GreedyBytes, or make it a named member of a Struct
LS107 Flag is used for a whole byte | seven of its bits are lost when a parsed frame is built again | declare all eight bits in a BitStruct
LS108 the struct contains FlagsEnum | bits without a name are lost when a parsed frame is built again | use a BitStruct
LS109 the struct contains Union | building uses one reading, and ignores edits of the others
      | declare one reading of the bytes
LS110 the struct contains Pickled | it runs code from the wire | declare the fields
LS111 a field is greedy | nothing marks its end in a stream, or its elements may be empty | declare a count, a length or a terminator
LS112 the struct contains Pointer or Seek | they read bytes outside the frame | declare fields in the order of the wire
LS113 the struct contains Select or Optional | damaged bytes would select another alternative | use If or Switch on a header field
LS114 the frame is not a Struct | Const(...).build({}) fails | use Struct("header" / Const(...))
LS115 an expression in the struct raises an error | the error is not one that lidarspec documents
      | write the expression so that it works for all values of the header fields
LS116 the frame is not compiled | construct parses it, hundreds of times slower | declare fields whose offsets follow from the header
LS117 a field with named values is compared with a number | construct compares the name, so the result is always the same | compare with the name
LS201 a measured value has no unit | users cannot tell metres from millimetres | use Scaled(Int16ul, 0.001, "m"), with the unit "" for a number without a unit
LS202 the sensor has no source | readers cannot verify its numbers | declare source="manual, revision, section"
LS203 max_length is not the longest length | valid frames are refused, or the decoder waits too long | declare the size of the longest frame
LS204 the sync pattern is common | false candidates cost time and valid frames | declare more constant bytes or bits
LS205 the checksum does not cover a field | a flipped bit in the field is not detected | add it to over=, or omit over=
LS206 noise may be accepted as this frame | it becomes false points | declare plausible= or confirm=
LS207 `plausible` returns a constant or an expression of construct | an expression of construct is always true | use plausible=lambda f: f.angle < 360
LS208 `points` cannot be compiled | it runs as ordinary NumPy, ten times slower | use ufuncs and functions of lidarspec.spec
LS209 an acknowledgement matches no finding, or has no reason | it would hide the next such finding | remove it, or give a reason
LS210 range_limits exceed the largest value of the range field, or are invalid | the scale or the limit is wrong | compare both with the manual
LS211 the declaration is incomplete | lidarspec cannot open, decode or detect the sensor | declare vendor, model, a data frame and a data link
LS212 the checksum is not verified | damaged frames are accepted
      | use Checksummed (`lidarspec crc` finds the algorithm), or "crc" / Int16ul * "not checked: ..."
LS213 a column is used with `if`, `and`, `or` or `not` | a column has one truth value for each packet
      | use & | ~ and np.where: (f.a < 1) & (f.b < 2)
LS214 columns have different shapes | a point needs one value of each
      | give one value for each point or packet; name the axis of an array with along(...)
LS215 `spread` gives all samples one value | all points of a packet get the same angle or time
      | set full= to a full circle in the unit of the angle, or use steps(count)
LS216 a field is missing, or the field of a clock has no unit of time | the scans, the clock or the counter need it
      | use a path that `lidarspec show` prints; for a clock, Scaled(Int32ul, 1e-6, "s")
LS217 the option changes nothing | users who set it get the same points | use it in `configure`, or remove it
LS218 the intensity is calculated from another field | users expect the intensity that the sensor measured
      | use the intensity field
LS219 the range is calculated from a field whose name suggests a code | error codes become points | use the distance field
LS301 no example can be generated | the frame cannot be tested
      | declare Simulation(sweep=...), or strategies = {"frame.field": ...} in the test class
LS302 parsing and building change the bytes | a replayed or edited frame differs | use fields that keep every bit
LS303 building truncates a value instead of rounding it | int() loses a step if the float is slightly too small
      | use Scaled, or round() in the function that encodes the value
LS304 building from physical values changes the bytes | the values cannot be written back | use Scaled with the correct scale and offset
LS305 a field does not keep a written value | the value read differs from the value set | use the width and sign of the wire
LS306 a frame is parsed as another type | its fields get another meaning | declare different constants, or frames in another order
LS307 a truncated frame is accepted | missing values are invented | declare the length of every field
LS308 an undocumented exception is raised | callers catch LidarSpecError only | make lambdas valid for all values
LS310 the checksum misses a flipped bit | damaged frames are accepted | use a checksum that depends on every byte
LS311 two examples with the same seed differ | a failure cannot be reproduced | use no random values and no clock
LS312 a field that `Rebuild` fills in is not checked | a frame with another value is accepted, and built differently
      | compare it in `plausible`: f.length == f.size + 5
LS313 a wire form cannot send the first bytes of a frame as content | frames with this content are lost
      | escape these bytes in `encode`, and undo it in `decode`
LS401 a clean stream loses bytes | valid frames are lost without any damage | declare all parts of the frames
LS404 scans depend on the size of batches | the same revolution is cut at another place | keep no state in `points`
LS414 a function of the plugin raises an error | its packets are counted, but lost | make it valid for every valid frame
LS415 the same bytes give different results | results cannot be reproduced | calculate results from fields only
LS501 a cloud breaks the conventions | users expect other axes and units | return metres and radians; 0 is no return
LS502 angles are in degrees | radians are expected, so directions are wrong | use np.deg2rad(...)
LS503 a single point has no direction | a count of 1 divides by count - 1 | use spread(start, end, count, full=360.0)
LS504 angles run backwards across the full circle | once per turn, a packet is spread over the whole circle
      | use spread(..., full=360.0)
LS505 an angle of one full circle is not treated as 0 | sensors send 360.00 degrees for 0
      | use wrap(angle, 360.0), or reject it in `plausible`
LS506 angles are not in the order of the rotation | scans are cut at wrong angles | use the manual's direction, and spread or wrap
LS507 decoding does not return the simulated scene | `sweep` and `points` contradict each other | make `sweep` the inverse of `points`; if `points` rejects weak returns, give their intensity in `sweep`
LS508 `sweep` cannot be simulated | sim, demo and virtual_port fail
      | return the physical values of packet i, by field path
LS509 the clock runs backwards when it wraps | durations become negative | declare Clock(..., wraps_at=) in seconds
LS510 packets are reported as lost when the counter wraps | every wrap adds lost or late packets | declare PacketCounter(field, first=, last=)
LS511 points turn in the wrong direction | left and right are exchanged, or vendor_axes differ from the manual
      | compare azimuth= and vendor_axes= with the manual's figure
LS512 the clock exceeds wraps_at | it seems to wrap when it does not | declare Clock(..., wraps_at=) in seconds
LS513 the times of points do not fit the clock | points of one packet get times of other scans | return time= in seconds
LS514 a field cannot represent a value of `sweep` | the simulated sensor sends another value
      | return physical values in the unit of the field, within its limits
LS601 parsing a built command returns values that were not built | the sensor receives another command
      | in values and args, use paths of the command's frame
LS602 an argument is not limited to its range | the sensor receives invalid requests
      | declare args={name: (path, lowest, highest)}
LS603 no reply can match the command | the command waits until its timeout | use fields of the reply in matches= and echoes=
LS604 the simulated sensor does not send the documented reply | simulated commands time out | declare answers=, or other matches=
LS605 a command or reply differs from its vector | the sensor expects or sends other bytes
      | compare values, args, matches and echoes
LS606 the reply to another command is accepted | a late reply to the other command counts as success
      | declare echoes=, or the value of the field in matches=
LS701 a vector has no source | readers cannot verify it | add "source": "manual, section"
LS702 a vector cannot be read | it tests nothing | write {"frame": ..., "hex": ..., "values": {...}, "source": ...}
LS703 the checksum covers the wrong bytes | all frames of a real sensor are rejected | compare over= and the algorithm with the manual
LS704 the byte order is wrong | 0x1234 is read as 0x3412 | Int16ub is big-endian, Int16ul little-endian
LS705 a signed number is read as unsigned | -1 becomes 65535 | use Int16sl
LS706 a vector has another value for a field | the field reads these bytes differently | compare the field with the manual
LS707 a vector is not a valid frame | bytes of a real sensor are rejected | compare the struct with the manual
LS708 a point of a vector has other coordinates | coordinates are wrong | compare `points` with the manual
LS709 a point is mirrored | left and right are exchanged | use azimuth=-np.deg2rad(clockwise)
LS710 the status requires vectors | no frame of a real sensor has been tested
      | add vectors.json with frames of the manual or a capture, or declare status="manual"
LS711 no vector gives the value of this field | a wrong byte order, scale or offset would not be noticed
      | add it to `values` or `units`, once with a value other than 0
LS712 all points of the vectors are in one quadrant | a mirrored or rotated cloud would pass
      | add points in two quadrants, calculated by hand; acknowledge this for a sensor with a single beam
LS713 a vector exceeds the range limits | its byte order, its scale or the limit is wrong
      | compare byte order, scale and range_limits with the manual
LS801 an exception is ignored without a message | errors are neither reported nor counted | remove the try
LS802 the wall clock is used | it jumps, and two runs differ | use the sensor's clock
LS803 a partial write is ignored | the rest of a command is never sent | use sendall
LS804 an expression with `this` is used with `if`, `and`, `or` or `not` | `this.a == this.b` is an expression, and true | use If(this.a == this.b, ...)
LS805 hasattr(this, ...) is used | it is always true | test a header field
"""
RULES = {
    texts[0]: Rule(*texts)
    for texts in re.findall(r"^(LS\d+) (.+?) \| (.+?)\s+\| (.+)$", _TABLE, re.MULTILINE)
}


@dataclass(frozen=True)
class Finding:
    """A fault at a position in a spec.

    Attributes:
        code: the code of its rule.
        what: a description of the fault.
        path: frame type, or frame type and field ("data.points.distance"); "" if the fault concerns
            the sensor.
        sensor: the id of the sensor; "" if there is none.
        file: the source file with the fault; "" if it is unknown.
        line: the line in that file; 0 if it is unknown.
    """

    code: str
    what: str
    path: str = ""
    sensor: str = ""
    file: str = ""
    line: int = 0

    @property
    def rule(self) -> Rule:
        """The rule that is violated."""
        return RULES[self.code]

    def to_dict(self) -> dict[str, Any]:
        """Return the finding and its rule as a JSON object."""
        return {
            **asdict(self),
            "title": self.rule.title,
            "why": self.rule.why,
            "fix": self.rule.fix,
        }

    def __str__(self) -> str:
        subject = " ".join(part for part in (self.sensor, self.path) if part)
        file = Path(self.file)
        if file.is_relative_to(Path.cwd()):
            file = file.relative_to(Path.cwd())
        if self.line:
            where = f"{file}:{self.line}"
        elif self.file:
            where = str(file)
        else:
            where = ""
        if subject and where:
            where = f"{subject} ({where})"
        else:
            where = subject or where
        rule = self.rule
        return (
            f"{self.code} {rule.title}\n  where  {where}\n  what   {self.what}\n"
            f"  why    {rule.why}\n  fix    {rule.fix}"
        )


class ViolationError(AssertionError):
    """Raised if a property does not hold; it becomes a `Finding`."""

    def __init__(self, code: str, what: str, path: str = "") -> None:
        self.code = code
        self.what = what
        self.path = path
        rule = RULES[code]
        head = f"{code} {rule.title}\n  where: {path or 'the sensor'}"
        super().__init__(f"{head}\n  what:  {what}\n  why:   {rule.why}\n  fix:   {rule.fix}")


def require(holds: object, code: str, what: str, path: str = "") -> None:
    """Raise a `ViolationError` with this code, text and path if `holds` is false."""
    if not holds:
        raise ViolationError(code, what, path)


def list_unacknowledged(findings: list[Finding], sensor: Sensor, *, whole: bool) -> list[Finding]:
    """Return the findings that a declaration does not acknowledge with a reason.

    Args:
        whole: whether all rules were checked; if so, unused acknowledgements are reported.
    """
    given = {
        "": sensor.acknowledged,
        **{name: frame.acknowledged for name, frame in sensor.frames.items()},
    }
    used: set[tuple[str, str]] = set()
    left = []
    for finding in findings:
        frame, _, field = finding.path.partition(".")
        keys = [
            (frame_name, key)
            for frame_name in (frame, "")
            for key in (finding.code, f"{finding.code} {field if frame_name else finding.path}")
        ]
        acknowledging = [
            (frame_name, key)
            for frame_name, key in keys
            if given.get(frame_name, {}).get(key, "").strip()
        ]
        used.update(acknowledging)
        left += [] if acknowledging else [finding]
    for frame_name, entries in given.items() if whole else ():
        for key, reason in entries.items():
            if (frame_name, key) not in used:
                if not reason.strip():
                    problem = "has no reason"
                else:
                    problem = "does not occur"
                left.append(
                    Finding(
                        "LS209", f"{key!r} is acknowledged, but {problem}", frame_name, sensor.id
                    )
                )
    return left
