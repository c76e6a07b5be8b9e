"""The commands of an RPLIDAR, and the control of its motor by DTR, PWM or speed.

Source: RPLIDAR interface protocol, "requests"; the delays after requests, and the commands for the
motor, are from the vendor's SDK (sl_lidar_driver.cpp). While it sends scan data, a sensor does not
reply to requests for information. A request for a scan starts a new stream.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lidarspec.spec import Command
from lidarspec_slamtec import answers

STOP_DELAY_S = 0.1  # SDK; the protocol requires at least 1 ms
RESET_DELAY_S = 0.002  # protocol
MOTOR_START_DELAY_S = 0.5  # SDK, startMotor
MAX_DUTY = 1023  # SDK, MAX_MOTOR_PWM
DEFAULT_DUTY = 660  # SDK, DEFAULT_MOTOR_PWM
DEFAULT_SPEED_RPM = 600  # data sheets of S2 and C1

#: The descriptors that announce capsules (SDK, startScanExpress).
CAPSULE_DESCRIPTORS = (
    "express_descriptor",
    "ultra_descriptor",
    "dense_descriptor",
    "ultra_dense_descriptor",
    "hq_descriptor",
)
ANY_KEY = ("key", 0, 0xFFFF_FFFF)


def make_plain_request(cmd: str, **more: Any) -> Command:
    """Return the command that sends a request without payload and expects no reply."""
    return Command("request", {"cmd.number": cmd}, **more)


def make_request(
    frame: str, reply: str | tuple[str, ...], values: Mapping[str, Any] | None = None, **more: Any
) -> Command:
    """Return a command that sends a request, and repeats it if no reply arrives.

    Args:
        frame: the frame type of the request.
        reply: the frame types of possible replies.
        values: the field values of the request.
        more: other arguments of `Command`.
    """
    return Command(
        frame, values or {}, reply=reply, retries=1, only_stopped=not more.get("starts"), **more
    )


def make_sensor_request(key: int) -> Command:
    """Return the command that requests a configuration value of the sensor."""
    return make_request("config_request", "config", {"key": key}, echoes=("key",))


def make_mode_request(key: int) -> Command:
    """Return the command that requests a configuration value of a scan mode."""
    return make_request(
        "mode_config_request",
        "config",
        {"key": key},
        args={"mode": ("mode", 0, 0xFFFF)},
        echoes=("key",),
    )


def make_express_request(mode: int | None = None) -> Command:
    """Return the command that requests capsules of one scan mode.

    If `mode` is None, the mode is an argument of the command.
    """
    values = {"flags": 0, "param": 0} | ({} if mode is None else {"mode": mode})
    args = {"mode": ("mode", 0, 0xFF)} if mode is None else {}
    return make_request("express_request", CAPSULE_DESCRIPTORS, values, args=args, starts=True)


COMMANDS = {
    "stop": make_plain_request("stop", settle=STOP_DELAY_S, stops=True),
    "reset": make_plain_request("reset", settle=RESET_DELAY_S, stops=True),
    "scan": make_request("request", "scan_descriptor", {"cmd.number": "scan"}, starts=True),
    "force_scan": make_request(
        "request", "scan_descriptor", {"cmd.number": "force_scan"}, starts=True
    ),
    "express_scan": make_express_request(),
    "get_info": make_request("request", "info", {"cmd.number": "get_info"}),
    "get_health": make_request("request", "health", {"cmd.number": "get_health"}),
    "get_samplerate": make_request("request", "sample_rate", {"cmd.number": "get_samplerate"}),
    "get_config": make_request("config_request", "config", args={"key": ANY_KEY}, echoes=("key",)),
    "get_mode_config": make_request(
        "mode_config_request",
        "config",
        args={"key": ANY_KEY, "mode": ("mode", 0, 0xFFFF)},
        echoes=("key",),
    ),
    "get_mode_count": make_sensor_request(answers.MODE_COUNT),
    "get_typical_mode": make_sensor_request(answers.TYPICAL_MODE),
    "get_us_per_sample": make_mode_request(answers.US_PER_SAMPLE),
    "get_max_distance": make_mode_request(answers.MAX_DISTANCE),
    "get_answer_type": make_mode_request(answers.ANSWER_TYPE),
    "get_mode_name": make_mode_request(answers.MODE_NAME),
}

BY_DTR = {
    "start_motor": Command(lines={"dtr": False}, settle=MOTOR_START_DELAY_S),
    "stop_motor": Command(lines={"dtr": True}),
}
BY_PWM = {
    "start_motor": Command("pwm_request", {"duty": DEFAULT_DUTY}, settle=MOTOR_START_DELAY_S),
    "stop_motor": Command("pwm_request", {"duty": 0}),
    "motor_duty": Command("pwm_request", args={"duty": ("duty", 0, MAX_DUTY)}),
    "get_accessory": make_request("accessory_request", "accessory", {"reserved": 0}),
}
BY_SPEED = {
    "start_motor": Command("rpm_request", {"speed": DEFAULT_SPEED_RPM}, settle=MOTOR_START_DELAY_S),
    "stop_motor": Command("rpm_request", {"speed": 0}),
    "motor_speed": Command("rpm_request", args={"speed": ("speed", 0, 0xFFFF)}),
}
