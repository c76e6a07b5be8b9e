"""A simulated sensor as a device: it takes bytes and returns bytes, without I/O.

Data frames are sent at the rate of the sensor's clock, and other frames at their declared rate.
Commands get the documented replies, and can start and stop the data. If no command of `on_open`
starts the sensor, it sends data from power-on. The caller passes the current time to each method,
in ns of one monotonic clock, so the device can run faster than real time.
"""

from __future__ import annotations

import bisect
import functools
import heapq
import math
import random
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from lidarspec.errors import SpecError, UsageError
from lidarspec.frames.parse import parse
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.frame_engine import get_codec
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.clock_faults import ClockTimeline
from lidarspec.simulation.faults import Faults, FaultyLink
from lidarspec.simulation.fragmenter import Fragmenter
from lidarspec.simulation.scenes import Scene, make_room
from lidarspec.simulation.simulator import (
    FrameSimulation,
    FramesWithoutPoints,
    check_clock_faults,
    find_followed_scale,
    find_periodic_rates,
    frame_simulation,
)
from lidarspec.spec.arguments import OWN_ADDRESS, OWN_PORT, Address, Port
from lidarspec.spec.description import Answer, Command, Frame, Sweep
from lidarspec.spec.enum_values import find_code
from lidarspec.spec.links import Http, Udp, is_datagram
from lidarspec.spec.sensor import with_frames
from lidarspec.spec.tree import FieldInfo

SECOND = 1_000_000_000
#: Maximum duration of a batch of packets, in ns of the device's time.
MAX_BATCH_NS = SECOND // 4
#: Maximum number of packets in a batch.
MAX_BATCH_PACKETS = 128
#: Number of fillers that are sent in a pause.
PAUSE_FILLERS = 14
#: If a device is polled later than this, in ns, its clock skips the additional delay.
MAX_DELAY_NS = SECOND

#: Name under which functions in `answers` get the port at which the data is served.
DATA_PORT = "{data_port}"
Packet = tuple[str, bytes]
#: Nanoseconds without input after which an incomplete request is discarded.
REQUEST_TIMEOUT_NS = 50_000_000


@dataclass(frozen=True, eq=False)
class ReceivedCommand:
    """A received command, with raw values by field path or "{placeholder}"."""

    name: str
    command: Command
    values: Mapping[str, Any]

    @property
    def destination(self) -> tuple[str, int] | None:
        """(address, port) to which the command redirects the data; None if it does not.

        The address is "" if the command contains only a port.
        """
        port = self._find(Port, OWN_PORT)
        address = self._find(Address, OWN_ADDRESS)
        if not port or not int(port):
            return None
        return _to_host(address), int(port)

    def _find(self, kind: type[Port | Address], placeholder: str) -> Any:
        """Return the port or address in the command; None if it has none."""
        paths = [path for path, value in self.command.values.items() if isinstance(value, kind)]
        paths += [
            argument.path
            for argument in self.command.arguments.values()
            if isinstance(argument.kind, kind)
        ]
        if paths:
            return _get_flat(self.values, paths[0])
        return self.values.get(f"{{{placeholder}}}")


def _get_flat(values: Mapping[str, Any], path: str) -> Any:
    """Return the value at a path, which may end with an index; None if missing."""
    base, _, index = path.partition("[")
    value = values.get(base)
    if index and isinstance(value, list):
        return value[int(index.rstrip("]"))]
    return value


def _to_host(address: Any) -> str:
    """Return an address as text; "" for None and for the address 0.0.0.0."""
    from ipaddress import ip_address  # a slow import

    if isinstance(address, list):
        address = bytes(address)
    if not address:
        return ""
    try:
        parsed = ip_address(address)
    except ValueError:
        return ""  # a host name, which the simulated sensor cannot resolve
    if parsed.is_unspecified:
        return ""
    return str(parsed)


class ReplyPart(NamedTuple):
    """A part of a reply: a frame, other bytes, or a pause.

    Attributes:
        frame: the frame type; "" for bytes that are not a frame.
        data: the bytes; b"" for a pause.
        pause: duration of the pause, in seconds.
    """

    frame: str = ""
    data: bytes = b""
    pause: float = 0.0


class ReplyMaker:
    """Makes the replies of one sensor to its commands.

    Args:
        shake: standard deviation of the noise on IMU measurements, in m/s2 for accelerations and in
            rad/s for angular rates.

    Attributes:
        data_port: the port at which the simulated sensor serves its data; 0 for none.
    """

    def __init__(self, sensor: Sensor, shake: float = 0.0) -> None:
        self._sensor = sensor
        self.data_port = 0
        self._frames = FramesWithoutPoints(sensor, shake)
        self._received: dict[str, int] = {}
        links = {command.link for command in sensor.commands.values() if command.frame}
        self._decoders = {link: _make_command_decoder(sensor, link) for link in links}

    def find_requests(self, data: bytes, now: int, link: str) -> list[ReceivedCommand]:
        """Return the commands that the received bytes complete."""
        decoder = self._decoders.get(link)
        if decoder is None:
            return []
        if now - self._received.get(link, now) > REQUEST_TIMEOUT_NS:
            decoder.idle()
        self._received[link] = now
        requests = (self._find_request(item.frame, item.data, link) for item in decoder.feed(data))
        return [request for request in requests if request is not None]

    def make_replies(self, request: ReceivedCommand, now: float) -> list[ReplyPart]:
        """Return the parts of the reply to a command.

        Args:
            now: the time of the request, ns since power-on.
        """
        declared = self._sensor.simulation.answers.get(request.name)
        chosen: Iterable[Answer] = request.command.replies[:1]
        if declared is not None:
            if callable(declared):
                chosen = declared({**request.values, DATA_PORT: self.data_port})
            else:
                chosen = declared
        return [self._make_reply(answer, request, now) for answer in chosen]

    def use_timeline(self, timeline: ClockTimeline) -> None:
        """Apply the faults of a clock to the periodic frames from now on."""
        self._frames.use_timeline(timeline)

    def make_periodic_frame(self, name: str, number: int) -> bytes:
        """Return frame number `number` of a type that the sensor sends periodically."""
        return self._frames.make_frame(name, number)

    def _make_reply(self, answer: Answer, request: ReceivedCommand, now: float) -> ReplyPart:
        if isinstance(answer, bytes):
            return ReplyPart(data=answer)
        if isinstance(answer, int | float):
            return ReplyPart(pause=float(answer))
        name, values = (answer, {}) if isinstance(answer, str) else answer
        given = {**self._find_reply_values(name, request), **values}
        return ReplyPart(name, self._frames.make(name, given, now))

    def _find_reply_values(self, name: str, request: ReceivedCommand) -> dict[str, Any]:
        """Return a reply's fixed values, and the values that it repeats from its request."""
        fields = get_codec(self._sensor.frames[name]).schema.fields
        raw = {
            path: request.values[path] for path in request.command.echoes if path in request.values
        } | dict(request.command.matches)
        return {
            path: _to_physical(fields[path], value) for path, value in raw.items() if path in fields
        }

    def _find_request(self, frame: str, data: bytes, link: str) -> ReceivedCommand | None:
        """Return the command that a received frame contains; None if there is none."""
        values = dict(_iter_flat(parse(self._sensor, data, frame=frame)))
        fields = get_codec(self._sensor.frames[frame]).schema.fields
        best: ReceivedCommand | None = None
        for command_name, command in self._sensor.commands.items():
            if command.frame != frame or command.link != link:
                continue
            texts = _match_command(command, values, fields)
            if texts is None:
                continue
            if best is None or _rank(command) > _rank(best.command):
                best = ReceivedCommand(command_name, command, {**values, **texts})
        return best


def _match_command(
    command: Command, values: Mapping[str, Any], fields: Mapping[str, FieldInfo]
) -> dict[str, str] | None:
    """Return the text for each placeholder of a command; None if the values differ."""
    fixed = {
        path: find_code(fields[path], value) if path in fields else value
        for path, value in command.fixed.items()
    }
    if any(values.get(path) != value for path, value in fixed.items()):
        return None
    texts = dict[str, str]()
    for path, template in command.templates.items():
        matched = template.match(values.get(path))
        if matched is None:
            return None
        texts |= {f"{{{name}}}": text for name, text in matched.items()}
    return texts


def _rank(command: Command) -> tuple[int, int]:
    """Return how specific a command is, to choose one of several matching commands."""
    literal_size = sum(template.literal_size for template in command.templates.values())
    return len(command.fixed), literal_size


def _make_command_decoder(sensor: Sensor, link: str) -> Decoder:
    """Return a decoder for the frames that a link transmits to the sensor."""
    frames = {
        name: _make_incoming(frame)
        for name, frame in sensor.frames.items()
        if frame.direction == "out"
    }
    return Decoder(with_frames(sensor, frames), stream=not is_datagram(sensor.links.get(link)))


@functools.lru_cache(maxsize=256)
def _make_incoming(frame: Frame) -> Frame:
    """Return a frame type that the host sends, as a type that a decoder accepts."""
    return replace(frame, direction="in")


def _to_physical(info: FieldInfo, value: Any) -> Any:
    """Return a parsed value in the unit of its field."""
    if isinstance(value, bytes) or (isinstance(value, list) and info.kind == "bytes"):
        return value
    if isinstance(value, list | tuple):
        return [_to_physical(info, element) for element in value]
    return info.physical(find_code(info, value))


def _iter_flat(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _iter_flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


class _PlannedData(NamedTuple):
    """Data to send at a planned time.

    Attributes:
        at: the time, ns since power-on.
        number: a running number in the order of planning.
        frame: the frame type; "" for bytes that are not a frame.
        repetition: number of earlier periodic frames of the type; None for all other data.
    """

    at: float
    number: int
    link: str
    frame: str
    data: bytes
    repetition: int | None = None


class _FrameStream:
    """The data frames of one type that a device sends after it was started.

    Attributes:
        due: the time of the next frame, ns since power-on.
    """

    def __init__(
        self,
        frame_simulation: FrameSimulation,
        frame: str,
        scene: Scene,
        began: float,
        shake: float,
        timeline: ClockTimeline,
    ) -> None:
        self._made = frame_simulation
        self._scene = scene
        self.frame = frame
        self._shake = shake
        self._timeline = timeline
        self._next = 0
        self._end = began
        self._frames: list[bytes] = []
        self._times: list[float] = []
        self._position = 0
        self.due = began

    @property
    def next_number(self) -> int:
        """The number of the first frame that is not made yet."""
        return self._next

    def change(self, frame_simulation: FrameSimulation) -> None:
        """Continue with frame 0 of another simulation, after the frames already made."""
        self._made = frame_simulation
        self._next = 0

    def take(self, upto: float) -> list[tuple[float, bytes]]:
        """Return (time, frame) of the frames that are due until a time."""
        taken: list[tuple[float, bytes]] = []
        while self.due <= upto:
            if self._position == len(self._frames):
                self._make_batch()
            first = self._position
            self._position = bisect.bisect_right(self._times, upto)
            taken += zip(
                self._times[first : self._position],
                self._frames[first : self._position],
                strict=True,
            )
            if self._position < len(self._frames):
                self.due = self._times[self._position]
            else:
                self.due = self._end
        return taken

    def _make_batch(self) -> None:
        """Make the next batch of frames."""
        count = max(min(int(MAX_BATCH_NS / max(self._made.interval, 1)), MAX_BATCH_PACKETS), 1)
        block = self._made.block(
            self._next, count, self._scene, self._end / SECOND, self._shake, self._timeline
        )
        times = (self._end + block.times).tolist()
        self._frames = block.frames
        self._times = times[:-1]
        self._position = 0
        self._next = self._next + count
        self._end = times[-1]


class SimulatedDevice:
    """A simulated sensor in a scene, which replies to commands.

    Args:
        scene: the surroundings of the sensor; by default a random room with a walking person.
        seed: seed of the scene, the faults and the fillers.
        rate: speed relative to real time; with infinity, data is sent as fast as it is read.
        faults: the faults on the links.

    Attributes:
        present: whether the device is connected.
        commands_received: the names of the commands that the device has received.
        destination: (address, port) to which a command has redirected the data, or None. The
            address is "" if the command contained only a port.
        sent: number of sent frames by type, before faults.
        lines: the links with their faults, by name.
        utc_offset_ns: UTC minus the time that the caller passes, ns; None if the sensor sends the
            dates that its `Simulation.sweep` returns. A change takes effect at the next `start`.

    Raises:
        UsageError: if the sensor declares no `sweep`, or if its clock cannot have the faults.
        SpecError: if the spec does not determine the packet rate.
    """

    def __init__(
        self,
        sensor: Sensor,
        *,
        scene: Scene | None = None,
        seed: int = 0,
        rate: float = 1.0,
        faults: Faults | None = None,
    ) -> None:
        self.sensor = sensor
        self.rate = rate
        self.faults = faults or Faults()
        self.present = True
        self.utc_offset_ns: int | None = None
        self.commands_received = list[str]()
        self.destination: tuple[str, int] | None = None
        self.sent = Counter[str]()
        self.lines = {name: self._make_link(name, seed) for name in sensor.links}
        self._scene = scene or make_room(seed)
        self._source = random.Random(f"device {seed}")
        self._replies = ReplyMaker(sensor, self.faults.shake)
        self._periodic_rates = find_periodic_rates(sensor)
        self._plan: list[_PlannedData] = []
        self._planned = 0
        self._stream: _FrameStream | None = None
        self._sweep: Sweep | None = None  # after the effects of commands; None before any
        self._powered = 0
        self._time = 0.0
        self._plug: int | None = None
        self._late: list[tuple[str, str, bytes]] = []
        self._late_until = 0
        self._timeline = ClockTimeline(self.faults.clock)
        self._fragmenter: Fragmenter | None = None
        link = sensor.links.get("data")
        if isinstance(link, Udp) and link.assembled is not None:
            self._fragmenter = Fragmenter(sensor.id, link.assembled)
        if sensor.has_points:
            self._get_simulation(sensor.data_frame)
        check_clock_faults(sensor, self.faults.clock)

    def _make_link(self, name: str, seed: int) -> FaultyLink:
        """Return the link of this name with its faults."""
        link = self.sensor.links[name]
        stream = not is_datagram(link)
        # A byte stream other than the data link is treated as TCP, which loses no bytes.
        is_reliable = isinstance(link, Http) or (stream and name != "data")
        return FaultyLink(Faults() if is_reliable else self.faults, seed=seed, stream=stream)

    def start(self, now: int) -> None:
        """Switch the device on, or off and on again."""
        self._plan = []
        self._stream = None
        self._sweep = None
        self._powered = now
        self._time = 0.0
        self.destination = None
        self._timeline = self._make_timeline(now)
        self._replies.use_timeline(self._timeline)
        self.present = True
        self._late = []
        self._late_until = 0
        if self.faults.unplug:
            self._plug = now + int(self.faults.unplug * SECOND)
        else:
            self._plug = None
        is_started = not self._waits_for_command()
        if is_started or self.sensor.has_points:
            self._begin_periodic(0.0)
        if is_started and self.sensor.has_points:
            self._begin_data(0.0, self.sensor.data_frame)

    def _make_timeline(self, now: int) -> ClockTimeline:
        """Return the timeline of a clock that is switched on now."""
        faults = self.faults.clock
        if self.utc_offset_ns is None:
            return ClockTimeline(faults, now)
        if not faults.follows:
            faults = replace(faults, follows=find_followed_scale(self.sensor))
        return ClockTimeline(faults, now + self.utc_offset_ns)

    def _waits_for_command(self) -> bool:
        """Return whether the device sends no data until a start command is received."""
        # Programs send no other start commands.
        opening = [self.sensor.commands[name] for name in self.sensor.on_open]
        return any(command.starts and command.frame for command in opening)

    def set_data_port(self, data_port: int) -> None:
        """Set the port that replies report as the port of the data."""
        self._replies.data_port = data_port

    def unplug(self) -> None:
        """Disconnect the device; `start` connects it again."""
        self.present = False
        self._plug = None

    def jump_clock(self, seconds: float) -> None:
        """Make the sensor's clock jump; the jump happens within a quarter of a second.

        Args:
            seconds: the size of the jump; negative to jump back. Several jumps add up.

        Raises:
            UsageError: if the sensor has no clock, if its clock cannot be written, or if no data is
                sent.
        """
        if self._stream is None:
            raise UsageError(f"{self.sensor.id} sends no data, so its clock cannot jump")
        self._get_simulation(self._stream.frame).clock.check(self.faults.clock)
        self._timeline.jump_ns += round(seconds * SECOND)
        self._replies.use_timeline(self._timeline)

    def delay_output(self, seconds: float, now: int) -> None:
        """Hold back all data for `seconds`, and then send all of it in one burst."""
        self._late_until = now + round(seconds * SECOND)

    def receive(self, data: bytes, now: int, link: str = "data") -> None:
        """Process received bytes, or a received datagram, at the time `now`."""
        self._switch_plug(now)
        if self.present:
            for request in self._replies.find_requests(data, now, link):
                self._reply(request, self._find_device_time(now))

    def outgoing(self, now: int) -> list[tuple[str, bytes]]:
        """Take out the data that is due until `now`, and return it as (link, bytes).

        The list has an item for each datagram, and one item with all bytes of each byte stream.
        """
        return [(link, data) for link, _, data in self.outgoing_with_types(now)]

    def outgoing_with_types(self, now: int) -> list[tuple[str, str, bytes]]:
        """Take out the data that is due until `now`; return it as (link, frame type, bytes).

        The list has an item for each datagram. All bytes of a byte stream are one item, with the
        type "".
        """
        self._switch_plug(now)
        if not self.present:
            return []
        self._time = self._find_device_time(now) + (MAX_BATCH_NS if math.isinf(self.rate) else 0)
        packets: dict[str, list[Packet]] = {}
        for link, frame, data in self._take_due(self._time):
            packets.setdefault(link, []).append((frame, data))
        out: list[tuple[str, str, bytes]] = []
        for link, link_packets in packets.items():
            self.sent.update(frame for frame, _ in link_packets if frame)
            datagrams = self._split_messages(link_packets) if link == "data" else link_packets
            arrived = self.lines[link].transmit(datagrams)
            if is_datagram(self.sensor.links[link]):
                out += [(link, frame, data) for frame, data in arrived]
            elif arrived:
                out.append((link, "", b"".join(data for _, data in arrived)))
        self._late += out
        if now < self._late_until:
            return []
        out = self._late
        self._late = []
        return out

    def _split_messages(self, packets: list[Packet]) -> list[Packet]:
        """Return `packets`, split into datagrams if the link splits messages."""
        if self._fragmenter is None:
            return packets
        return [(frame, part) for frame, data in packets for part in self._fragmenter.split(data)]

    @property
    def deadline(self) -> int | None:
        """The time of the next output, disconnection or reconnection; None without one."""
        times = [self._plug] if self._plug is not None else []
        if self.present:
            due = [self._plan[0].at] if self._plan else []
            due += [self._stream.due] if self._stream else []
            times += [self._powered + math.ceil(at / self.rate) for at in due]
            if self._late:
                times.append(self._late_until)
        return min(times, default=None)

    @property
    def replied_at(self) -> int | None:
        """The time of the last planned reply to a command; None if there is none."""
        times = [due.at for due in self._plan if due.repetition is None]
        if not times or math.isinf(self.rate):
            return None
        return self._powered + math.ceil(max(times) / self.rate)

    def _find_device_time(self, now: int) -> float:
        """Return the time of the device, ns since power-on."""
        if math.isinf(self.rate):
            return self._time
        late = int((now - self._powered) - self._time / self.rate) - MAX_DELAY_NS
        if late > 0:
            self._powered += late
            self._timeline.delay_power_on(late)
            self._replies.use_timeline(self._timeline)
        return (now - self._powered) * self.rate

    def _take_due(self, upto: float) -> list[tuple[str, str, bytes]]:
        """Return the data that is due until a time, in order, as (link, type, bytes)."""
        sendings: list[tuple[float, str, str, bytes]] = []
        while self._plan and self._plan[0].at <= upto:
            due = heapq.heappop(self._plan)
            sendings.append((due.at, due.link, due.frame, due.data))
            self._plan_next(due)
        planned = len(sendings)
        if self._stream is not None:
            sendings += [
                (at, "data", self._stream.frame, data) for at, data in self._stream.take(upto)
            ]
        if planned and len(sendings) > planned:
            sendings.sort(key=lambda item: item[0])
        return [item[1:] for item in sendings]

    def _plan_next(self, due: _PlannedData) -> None:
        """Plan the next frame of a type that is sent periodically."""
        if due.repetition is None:
            return
        repetition = due.repetition + 1
        data = self._replies.make_periodic_frame(due.frame, repetition)
        period_ns = SECOND / self._periodic_rates[due.frame]
        self._plan_data(due.at + period_ns, due.link, due.frame, data, repetition)

    def _reply(self, request: ReceivedCommand, now: float) -> None:
        """Plan the reply to a command, and the data if the command starts it."""
        self.commands_received.append(request.name)
        command = request.command
        time_ns = now
        mode = None
        if command.only_stopped and self._stream is not None:
            return
        self.destination = request.destination or self.destination
        if command.starts or command.stops:
            self._stream = None
            self._plan = [
                due for due in self._plan if self.sensor.has_points and due.repetition is not None
            ]
            heapq.heapify(self._plan)
        announcing = {frame.after for frame in self.sensor.frames.values() if frame.after}
        for answer in self._replies.make_replies(request, now):
            if answer.pause:
                time_ns = self._plan_pause(time_ns, answer.pause, command.link)
            else:
                self._plan_data(time_ns, command.link, answer.frame, answer.data)
                mode = answer.frame if answer.frame in announcing else mode
        if request.name in self.sensor.simulation.effects:
            self._apply_effect(request.name)
        if command.starts and not self.sensor.has_points:
            self._begin_periodic(time_ns)
        elif command.starts:
            kinds = [
                name
                for name, frame in self.sensor.frames.items()
                if frame.data and frame.after == mode
            ]
            chosen = (
                self.sensor.data_frame
                if self.sensor.data_frame in kinds
                else next(iter(kinds), None)
            )
            if chosen is not None:
                self._begin_data(time_ns, chosen)

    def _apply_effect(self, command: str) -> None:
        """Change the sweep as the spec declares it for a command."""
        sweep = self._sweep or self.sensor.simulation.sweep
        if sweep is None:
            return
        number = 0
        if self._stream is not None:
            number = self._stream.next_number
        self._sweep = self.sensor.simulation.effects[command](sweep, number)
        if self._stream is not None:
            self._stream.change(self._get_simulation(self._stream.frame))

    def _begin_periodic(self, at: float) -> None:
        """Plan the first frame of each type without points that is sent periodically."""
        for name in self._periodic_rates:
            self._plan_data(at, "data", name, self._replies.make_periodic_frame(name, 0), 0)

    def _plan_pause(self, at: float, seconds: float, link: str) -> float:
        """Plan the fillers that are sent during a pause, and return the end of the pause."""
        for step in range(PAUSE_FILLERS if self.sensor.fillers else 0):
            data = bytes([self._source.choice(self.sensor.fillers)])
            self._plan_data(
                at + seconds * SECOND * (step + 1) / (PAUSE_FILLERS + 1), link, "", data
            )
        return at + seconds * SECOND

    def _begin_data(self, at: float, frame: str) -> None:
        self._stream = _FrameStream(
            self._get_simulation(frame), frame, self._scene, at, self.faults.shake, self._timeline
        )

    def _get_simulation(self, frame: str) -> FrameSimulation:
        sensor = self.sensor
        if self._sweep is not None:
            sensor = replace(sensor, simulation=replace(sensor.simulation, sweep=self._sweep))
        stream_simulation = frame_simulation(sensor, frame, blocked=bool(self.faults.rotor))
        if not stream_simulation.interval:
            raise SpecError(
                "the rate of this frame type is unknown: declare `rate`",
                path=frame,
                sensor=self.sensor.id,
            )
        return stream_simulation

    def _plan_data(
        self, at: float, link: str, frame: str, data: bytes, repetition: int | None = None
    ) -> None:
        self._planned += 1
        planned = _PlannedData(at, self._planned, link, frame, data, repetition)
        heapq.heappush(self._plan, planned)

    def _switch_plug(self, now: int) -> None:
        """Disconnect or reconnect the device if the time for this has come."""
        if self._plug is None or now < self._plug:
            return
        if self.present:
            self.present = False
            self._plug = now + int(self.faults.absent * SECOND)
        else:
            self.start(now)
