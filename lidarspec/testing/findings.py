"""The findings of `lidarspec check` and the test kit, and their rules.

The rules are a table, which a test compares with the reference page. A property raises `Violation`
(through `require`) if it does not hold, which becomes a `Finding`; findings that a declaration
acknowledges with a reason are removed at the end, by `left_over`.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from lidarspec.sensor_operations import Sensor


class Rule(NamedTuple):
    """A rule: the fault in a few words, why it matters, and the remedy."""

    code: str
    title: str
    why: str
    write: str


#: Code, title, reason and remedy of each rule. LS0xx: loading, LS1xx: the struct, LS2xx: the
#: declaration, LS3xx: single frames, LS4xx: streams, LS5xx: points, LS6xx: commands, LS7xx: golden
#: vectors, LS8xx: the source of modules.
_TABLE = """
LS001 the plugin cannot be imported | none of its sensors exists for anybody | mend the error that is printed
LS002 a hook that does not exist | pluggy passes over a misspelt name in silence | one of the names of the hook reference
LS003 a hook without its mark | nobody ever calls it | @hookimpl above it
LS004 a hook with the wrong signature | it cannot be called | the arguments of the hook reference, or fewer of them
LS005 an id that is taken | only one of the two can be meant by it | an id of your own: vendor-model
LS006 the list of sensors fails | one failing hook takes all its sensors along | a function that returns a list of Sensor values
LS007 a declaration that cannot be | the sensor is refused when it is declared | what the message asks for
LS008 sizeof of something optional | construct's If and Switch leak a KeyError there | the longest length as a number
LS009 no longest length | a damaged length would keep the decoder waiting for ever | max_length= of every Frame, in bytes
LS010 a hook that fails | what it should have supplied is missing | a hook that answers None for what it does not know
LS101 a field name that construct shadows | `parsed.items` is a method of the Container | another name: samples, points
LS102 a reserved field name | `f.state` and `column.on` mean something else in `points` | another name
LS103 a field name that is no public identifier | == ignores names that begin with _ | a Python identifier
LS104 two fields of one name | the last one wins in silence | a name for each: reserved_1, reserved_2
LS105 a field without a name | its bytes are lost on a round trip | "reserved" / Bytes(n)
LS106 padding | its bits come back as zeros | "reserved" / Bytes(n), or "reserved" / BitsInteger(n) among bits
LS107 Flag on a whole byte | seven bits of it are lost on a round trip | Int8ul, or BitStruct with all eight bits
LS108 FlagsEnum | bits without a name are lost on a round trip | a BitStruct with a field for every bit
LS109 RawCopy, Union or construct's Checksum | edits are ignored when it is built again
      | Checksummed(Struct(...), field=...); one reading of the bytes
LS110 Pickled | it runs code from the wire | the fields themselves
LS111 a greedy field | on a stream it has no end, and of empty elements none ever | a count, a length, or a terminator
LS112 Pointer or Seek | it reads bytes that are not the frame's | the fields in the order of the wire
LS113 Select or Optional | errors in the bytes choose another reading | If or Switch on a header field
LS114 a frame that is no Struct | Const(...).build({}) fails | Struct("header" / Const(...))
LS115 an expression of the struct fails | its error is not one that callers expect | an expression that holds for every header
LS116 a frame that is not compiled | construct reads it alone: hundreds of times slower | fields whose place a header tells
LS201 a measure without a unit | nobody can tell metres from millimetres | Scaled(Int16ul, 0.001, "m"); "" for a pure number
LS202 no source | a number that nobody can look up cannot be checked | source="manual, revision, section" on the Sensor
LS203 a longest length that is not the frame's | frames are refused, or waited for too long | the size of the longest frame
LS204 a sync pattern that is common | most candidates are none, which costs time and good frames | more constant bytes or bits
LS205 a field outside the checksum | a flipped bit in it goes unseen | over= with it, or leave `over` out for all bytes
LS206 a weak frame that anything passes for | noise makes frames, and points where nothing is | plausible=, or confirm=
LS207 `plausible` that is no test of columns | an expression of construct is always true | plausible=lambda f: f.angle < 360
LS208 `points` that cannot be traced | it is evaluated plainly: ten times slower | ufuncs and lidarspec's own vocabulary
LS209 an acknowledgement of nothing | it would hide the next finding of its kind | acknowledged= without it, or with a reason
LS210 a range limit that its field cannot hold | scale or limit is wrong | the scale of the manual, and its limit in metres
LS211 a part of the declaration is missing | nothing can open, decode or find the sensor | vendor, model, a data frame and a data link
LS212 a checksum that nobody checks | damaged frames are taken for good ones
      | Checksummed(Struct(...), field="crc", algorithm=...), which `lidarspec crc` finds; or a remark, "crc" / Int16ul * "not checked: ..."
LS213 Python asks whether a column is true | it takes one answer, and a column has one for each packet
      | (f.a < 1) & (f.b < 2), with | and ~, and np.where in place of `if`
LS214 columns that do not fit together | a point needs one value of each
      | arrays as long as the frame's own, with along(...) the one that is meant; or one value for each packet
LS215 `spread` folds everything onto one value | all samples of a packet get one angle, or one time
      | full= as the circle in the unit of the angles; steps(count) for the index of a sample
LS216 a field that no data frame has | scans, clock or counter come from it, and never come | a path that `lidarspec show` prints
LS217 an option that changes nothing | who sets it gets the same points as without | a `configure` that uses it, or one without it
LS218 an intensity from another field | brightness means something else than the sensor measured
      | intensity= by the field that is named so, or that field in a further column
LS219 a range from a code | an error is drawn as a point | the field that is the distance
LS301 no example can be made up | nothing can be tried on it
      | `simulation=Simulation(sweep=...)` of the sensor or of the Frame, or strategies = {"frame.field": ...} in the test class
LS302 bytes do not survive parsing and building | a replayed or edited frame is another one | fields that keep every bit
LS303 a value is cut, not rounded | int() loses a step whenever a float falls short | Scaled, or round() in place of int()
LS304 values in units build other bytes | what was read cannot be written | Scaled with the right scale and offset
LS305 a field does not keep what is written to it | what was set is not what is read | a field of the width and sign of the wire
LS306 a frame is taken for another type | its fields mean something else there | constants that tell them apart, or another order
LS307 a frame that is cut short passes | what is missing is made up | fields of a declared length
LS308 an exception that is not documented | callers catch LidarSpecError and nothing else | the engine's parse, and lambdas that hold always
LS310 a flipped bit that the checksum does not see | damaged frames are taken for good ones | a checksum over every byte it covers
LS311 examples are not repeatable or too long | what fails once cannot be looked at again | structs without chance or clock in them
LS312 a field that `Rebuild` fills in, and nothing holds | a frame that says otherwise is taken, and built as another
      | the same in `plausible`: f.length == f.size + 5
LS401 a clean stream loses bytes | good frames are lost without any damage | frames whose parts are declared in full
LS404 scans depend on how packets arrive | the same revolution is cut elsewhere | `points` without memory of its own
LS414 the plugin fails at work | what it fails on is lost, and only counted | functions that hold for every valid frame
LS415 the same bytes give different results | nothing can be reproduced | functions of the fields, without clock or chance
LS501 a cloud that breaks the conventions | x y z mean something else than users expect | what Polar asks for: metres, radians, 0: no return
LS502 degrees where radians are due | points go everywhere but where they are | np.deg2rad(...)
LS503 no direction for a single point | a count of 1 divides by count - 1 | spread(start, end, count, full=360.0)
LS504 angles run backwards across the full circle | one packet a turn is drawn all around | spread(..., full=360.0), or wrap of a difference
LS505 an angle of exactly the full circle is not folded | 360.00 degrees is 0 and is met | wrap(angle, 360.0), or `plausible` below it
LS506 angles that are not in order | the scan is cut in the wrong places | the direction of the manual, and spread or wrap
LS507 a simulated scene does not come back | what is written is not what is read | `sweep` and `points` that agree
LS508 a `sweep` that cannot be simulated | sim, demo and virtual_port fail | the raw angles and counters of packet i
LS509 the clock runs back where it starts again | durations come out negative | Clock(..., wraps_at=) in seconds
LS510 the counter's start is taken for a loss | every turn of it counts packets as lost or late | Sequence(field, first=, last=)
LS511 points that turn the other way | left and right are exchanged, or vendor_axes are not the manual's
      | azimuth=-np.deg2rad(clockwise), or the vendor_axes of the manual's figure
LS512 a clock that reads more than its wrap | it is taken to start again when it does not | Clock(..., wraps_at=) in seconds
LS513 times of points that do not fit the clock | points of one packet get times of other scans | time= in seconds
LS601 a command that does not parse back | the sensor is told something else | values and args by the paths of its frame
LS602 an argument that is not held to its range | the sensor is asked for what it cannot do | args={name: (path, lowest, highest)}
LS603 a reply that cannot match | the command waits for ever | matches= and echoes= by fields that the reply has
LS604 a command without the documented reply | the simulated sensor keeps silent | answers=, or matches= that the reply can have
LS605 a command or reply that is not as its vector has it | the sensor is told, or answers, something else
      | values, args, matches and echoes as the manual has them
LS701 a vector without its source | nobody can look it up | "source": "manual, section" in each entry
LS702 a vector that cannot be read | it proves nothing | [{"frame": ..., "hex": ..., "values": {...}, "source": ...}]
LS703 a checksum over the wrong span | no frame of a real sensor is accepted | over= and the algorithm that fit the vectors
LS704 the wrong byte order | 0x1234 is read as 0x3412 | Int16ub for big-endian, Int16ul for little-endian
LS705 unsigned where the wire is signed | -1 is read as 65535 | Int16sl in place of Int16ul
LS706 a vector has another value | the sensor means something else by these bytes | the field as the manual has it
LS707 a vector is not a frame | a real sensor's bytes are refused | the struct as the manual has it
LS708 a vector has its point elsewhere | the picture is wrong | `points` as the manual has it
LS709 a mirrored point | left and right are exchanged | azimuth=-np.deg2rad(clockwise)
LS710 a status without vectors | nobody can see that a frame of a real sensor was ever read
      | vectors.json with frames of the manual or a capture, or status="manual"
LS711 a field that no vector pins down | byte order, scale or place of it may be wrong, and nothing shows it
      | its value in `values` or `units`, in one vector at least another one than 0
LS712 points in one quadrant alone | a mirrored or turned picture has them as well
      | x and y of points in two quadrants, worked out by hand, in `points`
LS713 a vector that reaches too far | its byte order or scale is wrong, or the limit
      | the byte order and scale of the manual, and its range_limits in metres
LS801 an exception is swallowed | what goes wrong is neither seen nor counted | no try at all: the engine counts it
LS802 the clock of the wall | it jumps, and two runs give two results | the sensor's own clock, or time given by the caller
LS803 a short write is ignored | the rest of a command never arrives | sendall, or write on until all is written
LS804 `this` decides in Python | `this.a == this.b` is an expression, and true | If(this.a == this.b, ...), or f.a == f.b
LS805 hasattr(this, ...) | it is always true | a header field that says it
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
        path: frame, and field below it ("data.points.distance"); "" if it concerns the sensor.
        sensor: the id of the sensor; "" if there is none.
        file, line: the location in the source; "" and 0 if it is unknown.
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
            "write": self.rule.write,
        }

    def __str__(self) -> str:
        place = " ".join(part for part in (self.sensor, self.path) if part)
        file = Path(self.file)
        if file.is_relative_to(Path.cwd()):
            file = file.relative_to(Path.cwd())
        if self.line:
            where = f"{file}:{self.line}"
        elif self.file:
            where = str(file)
        else:
            where = ""
        if place and where:
            where = f"{place} ({where})"
        else:
            where = place or where
        rule = self.rule
        return (
            f"{self.code} {rule.title}\n  where  {where}\n  what   {self.what}\n"
            f"  why    {rule.why}\n  write  {rule.write}"
        )


class Violation(AssertionError):
    """The exception of a property that does not hold."""

    def __init__(self, code: str, what: str, path: str = "") -> None:
        self.code = code
        self.what = what
        self.path = path
        rule = RULES[code]
        head = f"{code} {rule.title}\n  where: {path or 'the sensor'}"
        super().__init__(f"{head}\n  what:  {what}\n  why:   {rule.why}\n  write: {rule.write}")


def require(holds: object, code: str, what: str, path: str = "") -> None:
    """Raise a `Violation` unless `holds`.

    Raises:
        Violation: with this code, text and path.
    """
    if not holds:
        raise Violation(code, what, path)


def left_over(findings: list[Finding], sensor: Sensor, *, whole: bool) -> list[Finding]:
    """Return the findings that a declaration does not acknowledge with a reason.

    Args:
        whole: whether these are all findings; then an acknowledgement without a finding is a
            finding, too.
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
            (place, key)
            for place in (frame, "")
            for key in (finding.code, f"{finding.code} {field if place else finding.path}")
        ]
        acknowledging = [
            (place, key) for place, key in keys if given.get(place, {}).get(key, "").strip()
        ]
        used.update(acknowledging)
        left += [] if acknowledging else [finding]
    for place, entries in given.items() if whole else ():
        for key, reason in entries.items():
            if (place, key) not in used:
                if not reason.strip():
                    problem = "has no reason"
                else:
                    problem = "is not found"
                left.append(
                    Finding("LS209", f"{key!r} is acknowledged, and {problem}", place, sensor.id)
                )
    return left
