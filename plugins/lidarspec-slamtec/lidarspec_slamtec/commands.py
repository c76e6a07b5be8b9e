"""What can be asked of an RPLIDAR, and how its motor is driven: by the line DTR, by PWM or by a
speed.

Source: RPLIDAR interface protocol, "requests"; how long to wait after them and the motor's commands
from the vendor's SDK (sl_lidar_driver.cpp). While scan data is sent, what asks for information is
not answered; another scan begins anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lidarspec.spec import Command
from lidarspec_slamtec import answers

AFTER_STOP = 0.1  # seconds (SDK; the protocol asks for at least 1 ms)
AFTER_RESET = 0.002  # seconds (protocol)
AFTER_MOTOR = 0.5  # seconds (SDK, startMotor)
FULL_DUTY = 1023
USUAL_DUTY = 660  # SDK, MAX_MOTOR_PWM and DEFAULT_MOTOR_PWM
USUAL_SPEED = 600  # rpm: 10 turns a second (data sheets of S2 and C1)


#: the descriptors that announce capsules (SDK, startScanExpress).
CAPSULES = (
    "express_descriptor",
    "ultra_descriptor",
    "dense_descriptor",
    "ultra_dense_descriptor",
    "hq_descriptor",
)
ANY_KEY = ("key", 0, 0xFFFF_FFFF)


def plain(cmd: int, **more: Any) -> Command:
    """Return a request without payload."""
    return Command("request", {"cmd.number": cmd}, **more)


def asking(
    frame: str, reply: str | tuple[str, ...], values: Mapping[str, int] | None = None, **more: Any
) -> Command:
    """A request with a reply; it does no harm twice: what a sensor is stays the same, and a scan
    begins anew.
    """
    return Command(
        frame, values or {}, reply=reply, retries=1, only_stopped=not more.get("starts"), **more
    )


def about_sensor(key: int) -> Command:
    """Return the request for a configuration value of the sensor."""
    return asking("config_request", "config", {"key": key}, echoes=("key",))


def about_mode(key: int) -> Command:
    """Return the request for a configuration value of one of its scan modes."""
    return asking(
        "mode_config_request",
        "config",
        {"key": key},
        args={"mode": ("mode", 0, 0xFFFF)},
        echoes=("key",),
    )


def express(mode: int | None = None) -> Command:
    """Return the request for capsules: of one scan mode, or of the one that is given as argument.

    Which descriptor answers depends on the mode; get_answer_type tells.
    """
    values = {"flags": 0, "param": 0} | ({} if mode is None else {"mode": mode})
    args = {"mode": ("mode", 0, 0xFF)} if mode is None else {}
    return asking("express_request", CAPSULES, values, args=args, starts=True)


COMMANDS = {
    "stop": plain(0x25, settle=AFTER_STOP, stops=True),
    "reset": plain(0x40, settle=AFTER_RESET, stops=True),
    "scan": asking("request", "scan_descriptor", {"cmd.number": 0x20}, starts=True),
    "force_scan": asking("request", "scan_descriptor", {"cmd.number": 0x21}, starts=True),
    "express_scan": express(),
    "get_info": asking("request", "info", {"cmd.number": 0x50}),
    "get_health": asking("request", "health", {"cmd.number": 0x52}),
    "get_samplerate": asking("request", "sample_rate", {"cmd.number": 0x59}),
    "get_config": asking("config_request", "config", args={"key": ANY_KEY}, echoes=("key",)),
    "get_mode_config": asking(
        "mode_config_request",
        "config",
        args={"key": ANY_KEY, "mode": ("mode", 0, 0xFFFF)},
        echoes=("key",),
    ),
    "get_mode_count": about_sensor(answers.MODE_COUNT),
    "get_typical_mode": about_sensor(answers.TYPICAL_MODE),
    "get_us_per_sample": about_mode(answers.US_PER_SAMPLE),
    "get_max_distance": about_mode(answers.MAX_DISTANCE),
    "get_answer_type": about_mode(answers.ANSWER_TYPE),
    "get_mode_name": about_mode(answers.MODE_NAME),
}

BY_DTR = {
    "start_motor": Command(lines={"dtr": False}, settle=AFTER_MOTOR),
    "stop_motor": Command(lines={"dtr": True}),
}
BY_PWM = {
    "start_motor": Command("pwm_request", {"duty": USUAL_DUTY}, settle=AFTER_MOTOR),
    "stop_motor": Command("pwm_request", {"duty": 0}),
    "motor_duty": Command("pwm_request", args={"duty": ("duty", 0, FULL_DUTY)}),
    "get_accessory": asking("accessory_request", "accessory", {"reserved": 0}),
}
BY_SPEED = {
    "start_motor": Command("rpm_request", {"speed": USUAL_SPEED}, settle=AFTER_MOTOR),
    "stop_motor": Command("rpm_request", {"speed": 0}),
    "motor_speed": Command("rpm_request", args={"speed": ("speed", 0, 0xFFFF)}),
}
