"""Tests of the example that holds the speed of an STL-27L, with a fake pin and a simulated motor.

Time is virtual. The motor follows the duty cycle with a delay, and units differ (manual, 2).
"""

from __future__ import annotations

import importlib.util
import sys
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest

import lidarspec as ls

SENSOR = ls.sensor("ldrobot-stl27l")
EXAMPLE = Path(__file__).parents[1] / "examples" / "motor_speed.py"
STEP_S = 0.05
TOLERANCE_HZ = 0.1  # that of the internal control (manual, section 1)


@pytest.fixture(scope="module")
def example() -> ModuleType:
    """Return the example as a module."""
    spec = importlib.util.spec_from_file_location("motor_speed", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["motor_speed"] = module
    spec.loader.exec_module(module)
    return module


class FakePin:
    """A PWM output that drives nothing."""

    value = 0.0


class Motor:
    """A simulated sensor whose speed follows the duty cycle of a pin.

    Args:
        pin: the pin that sets the duty cycle.
        gain: Hz per unit of duty cycle.
        lag: the time constant, seconds.
    """

    def __init__(self, pin: FakePin, gain: float, lag: float) -> None:
        self._pin = pin
        self._gain = gain
        self._lag = lag
        self.hertz = 10.0  # internal control until external control begins

    def run(self, seconds: float) -> bytes:
        """Advance the motor by `seconds`, and return three packets with its new speed."""
        self.hertz += (self._gain * self._pin.value - self.hertz) * min(seconds / self._lag, 1)
        sweep = partial(SENSOR.simulation.sweep, turns=self.hertz)  # type: ignore[arg-type]
        points = [{"distance": 2.0, "intensity": 9}] * 12
        return b"".join(
            SENSOR.build("data", units=True, points=points, **sweep(i)) for i in range(3)
        )


@pytest.mark.parametrize("hertz", [2, 6, 10, 13])
@pytest.mark.parametrize(("gain", "lag"), [(16, 0.3), (20, 0.5), (28, 0.8)])
def test_the_speed_settles(example: ModuleType, hertz: float, gain: float, lag: float) -> None:
    pin = FakePin()
    motor = Motor(pin, gain, lag)
    control = example.SpeedControl(pin, hertz)
    control.begin()
    assert 0.45 < pin.value < 0.55
    motor.run(example.START_S)
    measured = []
    for _ in range(round(40 / STEP_S)):
        packets = SENSOR.decode(motor.run(STEP_S))
        measured.append(packets["speed"][-1] / 360)
        control.update(measured[-1], STEP_S)
    settled = measured[len(measured) // 2 :]
    assert max(abs(speed - hertz) for speed in settled) <= TOLERANCE_HZ
    assert pin.value == pytest.approx(hertz / gain, abs=0.01)


def test_external_control_begins_within_the_limits(example: ModuleType) -> None:
    assert 20_000 <= example.FREQUENCY_HZ <= 50_000
    assert 0.45 < example.START_DUTY < 0.55  # 45 and 55 % are excluded
    assert example.START_S > 0.1  # 100 ms


@pytest.mark.parametrize("hertz", ["0", "-1", "0.4", "nan"])
def test_a_speed_without_complete_scans_is_refused(
    example: ModuleType,
    hertz: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["motor_speed.py", "/dev/null", "--hertz", hertz])
    with pytest.raises(SystemExit) as caught:
        example.main()
    assert caught.value.code == 2
    assert "--hertz: expected at least 0.5" in capsys.readouterr().err


@pytest.mark.parametrize("hertz", ["0.5", "4", "13"])
def test_other_speeds_are_accepted(
    example: ModuleType, hertz: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = []
    monkeypatch.setattr(sys, "argv", ["motor_speed.py", "/dev/null", "--hertz", hertz])
    monkeypatch.setattr(example, "make_pin", lambda pin, pwm: started.append(pin) or sys.exit(0))
    with pytest.raises(SystemExit):
        example.main()
    assert started == ["GPIO18"]


def test_the_duty_cycle_stays_in_its_limits(example: ModuleType) -> None:
    pin = FakePin()
    control = example.SpeedControl(pin, 13)
    for _ in range(1000):
        control.update(0.0, 10.0)  # a blocked motor
    assert pin.value == 1.0
    control.update(14.0, 0.1)
    assert pin.value < 1.0, "the integral does not grow beyond the limit"
    for _ in range(1000):
        control.update(30.0, 0.1)
    assert pin.value == 0.0


def test_linux_pwm_writes_the_period_and_the_duty_cycle(
    example: ModuleType, tmp_path: Path
) -> None:
    pwm = example.LinuxPwm(tmp_path)
    pwm.value = 0.5
    written = {path.name: int(path.read_text()) for path in tmp_path.iterdir()}
    assert written == {"period": 33_333, "duty_cycle": 16_666, "enable": 1}
    assert 20_000 <= 1e9 / written["period"] <= 50_000
    assert pwm.value == 0.5
