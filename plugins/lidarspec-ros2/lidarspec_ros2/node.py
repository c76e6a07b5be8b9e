"""The lifecycle node: a sensor opened on configuring, published while active, closed on cleaning
up.

One thread reads the device and publishes what comes. The executor's thread serves transitions,
parameters and commands, and does what the reading thread asks for: to say once a second how the
sensor is doing, and to be inactive while it is gone.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter as RosParameter
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from lidarspec.device.device import Device
from lidarspec.errors import LidarSpecError, UsageError, did_you_mean, suggestion
from lidarspec.explaining.assignments import parse_arguments
from lidarspec.explaining.explanation import reply_text
from lidarspec.view.live_scans import LOOK_S, LiveScans
from lidarspec.view.rate_meter import MeterReading
from lidarspec_ros2.diagnostics import LOST, make_status
from lidarspec_ros2.packets import PacketLog
from lidarspec_ros2.parameters import NAMED, NODE_NAME, PARAMETERS, Parameter, Settings
from lidarspec_ros2.topics import Topics

#: seconds between two diagnostics.
SECOND = 1.0
#: seconds by which the end of a scan is looked for too early, and for which it is looked for; which
#: what an IMU felt may wait.
EARLY, LATE, SOON = 0.003, 0.02, 0.01


class LidarNode(LifecycleNode):
    """A sensor as a node.

    Args:
        given: parameters that come before those of the command line and of files.
        max_cloud_bytes: size of the largest cloud that arrives with best effort; None if unknown.

    Attributes:
        failure: why the node could not be configured, or the sensor cannot be read any more; None
            where it can.
        ended: set when nothing more will come of it by itself.
        opening: whether it waits for a sensor to be found, and to answer.

    Raises:
        UsageError: for a parameter that cannot be.
    """

    def __init__(self, given: Mapping[str, Any], *, max_cloud_bytes: int | None = None) -> None:
        super().__init__(
            NODE_NAME,
            parameter_overrides=[RosParameter(name, value=value) for name, value in given.items()],
        )
        self._max_cloud_bytes = max_cloud_bytes
        self.failure: Exception | None = None
        self.ended, self.opening = threading.Event(), False
        self._device: Device | None = None
        self._topics: Topics | None = None
        self._thread: threading.Thread | None = None
        self._stopping, self._was_lost = threading.Event(), False
        self._services_of_sensor: list[Any] = []
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        try:
            values = {
                one.name: self.declare_parameter(one.name, one.default, _descriptor(one)).value
                for one in PARAMETERS
            }
            self._settings = Settings(values)
        except (ParameterException, LidarSpecError) as error:
            self.destroy_node()
            raise error if isinstance(error, LidarSpecError) else UsageError(str(error)) from None
        self.add_on_set_parameters_callback(self._set)

    @property
    def autostarts(self) -> bool:
        """Whether it is to be started at once."""
        return bool(self._settings["autostart"])

    def start(self) -> None:
        """Configure and activate.

        Raises:
            LidarSpecError: where it cannot be configured.
        """
        self.trigger_configure()
        if self.failure is not None:
            raise self.failure
        self.trigger_activate()

    def close(self) -> None:
        """Stop reading and give the sensor back; a second call does nothing."""
        self._stopping.set()
        device, self._device = self._device, None
        if device is not None:
            if device.is_live:  # which ends what waits for data
                device.close()
            if self._thread is not None:
                self._thread.join()
            device.close()
        topics, self._topics = self._topics, None
        if topics is not None:
            topics.close()
        for service in self._services_of_sensor:
            self.destroy_service(service)
        self._services_of_sensor.clear()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the sensor, and read it."""
        self.failure = None
        try:
            self._open()
        except Exception as error:  # of which rclpy would say nothing
            self._fail(error)
            self.close()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let through what is published."""
        self._was_lost = False
        if self._topics is not None:
            self._topics.activate(active=True)
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Go on reading, for commands and diagnostics, and publish nothing."""
        if self._topics is not None:
            self._topics.activate(active=False)
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the sensor, and give it back."""
        self.close()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Return the same, and come to the end."""
        self.close()
        self.ended.set()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give the sensor back, so that it can be configured again."""
        self.close()
        return super().on_error(state)

    def _open(self) -> None:
        settings = self._settings
        packets = PacketLog()
        self.opening = True
        try:
            device = self._device = settings.device(lambda opened: packets)
        finally:
            self.opening = False
        topics = self._topics = Topics(
            self,
            settings,
            device.sensor,
            played=not device.is_live,
            max_cloud_bytes=self._max_cloud_bytes,
        )
        packets.publish = topics.publish_packet
        self._serve_commands(device)
        self._warn_of_unknown_parameters()
        self._stopping.clear()
        self._was_lost = False
        self._thread = threading.Thread(
            target=self._read, args=(device, self._topics), name="reading"
        )
        self._thread.start()

    def _read(self, device: Device, topics: Topics) -> None:
        """Publish what comes, until the node is stopped or the input ends."""
        speed = self._settings["replay_speed"]
        feed = LiveScans(
            device, played=speed > 0, speed=speed, ahead=None
        )  # what is read tells of the sensor's clock before it is shown
        due, expected = time.monotonic(), 0.0
        try:
            while not self._stopping.is_set() and not feed.ended:
                feed.read(0.0 if device.is_live else time.monotonic() + LOOK_S)
                self._publish(feed, topics)
                expected = _predict_scan_end(expected, feed)
                device.delay_decoding(
                    min(expected, time.monotonic() + SOON) if device.sensor.imu_frames else expected
                )
                self._watch(device)
                if (now := time.monotonic()) >= due:
                    due = now + SECOND
                    reading = feed.meter.reading(device.stats, SECOND if device.is_live else None)
                    self._call_in_executor(
                        partial(self._publish_diagnostics, device, topics, reading)
                    )
        except Exception as error:
            self._fail(error)
        if not self._stopping.is_set():
            self._call_in_executor(self._end)

    def _publish(self, feed: LiveScans, topics: Topics) -> None:
        if feed.packets is not None and len(feed.packets):
            topics.learn(feed.packets)
        topics.publish_imu(feed.device.imu_samples)
        for scan in feed.scans:
            if scan.whole:
                topics.publish(scan)

    def _watch(self, device: Device) -> None:
        """Have the node be inactive while the sensor is gone, which has been there."""
        is_lost = device.state in LOST and bool(device.stats.frames)
        if is_lost != self._was_lost and (self._was_lost or self._is_active):
            self._call_in_executor(self._lose if is_lost else self._regain)

    @property
    def _is_active(self) -> bool:
        return self._topics is not None and self._topics.active

    def _lose(self) -> None:
        if self._is_active:
            self.trigger_deactivate()
            self._was_lost = True

    def _regain(self) -> None:
        if self._was_lost:
            self.trigger_activate()

    def _publish_diagnostics(self, device: Device, topics: Topics, reading: MeterReading) -> None:
        """Say how the sensor is doing."""
        if device is not self._device:  # which is closed
            return
        more = {
            "lifecycle": "active" if topics.active else "inactive",
            "latency [ms]": f"{topics.latency_s * 1e3:.1f}",
        }
        more |= {f"{topic} sent": str(number) for topic, number in topics.sent.items()}
        clock = topics.stamps.clock
        more |= {
            "clock drift [ppm]": f"{clock.drift_ppm:+.1f}",
            "clock set": f"{clock.jumps} times",
        }
        status = make_status(
            self.get_name(), device, reading, [*filter(None, (clock.jump, topics.fault))], more
        )
        self._diagnostics.publish(
            DiagnosticArray(header=Header(stamp=self.get_clock().now().to_msg()), status=[status])
        )

    def _call_in_executor(self, callback: Callable[[], Any]) -> None:
        """Have something done in the thread of the executor."""
        if self.executor is not None:
            self.executor.create_task(callback)

    def _end(self) -> None:
        """The input has come to its end, or cannot be read any more."""
        if self._is_active:
            self.trigger_deactivate()
        if self.failure is not None:
            self.trigger_cleanup()
        if self.autostarts:
            self.ended.set()

    def _fail(self, error: Exception) -> None:
        self.failure = error
        if not self.autostarts:  # else it ends the process, which says so
            following = suggestion(error)
            self.get_logger().error(f"{error}{f'; next: {following}' if following else ''}")

    def _set(self, parameters: Sequence[RosParameter]) -> SetParametersResult:
        """Take parameters that are set at run time, or say why not."""
        ours = {one.name: one.value for one in parameters if one.name in NAMED}
        try:
            for name, value in ours.items():
                if (
                    self._device is not None
                    and not NAMED[name].live
                    and value != self._settings[name]
                ):
                    raise UsageError(
                        f"{name} is read when the node is configured: clean the node up, set it,"
                        " and configure it again"
                    )
            self._settings = Settings({**self._settings.values, **ours})
        except UsageError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if self._topics is not None and ours:
            self._topics.use_settings(self._settings)
        return SetParametersResult(successful=True)

    def _warn_of_unknown_parameters(self) -> None:
        """Say which parameters are given that no node of this sensor has, of which ROS itself says
        nothing.
        """
        for name in self._parameter_overrides:  # which rclpy tells in no other way
            if not self.has_parameter(name) and not name.startswith("qos_overrides."):
                close = did_you_mean(name, [one.name for one in PARAMETERS])
                self.get_logger().warning(f"unknown parameter {name!r} is ignored{close}")

    def _serve_commands(self, device: Device) -> None:
        """A service for each command of the sensor, beside the node's own, such as get_state, and a
        parameter for each of its arguments.
        """
        for name, command in device.sensor.commands.items():
            for argument in command.args:
                if not self.has_parameter(f"{name}.{argument}"):
                    text = (
                        f"Argument of the service {name}, in the unit of its field, or with a unit."
                    )
                    self.declare_parameter(
                        f"{name}.{argument}",
                        None,
                        ParameterDescriptor(description=text, dynamic_typing=True),
                    )
            self._services_of_sensor.append(
                self.create_service(Trigger, f"~/send/{name}", partial(self._send, device, name))
            )

    def _send(
        self, device: Device, name: str, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Send a command, and answer with its reply, or why there is none."""
        given = {
            argument: self.get_parameter(f"{name}.{argument}").value
            for argument in device.sensor.commands[name].args
        }
        try:
            words = [
                f"{argument}={value}" for argument, value in given.items() if value is not None
            ]
            reply = device.send(name, **parse_arguments(device.sensor, name, words))
        except LidarSpecError as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, reply_text(device.sensor, reply)
        return response


def _predict_scan_end(before: float, feed: LiveScans) -> float:
    """When the next scan may end, a time of `time.monotonic`, a little too early; one that is late
    is waited for less eagerly.
    """
    now = time.monotonic()
    for scan in feed.scans:
        if scan.whole and math.isfinite(scan.rate_hz):
            return now + 1 / scan.rate_hz - EARLY
    return before if now - before < LATE else now + LOOK_S


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    described = ParameterDescriptor(description=parameter.text)
    if parameter.low is None or parameter.high is None:
        return described
    if isinstance(parameter.default, float):
        described.floating_point_range = [
            FloatingPointRange(from_value=float(parameter.low), to_value=float(parameter.high))
        ]
    else:
        described.integer_range = [
            IntegerRange(from_value=int(parameter.low), to_value=int(parameter.high), step=1)
        ]
    return described
