"""A Wireshark dissector: what a spec says as Lua tables, and the Lua code that walks them.

What depends on the sensor is written here; ``wireshark.lua``, beside this module, is the same for all.
"""

from __future__ import annotations

from importlib import resources
from typing import Any

from lidarspec._version import __version__
from lidarspec.export.messages import Message, messages
from lidarspec.export.wireshark_nodes import tables
from lidarspec.export.wireshark_text import lua, quoted
from lidarspec.frames.codecs import codec
from lidarspec.links import Tcp, Udp
from lidarspec.spec import Sensor

#: the link types that captures keep for private use, USER0 to USER15, by the numbers that Wireshark's wtap gives them.
USER_LINKS = tuple(range(45, 61))

_HEAD = """\
-- {title}: a dissector for Wireshark and tshark, made by lidarspec {version}.
-- Source: {source}
--
--     wireshark -X lua_script:THIS_FILE CAPTURE
--
-- or put it into the personal Lua plugins folder (Help, About Wireshark, Folders).
-- It takes UDP and TCP by port, UDP on other ports by its constants, and captures of link type USER0 to USER15, which hold what came
-- over a serial line ("lidarspec record SOURCE -s SENSOR -o FILE.pcap" writes them).
-- A field is the raw number of the wire; where it has a unit, FIELD.physical can be filtered by as well.

local proto = Proto({name}, {title_quoted})
local int = {{}}

local fields = {{}}
local function new(abbreviation, name, type, shown, labels, mask, text)
  local key = table.concat({{abbreviation, type, shown, mask or 0}}, " ")
  fields[key] = fields[key] or ProtoField.new(name, abbreviation, type, labels, shown, mask, text)
  return fields[key]
end

local kind = new({name} .. ".frame", "frame type", ftypes.STRING, base.NONE)
local verdicts = {{[0] = "Bad", [1] = "Good", [2] = "Not filled"}}
local status = new({name} .. ".checksum.status", "checksum status", ftypes.UINT8, base.NONE, verdicts)
local marks = {{
  checksum = ProtoExpert.new({name} .. ".checksum.bad", "checksum wrong", expert.group.CHECKSUM, expert.severity.ERROR),
  constant = ProtoExpert.new({name} .. ".constant.bad", "not the constant that stands here", expert.group.MALFORMED, expert.severity.ERROR),
  short = ProtoExpert.new({name} .. ".cut_off", "the frame ends before its last field", expert.group.MALFORMED, expert.severity.ERROR),
  skipped = ProtoExpert.new({name} .. ".skipped", "bytes of no frame", expert.group.UNDECODED, expert.severity.WARN),
}}
"""

_REGISTERED = """
local listed = {}
for _, field in pairs(fields) do table.insert(listed, field) end
proto.fields = listed
proto.experts = {marks.checksum, marks.constant, marks.short, marks.skipped}
"""


def dissector(sensor: Sensor) -> str:
    """A Lua dissector for Wireshark: of the sensor's UDP and TCP ports, and of captures of a serial line.

    Raises:
        Refused: where only Python code can decide what a frame is made of.
    """
    name = sensor.id.replace("-", "_")
    found = sorted(messages(sensor), key=lambda message: message.frame.direction)  # "in" before "out": what both could be came in
    about = {
        "title": _title(sensor),
        "is_stream": any(isinstance(link, Udp) and link.stream for link in sensor.links.values()),
        "announcing": {frame.after: True for frame in sensor.frames.values() if frame.after},
        "places": _places(sensor),
        "frames": [_frame(message, name) for message in found],
    }
    head = _HEAD.format(
        title=_title(sensor),
        version=__version__,
        source=" ".join(sensor.source.split()),
        name=quoted(name),
        title_quoted=quoted(_title(sensor)),
    )
    return "\n".join([head, f"local sensor = {lua(about)}", _REGISTERED, _walker()])


def _title(sensor: Sensor) -> str:
    return f"{sensor.vendor} {sensor.model}"


def _frame(message: Message, name: str) -> dict[str, Any]:
    prefix = codec(message.frame).prefix
    return {
        "name": message.name,
        "longest": message.frame.max_length,
        "after": message.frame.after,
        "magic": [[spot, mask, value] for spot, (mask, value) in sorted(prefix.items())],
        "root": tables(message, f"{name}.{message.name}"),
    }


def _places(sensor: Sensor) -> dict[str, list[int]]:
    """Where frames are found: Wireshark's table -> its patterns."""
    links = sensor.links.values()
    places = {
        "udp.port": [port for link in links if isinstance(link, Udp) for port in link.ports],
        "tcp.port": [link.port for link in links if isinstance(link, Tcp)],
        "wtap_encap": list(USER_LINKS),
    }
    return {place: sorted(set(patterns)) for place, patterns in places.items() if patterns}


def _walker() -> str:
    return resources.files("lidarspec.export").joinpath("wireshark.lua").read_text(encoding="utf-8")
