"""Checks of commands: their frames, ranges of arguments, and simulated replies."""

from __future__ import annotations

import math
from ipaddress import ip_address
from typing import Any

from lidarspec.device.session import PendingReply, Reply, Session, get_nested, learn_options
from lidarspec.errors import CommandError, LidarSpecError, SpecError, UsageError
from lidarspec.explaining.formatting import format_argument_type
from lidarspec.frames.commands import find_argument_slot, to_raw_argument
from lidarspec.frames.parse import identify
from lidarspec.frames.schema import make_schema
from lidarspec.framing.results import Found
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.device import SimulatedDevice
from lidarspec.spec import Command, Http
from lidarspec.spec.arguments import Address, Choice, Range, Text
from lidarspec.spec.enum_values import find_code
from lidarspec.spec.links import is_datagram
from lidarspec.testing.findings import ViolationError, require
from lidarspec.testing.sensor_under_test import SensorUnderTest

#: Time between two steps of a simulated exchange in nanoseconds.
STEP_NS = 20_000_000


def make_arguments(subject: SensorUnderTest, name: str, share: float) -> dict[str, Any]:
    """Return a valid value for each argument of a command, by name.

    Args:
        share: from 0 for the lowest number and the shortest text, to 1 for the highest number and
            the longest text.
    """
    return {
        key: _make_argument(subject.sensor, name, key, share)
        for key in subject.sensor.commands[name].arguments
    }


def _make_argument(sensor: Sensor, name: str, key: str, share: float) -> Any:
    slot = find_argument_slot(sensor, name, key)
    kind = sensor.commands[name].arguments[key].kind
    match kind:
        case Choice(names=names):
            numbers = sorted(names.values())
            return numbers[round(share * (len(numbers) - 1))]
        case Range(low, high):
            return low + share * (high - low)
        case Text(size):
            return "x" * round(share * min(size, slot.length or size))
        case Address():
            return str(ip_address(bytes([round(share * 255)] * (slot.length or 4))))
    return bytes(range(slot.length or round(share * 16)))


def a_command_parses_back(subject: SensorUnderTest, name: str) -> None:
    """Check that parsing a command's frame returns its fixed values and arguments."""
    for share in (0.0, 0.37, 1.0):
        try:
            _check_parses_back(subject.sensor, name, make_arguments(subject, name, share))
        except LidarSpecError as error:
            raise ViolationError("LS601", str(error), f"commands.{name}") from error


def _check_parses_back(sensor: Sensor, name: str, arguments_given: dict[str, float]) -> None:
    """Fail unless the command's frame parses back to its fixed values and arguments."""
    command = sensor.commands[name]
    data = sensor.command(name, **arguments_given)
    if command.frame is None:
        assert data == b"", "the command has bytes, but declares no frame type"
        return
    parsed = sensor.parse(data, frame=command.frame)
    assert sensor.build(command.frame, parsed) == data, (
        "parsing the command and building it again gives different bytes"
    )
    fields = make_schema(sensor.frames[command.frame].tree).fields
    for path, value in command.fixed.items():
        expected = find_code(fields[path], value) if path in fields else value
        assert get_nested(parsed, path) == expected, (
            f"{path} is {get_nested(parsed, path)}, expected {value}"
        )
    for argument, value in arguments_given.items():
        slot = find_argument_slot(sensor, name, argument)
        declared = command.arguments[argument]
        read = get_nested(parsed, declared.path)
        if declared.path in command.templates:
            texts = command.templates[declared.path].match(read)
            template = command.templates[declared.path].text
            assert texts is not None, (
                f"{declared.path} is {read!r}, which does not match the template {template!r}"
            )
            read = texts[argument].encode()
            if isinstance(declared.kind, Range):
                read = float(read)
        raw = to_raw_argument(slot, declared.kind, value, argument, name)
        if isinstance(declared.kind, Range):
            read = slot.info.physical(read)
            assert abs(read - value) <= abs(slot.info.scale) * 0.5001, (
                f"{argument} is {read:g}, expected {value:g}"
            )
        else:
            assert read == raw, f"{argument} is {read!r}, expected {value!r}"


def arguments_outside_ranges_are_errors(subject: SensorUnderTest, name: str) -> None:
    """Check that arguments outside their ranges raise an error."""
    for key, declared in subject.sensor.commands[name].arguments.items():
        kind = declared.kind
        ends: tuple[float | str, ...]
        if isinstance(kind, Range):
            ends = (kind.low - 1, kind.high + 1)
        elif isinstance(kind, Text):
            ends = ("x" * (kind.size + 1),)
        else:
            ends = ()
        for outside in ends:
            try:
                subject.sensor.command(name, **{**make_arguments(subject, name, 0.0), key: outside})
            except UsageError:
                continue
            raise ViolationError(
                "LS602",
                f"{key} = {outside} is accepted, but the declared values are"
                f" {format_argument_type(kind)}",
                f"commands.{name}.args.{key}",
            )


def check_exchange(
    sensor: Sensor, name: str, given: dict[str, Any], data: bytes, answer: bytes | None, path: str
) -> None:
    """Check that a command and its reply agree with a golden vector.

    Args:
        given: the arguments of the command, by name.
        data: the bytes of the command in the vector.
        answer: the bytes of the reply in the vector; None if the vector has no reply.
        path: the place that the error names: the key of the vector in its file, and the command.

    Raises:
        ViolationError: if the command is built with other bytes, or if `answer` is not recognized
            as a reply to the command.
    """
    command = sensor.commands[name]
    try:
        built = sensor.command(name, **given)
        require(
            built == data,
            "LS605",
            f"the command sends {built.hex(' ')}, expected {data.hex(' ')}",
            path,
        )
        if answer is None:
            return
        require(
            command.replies,
            "LS605",
            "the vector has a reply, but the command declares no reply",
            path,
        )
        session = Session(sensor)
        pending = session.request(name, 0, **given)
        kind = identify(sensor, answer)
        session.receive([Found(kind, 0, answer)], 1, link=command.link)
        session.tick(math.ceil(1e9 * (1 + command.timeout) * (2 + command.retries)))
        pending.result()
    except LidarSpecError as error:
        raise ViolationError("LS605", str(error), path) from error


def replies_can_match(subject: SensorUnderTest, name: str) -> None:
    """Check that each field by which replies are recognized exists in a reply of the command.

    One of the reply types that the command declares has to have the field.
    """
    command = subject.sensor.commands[name]
    answers = [subject.fields(reply) for reply in command.replies]
    for path in (*command.matches, *command.echoes) if answers else ():
        require(
            any(path in fields for fields in answers),
            "LS603",
            f"no reply has a field {path!r}",
            f"commands.{name}",
        )


def replies_belong_to_one_command(subject: SensorUnderTest, name: str) -> None:
    """Check that the reply to another command is not accepted, if a field distinguishes them.

    The field has to be in both commands and in their reply, and the commands have to give it
    different fixed values. The replies of many protocols have no such field.
    """
    command = subject.sensor.commands[name]
    for other_name, other in subject.sensor.commands.items():
        if not _accepts_replies_to(subject.sensor, command, other):
            continue
        for reply in (one for one in command.replies if one in other.replies):
            for path, info in subject.fields(reply).items():
                is_fixed = path in command.fixed and path in other.fixed
                if not is_fixed or path in command.matches or info.const is not None:
                    continue
                require(
                    find_code(info, command.fixed[path]) == find_code(info, other.fixed[path]),
                    "LS606",
                    f"the reply {reply} contains {path}, which distinguishes the commands {name}"
                    f" and {other_name}, but {name} does not compare it",
                    f"commands.{name}",
                )


def _accepts_replies_to(sensor: Sensor, command: Command, other: Command) -> bool:
    """Return whether a command may accept a reply to another command, if the types are equal.

    The reply to an HTTP request always belongs to the request.
    """
    if command.link != other.link or isinstance(sensor.links[command.link], Http):
        return False
    if command.echoes:
        return False
    return not any(
        path in other.matches and value != other.matches[path]
        for path, value in command.matches.items()
    )


def the_simulated_sensor_answers(subject: SensorUnderTest, name: str) -> None:
    """Check that the simulated sensor sends the documented reply before the timeout."""
    command = subject.sensor.commands[name]
    if command.frame is None or not command.replies:
        return
    refused = ""
    for share in (0.0, 0.37, 1.0) if command.args else (0.0,):
        try:
            reply = _get_reply(subject, name, make_arguments(subject, name, share))
        except CommandError as error:
            refused = refused or str(error)
            continue
        except SpecError as error:
            if name in subject.sensor.simulation.answers:
                raise
            cause = f"{error.path}: {error.reason}".removeprefix(": ")
            what = f"the reply cannot be simulated without answers= in the Simulation: {cause}"
            raise ViolationError("LS604", what, f"commands.{name}") from error
        require(reply.confirmed, "LS604", "the simulated sensor sends no reply", f"commands.{name}")
        _check_learned_options(subject, name, reply)
        return
    # A sensor whose reply depends on the arguments need not support the tried values.
    decides = callable(subject.sensor.simulation.answers.get(name))
    if not (command.args and decides):
        raise ViolationError("LS604", refused, f"commands.{name}")


def _check_learned_options(subject: SensorUnderTest, name: str, reply: Reply) -> None:
    """Check that the options that are read from a reply are valid for `configure`."""
    sensor = subject.sensor
    try:
        if values := learn_options(sensor, reply):
            sensor.configure(**values)
    except Exception as error:  # any error of `learns` and `configure` of the plugin
        if name in sensor.simulation.answers:
            what = f"the options cannot be read from the reply in `answers`: {error}"
        else:
            what = f"the options cannot be read from the simulated reply: {error}"
        raise ViolationError("LS604", what, f"commands.{name}") from error


def _get_reply(subject: SensorUnderTest, name: str, given: dict[str, float]) -> Reply:
    """Return the reply of a simulated sensor to a command.

    Raises:
        CommandError: if there is no reply, or if the reply does not match.
    """
    command = subject.sensor.commands[name]
    sensor = subject.sensor
    device = SimulatedDevice(sensor)
    session = Session(sensor)
    device.start(0)
    stops = next(
        (
            command_name
            for command_name, other in sensor.commands.items()
            if other.stops and other.frame is not None and not other.args
        ),
        "",
    )
    if command.only_stopped and stops:
        device.receive(sensor.command(stops), 0, sensor.commands[stops].link)
    now = 0
    if command.needed:
        for earlier in sensor.on_open:
            if earlier != name and sensor.commands[earlier].provides is not None:
                now = _run_exchange(device, session, session.request(earlier, now), earlier, now)
    pending = session.request(name, now, **given)
    _run_exchange(device, session, pending, name, now)
    return pending.result()


def _run_exchange(
    device: SimulatedDevice, session: Session, pending: PendingReply, name: str, now: int
) -> int:
    """Run a simulated device until it has replied; return the simulated time in ns."""
    sensor = session.sensor
    link = sensor.commands[name].link
    decoder = sensor.decoder(stream=not is_datagram(sensor.links[link]))
    while not pending.done:
        for out in session.take_outgoing():
            device.receive(out.data, now, out.link)
        now += STEP_NS
        received = [data for arrived, data in device.outgoing(now) if arrived == link]
        if received:
            frames = [item for data in received for item in decoder.feed(data)]
        else:
            frames = decoder.idle()
        session.receive(frames, now, link=link)
        session.tick(now)
    return now
