"""The lifecycle node.

The node opens the sensor on configure, publishes while it is active, and closes the sensor on
cleanup. One thread reads the device and publishes messages. The executor's thread serves
transitions, parameters and commands, and publishes diagnostics once a second.
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
from lidarspec.explaining.clock_text import describe_clock
from lidarspec.explaining.explanation import format_reply
from lidarspec.packets.clock_monitor import ClockReport
from lidarspec.view.live_scans import LOOK_S, LiveScans
from lidarspec.view.rate_meter import MeterReading
from lidarspec_ros2.clock import describe_jump
from lidarspec_ros2.diagnostics import LOST_STATES, make_status
from lidarspec_ros2.packets import PacketLog
from lidarspec_ros2.parameters import NAMED, NODE_NAME, PARAMETERS, Parameter, Settings
from lidarspec_ros2.topics import Topics

DIAGNOSTICS_PERIOD_S = 1.0
EARLY_WAKE_S = 0.003  # before the expected end of a scan
MAX_SCAN_LATENESS_S = 0.02  # after it, the node waits at its normal pace
MAX_IMU_DELAY_S = 0.01


class LidarNode(LifecycleNode):
    """A sensor as a node.

    Args:
        given: parameters that have priority over parameters of the command line and of files.
        max_cloud_bytes: the largest cloud that reaches subscribers with the reliability "best
            effort", in bytes; None if unknown.

    Attributes:
        failure: the error that prevented the configuration, or that ended reading; None if there
            was no error.
        ended: an event that is set when the node is shut down and, if the node starts
            automatically, when its input has ended or failed.
        opening: whether the node waits for the sensor to be found or to reply.

    Raises:
        UsageError: if a parameter is invalid.
    """

    def __init__(self, given: Mapping[str, Any], *, max_cloud_bytes: int | None = None) -> None:
        super().__init__(
            NODE_NAME,
            parameter_overrides=[RosParameter(name, value=value) for name, value in given.items()],
        )
        self._max_cloud_bytes = max_cloud_bytes
        self.failure: Exception | None = None
        self.ended = threading.Event()
        self.opening = False
        self._device: Device | None = None
        self._topics: Topics | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._was_lost = False
        self._services_of_sensor: list[Any] = []
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        try:
            values = {
                parameter.name: self.declare_parameter(
                    parameter.name, parameter.default, _make_descriptor(parameter)
                ).value
                for parameter in PARAMETERS
            }
            self._settings = Settings(values)
        except (ParameterException, LidarSpecError) as error:
            self.destroy_node()
            raise error if isinstance(error, LidarSpecError) else UsageError(str(error)) from None
        self.add_on_set_parameters_callback(self._apply_parameters)

    @property
    def autostarts(self) -> bool:
        """Whether the node configures and activates itself."""
        return bool(self._settings["autostart"])

    def start(self) -> None:
        """Configure and activate the node.

        Raises:
            LidarSpecError: if the node cannot be configured.
        """
        self.trigger_configure()
        if self.failure is not None:
            raise self.failure
        self.trigger_activate()

    def close(self) -> None:
        """Stop reading and close the sensor; a second call has no effect."""
        self._stopping.set()
        device = self._device
        self._device = None
        if device is not None:
            if device.is_live:  # this ends the reading thread's wait for data
                device.close()
            if self._thread is not None:
                self._thread.join()
            device.close()
        topics = self._topics
        self._topics = None
        if topics is not None:
            topics.close()
        for service in self._services_of_sensor:
            self.destroy_service(service)
        self._services_of_sensor.clear()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the sensor and start to read it, without publishing."""
        self.failure = None
        try:
            self._open()
        except Exception as error:  # rclpy would not report it
            self._fail(error)
            self.close()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to publish the scans, packets and IMU samples that are read."""
        self._was_lost = False
        if self._topics is not None:
            self._topics.set_active(active=True)
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop publishing, but continue to read, for commands and diagnostics."""
        if self._topics is not None:
            self._topics.set_active(active=False)
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop and close the sensor."""
        self.close()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop and close the sensor, and end the node."""
        self.close()
        self.ended.set()
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the sensor, so that it can be configured again."""
        self.close()
        return super().on_error(state)

    def _open(self) -> None:
        settings = self._settings
        packets = PacketLog()
        self.opening = True
        try:
            device = self._device = settings.open_device(lambda opened: packets)
        finally:
            self.opening = False
        topics = self._topics = Topics(
            self,
            settings,
            device.sensor,
            is_file=not device.is_live,
            max_cloud_bytes=self._max_cloud_bytes,
        )
        packets.publish = topics.publish_packet
        self._create_command_services(device)
        self._warn_of_unknown_parameters()
        self._stopping.clear()
        self._was_lost = False
        self._thread = threading.Thread(
            target=self._read, args=(device, self._topics), name="reading"
        )
        self._thread.start()

    def _read(self, device: Device, topics: Topics) -> None:
        """Read the device until the node stops or the input ends.

        Scans and IMU samples are published while the node is active, the diagnostics always.
        """
        speed = self._settings["replay_speed"]
        # `ahead=None`: all data that was read updates the clock before a scan is published.
        feed = LiveScans(device, played=speed > 0, speed=speed, ahead=None)
        next_diagnostics = time.monotonic()
        scan_end = 0.0
        try:
            while not self._stopping.is_set() and not feed.ended:
                feed.read(0.0 if device.is_live else time.monotonic() + LOOK_S)
                self._publish(feed, topics)
                scan_end = _predict_scan_end(scan_end, feed)
                next_decoding = scan_end
                if device.sensor.imu_frames:
                    next_decoding = min(scan_end, time.monotonic() + MAX_IMU_DELAY_S)
                device.delay_decoding(next_decoding)
                self._check_connection(device)
                if (now := time.monotonic()) >= next_diagnostics:
                    next_diagnostics = now + DIAGNOSTICS_PERIOD_S
                    reading = feed.meter.take_reading(
                        device.stats, DIAGNOSTICS_PERIOD_S if device.is_live else None
                    )
                    self._run_in_executor(
                        partial(
                            self._publish_diagnostics, device, topics, reading, feed.clock.report()
                        )
                    )
        except Exception as error:
            self._fail(error)
        if not self._stopping.is_set():
            self._run_in_executor(self._end_input)

    def _publish(self, feed: LiveScans, topics: Topics) -> None:
        if feed.packets is not None and len(feed.packets):
            topics.update_conversion(feed.packets)
        topics.publish_imu(feed.device.imu_samples)
        for scan in feed.scans:
            if scan.whole:
                topics.publish(scan)

    def _check_connection(self, device: Device) -> None:
        """Deactivate the node while a sensor that has sent data is disconnected."""
        is_lost = device.state in LOST_STATES and bool(device.stats.frames)
        if is_lost != self._was_lost and (self._was_lost or self._is_active):
            self._run_in_executor(
                self._handle_disconnection if is_lost else self._handle_reconnection
            )

    @property
    def _is_active(self) -> bool:
        return self._topics is not None and self._topics.active

    def _handle_disconnection(self) -> None:
        if self._is_active:
            self.trigger_deactivate()
            self._was_lost = True

    def _handle_reconnection(self) -> None:
        if self._was_lost:
            self.trigger_activate()

    def _publish_diagnostics(
        self, device: Device, topics: Topics, reading: MeterReading, report: ClockReport
    ) -> None:
        """Publish the state of the sensor on /diagnostics."""
        if device is not self._device:  # the device was closed
            return
        more = {
            "lifecycle": "active" if topics.active else "inactive",
            "latency [ms]": f"{topics.latency_s * 1e3:.1f}",
        }
        more |= {f"{topic} sent": str(number) for topic, number in topics.sent.items()}
        clock = topics.stamps.clock
        more |= {
            "clock": describe_clock(report),
            "clock verdict": report.verdict.code,
            "clock drift [ppm]": f"{clock.drift_ppm:+.1f}",
            "clock changed": f"{clock.jumps} times",
        }
        warnings = [*filter(None, (describe_jump(clock), topics.planar_scan_fault))]
        if self._settings["device_time_is_ros_time"] and report.verdict.is_fault:
            warnings.append(f"the sensor's clock: {report.verdict.text}; {report.verdict.advice}")
        status = make_status(self.get_name(), device, reading, warnings, more)
        self._diagnostics.publish(
            DiagnosticArray(header=Header(stamp=self.get_clock().now().to_msg()), status=[status])
        )

    def _run_in_executor(self, callback: Callable[[], Any]) -> None:
        """Schedule a callback in the thread of the executor."""
        if self.executor is not None:
            self.executor.create_task(callback)

    def _end_input(self) -> None:
        """Deactivate the node after its input has ended or failed."""
        if self._is_active:
            self.trigger_deactivate()
        if self.failure is not None:
            self.trigger_cleanup()
        if self.autostarts:
            self.ended.set()

    def _fail(self, error: Exception) -> None:
        self.failure = error
        if not self.autostarts:  # with autostart the process ends and prints the error
            following = suggestion(error)
            self.get_logger().error(f"{error}{f'; next: {following}' if following else ''}")

    def _apply_parameters(self, parameters: Sequence[RosParameter]) -> SetParametersResult:
        """Apply parameters that are set at run time, or return the reason for a refusal."""
        ours = {
            parameter.name: parameter.value for parameter in parameters if parameter.name in NAMED
        }
        try:
            for name, value in ours.items():
                if (
                    self._device is not None
                    and not NAMED[name].live
                    and value != self._settings[name]
                ):
                    raise UsageError(
                        f"{name} is only read when the node is configured: clean up the node, set"
                        " the parameter, and configure the node again"
                    )
            self._settings = Settings({**self._settings.values, **ours})
        except UsageError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if self._topics is not None and ours:
            self._topics.use_settings(self._settings)
        return SetParametersResult(successful=True)

    def _warn_of_unknown_parameters(self) -> None:
        """Log parameters that this node does not have, because ROS ignores them silently."""
        for name in self._parameter_overrides:  # rclpy has no public way to list them
            if not self.has_parameter(name) and not name.startswith("qos_overrides."):
                close = did_you_mean(name, [parameter.name for parameter in PARAMETERS])
                self.get_logger().warning(f"unknown parameter {name!r} is ignored{close}")

    def _create_command_services(self, device: Device) -> None:
        """Create a service for each command, and a parameter for each of its arguments."""
        for name, command in device.sensor.commands.items():
            for argument in command.args:
                if not self.has_parameter(f"{name}.{argument}"):
                    text = (
                        f"Argument of the service {name}. A number without a unit is in the unit"
                        f" that `lidarspec show {device.sensor.id}` prints for the argument."
                    )
                    self.declare_parameter(
                        f"{name}.{argument}",
                        None,
                        ParameterDescriptor(description=text, dynamic_typing=True),
                    )
            self._services_of_sensor.append(
                self.create_service(
                    Trigger, f"~/send/{name}", partial(self._send_command, device, name)
                )
            )

    def _send_command(
        self, device: Device, name: str, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Send a command, and return its reply or the error in the response."""
        values = {
            argument: self.get_parameter(f"{name}.{argument}").value
            for argument in device.sensor.commands[name].args
        }
        try:
            words = [
                f"{argument}={value}" for argument, value in values.items() if value is not None
            ]
            reply = device.send(name, **parse_arguments(device.sensor, name, words))
        except LidarSpecError as error:
            response.success = False
            response.message = str(error)
        else:
            response.success = True
            response.message = format_reply(device.sensor, reply)
        return response


def _predict_scan_end(expected: float, feed: LiveScans) -> float:
    """Return the time shortly before the expected end of the next scan.

    Until this time, the node need not look for the end of a scan. The time is by `time.monotonic`.

    Args:
        expected: the result of the previous call.
        feed: the scans that were just read; the rate of a complete scan gives the duration of the
            next scan.
    """
    now = time.monotonic()
    for scan in feed.scans:
        if scan.whole and math.isfinite(scan.rate_hz):
            return now + 1 / scan.rate_hz - EARLY_WAKE_S
    return expected if now - expected < MAX_SCAN_LATENESS_S else now + LOOK_S


def _make_descriptor(parameter: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=parameter.text)
    if parameter.low is None or parameter.high is None:
        return descriptor
    if isinstance(parameter.default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(parameter.low), to_value=float(parameter.high))
        ]
    else:
        descriptor.integer_range = [
            IntegerRange(from_value=int(parameter.low), to_value=int(parameter.high), step=1)
        ]
    return descriptor
