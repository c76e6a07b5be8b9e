"""Tests of `Session` with a simulated clock: matching replies, sending and timeouts."""

from __future__ import annotations

import dataclasses
import heapq
import random
from collections.abc import Sequence

import pytest
from construct import Array, Float32l, Float64l, Int8ul, Int16ul, Struct

import lidarspec as ls
from lidarspec import CommandError, Found, Sensor, Session, UsageError
from lidarspec.device.session import Reply
from lidarspec.errors import OutOfRange, ReplyTimeout, UnknownCommand, UnknownField
from lidarspec.framing.frame_engine import get_codec
from lidarspec.spec import Command, Count, Frame, Scaled, Udp
from tests.shapes.commands import SENSOR
from tests.shapes.conversation import SENSOR as CONVERSATION

SECOND = 1_000_000_000


def with_commands(sensor: Sensor = SENSOR, **commands: Command) -> Sensor:
    return dataclasses.replace(sensor, commands={**sensor.commands, **commands})


def ack(code: int, result: int = 0) -> Found:
    return Found("ack", 0, SENSOR.build("ack", code=code, result=result))


def list_sent_messages(session: Session) -> list[str]:
    """Return the messages that are sent now, as hexadecimal bytes."""
    return [one.data.hex() for one in session.take_outgoing()]


def receive(sensor: Sensor, session: Session, data: bytes, now: int) -> None:
    decoder = sensor.decoder()
    session.receive(decoder.feed(data) + decoder.idle(), now)


def test_a_reply_prints_the_decimals_of_its_fields() -> None:
    struct = Struct(
        "angle" / Scaled(Int16ul, 0.088, "deg"),
        "distances" / Array(2, Scaled(Int16ul, 0.001, "m")),
        "count" / Int8ul,
        "time" / Scaled(Float64l, 1, "s"),
        "gain" / Float32l,
    )
    frame = Frame(struct)
    fields = {info.path: info for info in get_codec(frame).schema.fields.values()}
    floats = Float64l.build(1_700_000_000.1) + Float32l.build(0.1)
    values = frame.prepared.parse(bytes.fromhex("ff01de07e80302") + floats)
    reply = Reply("ask", "ack", values, confirmed=True, at=0, fields=fields)
    assert repr(reply) == (
        "Reply(ask, ack: angle 44.968 deg, distances [2.014, 1.000] m, count 2,"
        " time 1700000000.1 s, gain 0.1)"
    )


def test_the_reply_is_found_among_data_and_fillers_and_has_its_values() -> None:
    sensor = ls.sensor("cspc-m1c1-mini")
    session = Session(sensor)
    pending = session.request("start", 0)
    assert list_sent_messages(session) == ["aa55f00f"]
    assert not pending.done
    receive(
        sensor,
        session,
        b"\xfe\xff\xfe" + sensor.example("data") + b"\xff" + sensor.example("info"),
        10,
    )
    assert not pending.done
    receive(
        sensor,
        session,
        b"\xfe" + bytes.fromhex("a55a500703000000000000ab") + sensor.example("data"),
        20,
    )
    reply = pending.result()
    assert (reply.command, reply.frame, reply.confirmed, reply.at) == ("start", "ack", True, 20)
    assert (reply.values.firmware, reply["firmware"], reply["mode"]) == (3, 3, 0x50)
    assert (
        repr(reply)
        == f"Reply(start, ack: mode start (0x50), firmware 3, reserved {bytes(6)!r}, checksum 171)"
    )
    with pytest.raises(UnknownField):
        reply["firmwar"]
    assert session.deadline is None


def test_an_answer_in_units_and_in_arrays() -> None:
    sensor = ls.sensor("slamtec-rplidar-a1")
    session = Session(sensor)
    pending = session.request("get_us_per_sample", 0, mode=1)
    answer = sensor.build(
        "config", {"descriptor": {"length": 8}, "key": 0x71, "value": {"us_per_sample": 127 * 256}}
    )
    session.receive([Found("config", 0, answer)], 1)
    assert (
        pending.result()["value.us_per_sample"],
        pending.result().values.value.us_per_sample,
    ) == (127.0, 32512)


def test_what_is_not_documented_is_not_confirmed() -> None:
    session = Session(SENSOR)
    reply = session.request("stop", 5).result()
    assert (reply.confirmed, reply.frame, reply.values, reply.at) == (False, None, None, 5)
    assert len(session.take_outgoing()) == 1
    assert session.take_outgoing() == []


def test_lines_are_moved_without_a_byte() -> None:
    session = Session(SENSOR)
    assert not session.request("spin", 0).result().confirmed
    (out,) = session.take_outgoing()
    assert (out.link, out.data, dict(out.lines)) == ("data", b"", {"dtr": True})


def test_a_wrong_request_sends_nothing() -> None:
    session = Session(SENSOR)
    with pytest.raises(OutOfRange):
        session.request("speed", 0, rate=20.1, trim=0)
    with pytest.raises(UnknownField):
        session.request("speed", 0, rate=10, trim=0, turbo=1)
    with pytest.raises(UnknownCommand):
        session.request("spede", 0)
    assert session.take_outgoing() == []
    assert session.deadline is None
    assert not session.busy


def test_requests_go_out_one_at_a_time_and_after_the_settling() -> None:
    session = Session(SENSOR)
    first, second, third = (
        session.request("start", 0),
        session.request("stop", 0),
        session.request("speed", 0, rate=10.0, trim=0),
    )
    assert len(session.take_outgoing()) == 1
    session.receive([ack(1)], 300)
    assert first.done
    assert second.done
    assert len(session.take_outgoing()) == 1
    assert session.deadline == 300 + SECOND // 10  # stop settles for 0.1 s
    session.tick(session.deadline - 1)
    assert session.take_outgoing() == []
    session.tick(session.deadline)
    assert len(session.take_outgoing()) == 1
    session.receive([ack(3)], session.deadline or 0)
    assert third.result()["code"] == 3


def test_a_timeout_frees_the_link() -> None:
    session = Session(SENSOR)
    first = session.request("start", 0)
    second = session.request("stop", 0)
    assert session.deadline == SECOND
    session.tick(SECOND - 1)
    assert not first.done
    with pytest.raises(UsageError, match="has no reply yet"):
        first.result()
    session.tick(SECOND)
    with pytest.raises(
        TimeoutError, match=r"shape-commands start: no ack frame received within 1 s"
    ) as caught:
        first.result()
    assert isinstance(caught.value, ReplyTimeout)
    assert second.done
    assert session.started is False


def test_the_caller_can_wait_longer_or_shorter() -> None:
    session = Session(SENSOR)
    session.request("start", 0, timeout=0.25)
    assert session.deadline == SECOND // 4
    session = Session(
        with_commands(
            ask=Command(
                "order", SENSOR.commands["start"].values, reply="ack", timeout=0.1, retries=2
            )
        )
    )
    session.request("ask", 0, timeout=0.15)
    session.tick(SECOND // 10)
    assert len(session.take_outgoing()) == 2
    assert session.deadline == 150_000_000  # not sent a third time


def test_a_repeatable_command_is_retried_then_fails() -> None:
    session = Session(
        with_commands(
            ask=Command(
                "order", SENSOR.commands["start"].values, reply="ack", timeout=0.1, retries=2
            )
        )
    )
    pending = session.request("ask", 0)
    for now in (0, 100_000_000, 200_000_000):
        session.tick(now)
        assert len(session.take_outgoing()) == 1
    session.tick(300_000_000)
    with pytest.raises(ReplyTimeout, match=r"within 0\.3 s, sent 3 times"):
        pending.result()
    assert session.take_outgoing() == []


def test_a_late_answer_is_not_the_next_ones() -> None:
    session = Session(SENSOR)
    session.request("start", 0)
    session.tick(SECOND)
    again = session.request("start", SECOND + 1)
    # The second command waits, because the reply to the first could be taken for its reply.
    assert len(session.take_outgoing()) == 1
    session.receive([ack(1)], SECOND + 2)
    assert not again.done
    assert session.late == 1
    assert len(session.take_outgoing()) == 1
    session.receive([ack(1)], SECOND + 3)
    assert again.result().at == SECOND + 3
    assert session.late == 1


def test_a_missing_reply_delays_the_next_command_for_a_limited_time() -> None:
    session = Session(SENSOR)
    session.request("start", 0)
    session.tick(SECOND)
    again = session.request("start", SECOND)
    session.take_outgoing()
    assert session.deadline == 2 * SECOND
    session.tick(2 * SECOND)
    assert len(session.take_outgoing()) == 1
    session.receive([ack(1)], 2 * SECOND + 1)
    assert again.done
    assert session.late == 0


def test_distinguishable_replies_do_not_delay_commands() -> None:
    session = Session(SENSOR)
    session.request("start", 0)
    session.tick(SECOND)
    other = session.request("speed", SECOND, rate=10.0, trim=0.0)
    assert len(session.take_outgoing()) == 2
    session.receive([ack(1)], SECOND + 1)
    assert session.late == 1
    assert not other.done
    session.receive([ack(3)], SECOND + 2)
    assert other.done


def test_the_second_reply_to_a_retried_command_is_ignored() -> None:
    session = Session(
        with_commands(ask=Command("order", SENSOR.commands["start"].values, reply="ack", retries=1))
    )
    first = session.request("ask", 0)
    session.tick(SECOND)
    session.receive([ack(1, result=1)], SECOND + 1)
    assert first.result()["result"] == 1
    second = session.request("ask", SECOND + 2)
    session.receive([ack(1, result=2)], SECOND + 3)
    assert not second.done
    session.receive([ack(1, result=3)], SECOND + 4)
    assert second.result()["result"] == 3
    assert session.late == 1


def test_a_frame_that_came_before_the_request_is_no_answer_to_it() -> None:
    session = Session(SENSOR)
    session.receive([ack(1)], 90)
    pending = session.request("start", 100)
    session.receive([ack(1)], 99)
    assert not pending.done
    session.receive([ack(1)], 101)
    assert pending.done


def test_an_unexpected_reply_is_reported() -> None:
    session = Session(SENSOR)
    pending = session.request("speed", 0, rate=10.0, trim=0.0)
    session.receive([ack(3, result=7)], 1)
    session.tick(SECOND)
    with pytest.raises(
        CommandError, match=r"unexpected reply: ack with result 7 instead of 0"
    ) as error:
        pending.result()
    assert not isinstance(error.value, ReplyTimeout)


def test_links_do_not_wait_for_each_other() -> None:
    sensor = dataclasses.replace(
        SENSOR,
        links={**SENSOR.links, "control": Udp(7000)},
        commands={
            **SENSOR.commands,
            "ask": Command("order", SENSOR.commands["start"].values, reply="ack", link="control"),
        },
    )
    session = Session(sensor)
    start, ask = session.request("start", 0), session.request("ask", 0)
    assert [out.link for out in session.take_outgoing()] == ["data", "control"]
    assert (
        session.awaited_frames(),
        session.awaited_frames("control"),
        session.awaited_frames("none"),
    ) == (
        frozenset({"ack"}),
        frozenset({"ack"}),
        frozenset(),
    )
    session.receive([ack(1)], 1, link="control")
    assert (start.done, ask.done) == (False, True)
    session.receive([ack(1)], 2)
    assert start.done


def test_one_of_several_frames_may_answer() -> None:
    sensor = ls.sensor("slamtec-rplidar-s2")
    session = Session(sensor)
    pending = session.request("express_scan", 0, mode=2)
    session.receive([Found("dense_descriptor", 0, sensor.build("dense_descriptor"))], 1)
    assert pending.result().frame == "dense_descriptor"


def test_echoed_fields_distinguish_replies() -> None:
    sensor = ls.sensor("slamtec-rplidar-a1")
    session = Session(sensor)
    session.request("get_config", 0, key=0x70, timeout=1)
    session.tick(SECOND)
    pending = session.request("get_config", SECOND, key=0x7C)
    assert len(session.take_outgoing()) == 2  # the answer to another key is no danger
    for key, name in ((0x70, "mode_count"), (0x7C, "typical_mode")):
        answer = sensor.build(
            "config", {"descriptor": {"length": 6}, "key": key, "value": {name: 3}}
        )
        session.receive([Found("config", 0, answer)], SECOND + key)
    assert pending.result()["value.typical_mode"] == 3
    assert session.late == 1


def test_a_heartbeat_continues_until_it_is_abandoned() -> None:
    session = Session(
        with_commands(beat=Command("order", SENSOR.commands["start"].values, every=1.0))
    )
    session.request("beat", 0)
    for second in (1, 2, 3):
        assert session.deadline == second * SECOND
        session.take_outgoing()
        session.tick(second * SECOND)
        assert len(session.take_outgoing()) == 1
    session.abandon("closed")
    session.tick(9 * SECOND)
    assert session.take_outgoing() == []
    assert session.deadline is None


def test_a_heartbeat_without_an_answer_does_not_pile_up() -> None:
    values = SENSOR.commands["start"].values
    session = Session(
        with_commands(beat=Command("order", values, reply="ack", matches={"code": 1}, every=0.1))
    )
    first = session.request("beat", 0)
    for step in range(1, 10):
        session.tick(step * SECOND // 10)
    assert len(session.take_outgoing()) == 1
    assert not first.done


def test_abandoning_frees_the_link_at_once() -> None:
    session = Session(SENSOR)
    first, second = session.request("start", 0), session.request("start", 0)
    session.abandon("the link was lost")
    for pending in (first, second):
        with pytest.raises(CommandError, match="the link was lost"):
            pending.result()
    assert len(session.take_outgoing()) == 1
    assert session.request("stop", 1).done
    assert not session.busy


def test_it_is_known_whether_the_sensor_was_started() -> None:
    session = Session(SENSOR)
    session.request("start", 0)
    assert session.started
    session.receive([ack(1)], 1)
    session.request("stop", 2)
    assert not session.started


def test_an_argument_cannot_be_called_like_the_time_to_wait() -> None:
    with pytest.raises(ls.SpecError, match="timeout"):
        with_commands(ask=Command("order", {"code": 1}, args={"timeout": ("motor.speed", 0, 1)}))


@pytest.mark.parametrize(
    "seed", [*range(6), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(6, 40))]
)
def test_late_and_lost_replies_never_match_another_request(seed: int) -> None:
    """The device numbers the requests in its replies, so a wrong match is visible."""
    source = random.Random(seed)
    values = SENSOR.commands["start"].values
    sensor = with_commands(
        once=Command("order", values, reply="ack", timeout=0.1),
        twice=Command("order", values, reply="ack", timeout=0.1, retries=1),
        other=Command(
            "order", {**values, "code": 2}, reply="ack", matches={"code": 2}, timeout=0.1
        ),
    )
    session = Session(sensor)
    coming: list[tuple[int, int, int]] = []
    now, right = 0, 0
    for number in range(60):
        name = source.choice(("once", "twice", "other"))
        pending = session.request(name, now)
        while not pending.done:
            for out in session.take_outgoing():
                if source.random() < 0.8:
                    delay = source.choice((10, 90, 110, 150, 199)) * SECOND // 1000
                    heapq.heappush(
                        coming, (now + delay, number, sensor.parse(out.data, "order").code)
                    )
            now, due = _next_event(session, coming, now)
            session.receive([ack(code, result=asked) for _, asked, code in due], now)
            session.tick(now)
        try:
            assert pending.result()["result"] == number
            right += 1
        except ReplyTimeout:
            pass
    assert right > 20
    assert session.late > 0


def _next_event(
    session: Session, coming: list[tuple[int, int, int]], now: int
) -> tuple[int, Sequence[tuple[int, int, int]]]:
    """Return the time of the next reply or deadline, and the replies at that time."""
    times = [
        time for time in (session.deadline, coming[0][0] if coming else None) if time is not None
    ]
    now = max(now, min(times))
    due = []
    while coming and coming[0][0] <= now:
        due.append(heapq.heappop(coming))
    return now, due


def test_a_command_for_a_stopped_sensor_gives_that_reason() -> None:
    asking = dataclasses.replace(SENSOR.commands["start"], starts=False, only_stopped=True)
    session = Session(with_commands(ask=asking))
    pending = session.request("ask", 0)
    session.tick(10 * SECOND)
    with pytest.raises(
        ReplyTimeout, match="the sensor replies only while it is stopped: send 'stop' first"
    ):
        pending.result()
    with pytest.raises(ls.SpecError, match="requires that one of the sensor's commands"):
        dataclasses.replace(SENSOR, commands={"ask": asking}, on_open=(), on_close=())


def read_request(session: Session) -> list[tuple[int, list[int]]]:
    """Return the sequence number and the address of the request that is sent now."""
    sent = [CONVERSATION.parse(one.data, "order") for one in session.take_outgoing()]
    return [(one.head.number, list(one.host)) for one in sent]


def test_a_running_number_identifies_the_reply() -> None:
    hello = dataclasses.replace(CONVERSATION.commands["hello"], retries=1)
    counting = {**hello.values, "head.number": Count(3, 6)}
    sensor = dataclasses.replace(
        CONVERSATION,
        commands={**CONVERSATION.commands, "hello": dataclasses.replace(hello, values=counting)},
    )
    session = Session(sensor)
    session.host = "10.0.0.7"

    def answered(number: int, now: int) -> None:
        session.receive(
            [Found("ack", 0, sensor.build("ack", head={"number": number, "code": 1}, result=0))],
            now,
            link="control",
        )

    first = session.request("hello", 0)
    assert read_request(session) == [(6, [10, 0, 0, 7])]
    session.tick(SECOND)
    assert read_request(session) == [(6, [10, 0, 0, 7])], "sent once more, it is the same request"
    session.tick(2 * SECOND)
    with pytest.raises(ReplyTimeout):
        first.result()
    second = session.request("hello", 2 * SECOND)
    assert read_request(session) == [(7, [10, 0, 0, 7])]
    answered(6, 2 * SECOND + 1)  # which is late
    assert (second.done, session.late) == (False, 1)
    answered(7, 2 * SECOND + 2)
    assert second.result().values.head.number == 7
    session.request("hello", 3 * SECOND)
    assert [number for number, _ in read_request(session)] == [0], "it has three bits"


def test_values_that_are_found_out_can_be_given() -> None:
    assert CONVERSATION.parse(CONVERSATION.command("hello"), "order").head.number == 7
    given = CONVERSATION.parse(
        CONVERSATION.command("hello", **{"head.number": 9, "host": "1.2.3.4"}), "order"
    )
    assert (given.head.number, list(given.host)) == (9, [1, 2, 3, 4])
    with pytest.raises(UsageError, match="host must be an IPv4 address, not '::1'"):
        CONVERSATION.command("hello", host="::1")


def test_a_late_refusal_does_not_fail_the_next_command() -> None:
    refused = Command(
        "order",
        {"code": 3, "motor.speed": 0, "motor.trim": 0},
        reply="data",
        refusal="ack",
        timeout=1.0,
        retries=1,
    )
    session = Session(with_commands(ask=refused))
    first = session.request("ask", 0)
    session.receive([ack(1, result=2)], 1)
    assert (str(first.failure), session.late) == (
        "shape-commands ask: the sensor refused the command: Reply(ask, ack: code 1, result 2,"
        " check 101)",
        0,
    )
    second = session.request("ask", 2)
    session.tick(2 + SECOND)  # sent once more
    session.receive([ack(1)], 3 + SECOND)
    third = session.request("ask", 4 + SECOND)
    session.tick(4 + SECOND)
    assert (second.failure is not None, third.done) == (True, False)
    session.receive([ack(1)], 5 + SECOND)  # of what was sent once more
    assert (third.done, session.late) == (False, 1)
    session.receive([ack(1)], 6 + SECOND)
    assert third.failure is not None


def test_a_refusal_of_another_request_is_ignored() -> None:
    asked = Command(
        "order",
        {"code": 3, "motor.speed": 0, "motor.trim": 0},
        reply="data",
        refusal="ack",
        echoes=("code", "motor.trim"),
        timeout=1.0,
    )
    session = Session(with_commands(ask=asked))
    first = session.request("ask", 0)
    session.receive([ack(9)], 1)
    assert not first.done
    session.tick(SECOND)
    second = session.request("ask", SECOND)
    session.receive([ack(9)], SECOND + 1)
    assert (session.late, second.done) == (0, False)
    session.receive([ack(3)], SECOND + 2)  # of the first request
    assert (session.late, second.done) == (1, False)
    session.receive([ack(3)], SECOND + 3)  # a refusal has no field motor.trim
    assert second.failure is not None
    assert "refused" in str(second.failure)
