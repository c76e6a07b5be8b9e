"""A client of a node that records the messages it receives."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.parameter import Parameter as Value
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.typesys import Stores, get_typestore
from std_srvs.srv import Trigger

#: seconds after which something that has to come is not waited for any longer.
PATIENCE = 30.0
STORE = get_typestore(Stores.ROS2_HUMBLE)


class Client:
    """A client of a node called lidar."""

    def __init__(self) -> None:
        self._node = rclpy.create_node("client")
        self.received: dict[str, list[bytes]] = {}
        self.diagnostics: list[Any] = []
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, 10)

    def listen(
        self,
        topic: str,
        kind: Any,
        *,
        reliable: bool = True,
        take: Callable[[bytes], None] | None = None,
        qos: QoSProfile | None = None,
    ) -> list[bytes]:
        """Subscribe to a topic; return the list of received messages, as bytes.

        A callback receives them instead if given. `qos` replaces `reliable`.
        """
        received = self.received[topic] = list[bytes]()
        if qos is None:
            reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
            qos = QoSProfile(depth=5000, reliability=reliability)
        self._node.create_subscription(kind, topic, take or received.append, qos, raw=True)
        return received

    def until(self, condition: Callable[[], object], *, patience: float = PATIENCE) -> None:
        """Receive messages until the condition holds."""
        end = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < end, f"it did not come about within {patience} s"
            rclpy.spin_once(self._node, timeout_sec=0.05)

    def reliable(self, topic: str) -> list[bool]:
        """Return whether each publisher of a topic is reliable."""
        reliable = ReliabilityPolicy.RELIABLE
        return [
            one.qos_profile.reliability == reliable
            for one in self._node.get_publishers_info_by_topic(topic)
        ]

    def call(self, kind: Any, service: str, **fields: Any) -> Any:
        """Call a service of the node; return its response."""
        client = self._node.create_client(kind, f"/lidar/{service}")
        self.until(client.service_is_ready)
        future = client.call_async(kind.Request(**fields))
        self.until(future.done)
        self._node.destroy_client(client)
        return future.result()

    def change(self, label: str) -> bool:
        """Request a transition; return whether it succeeded."""
        request = ChangeState.Request()
        request.transition.label = label
        return bool(self.call(ChangeState, "change_state", transition=request.transition).success)

    @property
    def state(self) -> str:
        """Return the lifecycle state."""
        return str(self.call(GetState, "get_state").current_state.label)

    def set(self, name: str, value: Any) -> str:
        """Set a parameter; return the reason if it was refused, otherwise ""."""
        parameter: Parameter = Value(name, value=value).to_parameter_msg()
        (result,) = self.call(SetParameters, "set_parameters", parameters=[parameter]).results
        assert result.successful == (not result.reason)
        return str(result.reason)

    def value(self, name: str) -> Any:
        """Return the value of a parameter."""
        (value,) = self.call(GetParameters, "get_parameters", names=[name]).values
        return Value.from_parameter_msg(Parameter(name=name, value=value)).value

    def describe_parameters(self, *names: str) -> list[Any]:
        """Return the descriptors of parameters."""
        return list(
            self.call(DescribeParameters, "describe_parameters", names=list(names)).descriptors
        )

    def trigger(self, name: str) -> Any:
        """Call a command's service; return its response."""
        return self.call(Trigger, f"send/{name}")

    def close(self) -> None:
        self._node.destroy_node()


#: parameters with which planar scans are on one grid, whichever scan comes first.
GRID: dict[str, Any] = {"beams": 720, "angle_min": -3.0, "angle_max": 3.0}


def format_parameters(**parameters: Any) -> list[str]:
    """Return parameters as ROS arguments."""
    return [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]


def message(data: bytes, kind: str) -> Any:
    """Return a message as rosbags reads it."""
    return STORE.deserialize_cdr(data, kind)


def end_node(process: subprocess.Popen[str], by: int = signal.SIGINT) -> tuple[int, str]:
    """End a node; return its exit code and error lines."""
    process.send_signal(by)
    _, complaints = process.communicate(timeout=PATIENCE)
    return process.returncode, complaints
