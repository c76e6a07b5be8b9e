"""Hold the speed of an STL-27L by PWM, on a board with a PWM output such as a Raspberry Pi.

    python motor_speed.py /dev/ttyUSB0 --hertz 6 --pin GPIO18
    python motor_speed.py /dev/ttyUSB0 --hertz 6 --pwm /sys/class/pwm/pwmchip0/pwm0

Connect the output to pin 2 of the sensor (PWM, at most 3.3 V), and the grounds. The duty cycle sets
the speed, but units differ in their speed at the same duty cycle (manual, section 2). This program
therefore compares the speed in the packets with the wanted speed, and corrects the duty cycle.

`--pin` uses gpiozero. Its pin factory has to reach 20 kHz. pigpio reaches it with `pigpiod -s 1`,
but only in coarse steps. `--pwm` uses the PWM hardware through Linux, in fine steps. Export the
channel first: ``echo 0 | sudo tee /sys/class/pwm/pwmchip0/export``.

The sensor stays under external control until its power is switched off.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from pathlib import Path
from typing import Any, Protocol

import lidarspec as ls

# Manual, section 2: 20 to 50 kHz, 30 recommended; a duty cycle between 45 and 55 % for at least
# 100 ms begins external control.
FREQUENCY_HZ = 30_000
START_DUTY = 0.5
START_S = 0.2
#: Change of the duty cycle per Hz of deviation, at once and per second.
PROPORTIONAL = 0.006
INTEGRAL = 0.02
#: Lowest speed at which the scans of lidarspec are complete.
MIN_SPEED_HZ = 0.5
#: Longest time between two corrections that counts, seconds.
MAX_STEP_S = 0.2


class Pin(Protocol):
    """A PWM output, for example a `PWMOutputDevice` of gpiozero.

    Attributes:
        value: the duty cycle, 0 to 1.
    """

    value: float


class LinuxPwm:
    """A PWM channel of Linux, controlled by the files in its folder in /sys/class/pwm."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._period_ns = round(1e9 / FREQUENCY_HZ)
        self._value = 0.0
        self._write("duty_cycle", 0)
        self._write("period", self._period_ns)
        self._write("enable", 1)

    @property
    def value(self) -> float:
        """The duty cycle, 0 to 1."""
        return self._value

    @value.setter
    def value(self, duty: float) -> None:
        self._value = duty
        self._write("duty_cycle", round(duty * self._period_ns))

    def _write(self, name: str, number: int) -> None:
        (self._folder / name).write_text(str(number), encoding="ascii")


class SpeedControl:
    """A proportional and integral controller of the speed.

    Args:
        pin: the PWM output.
        hertz: the wanted revolutions per second.
    """

    def __init__(self, pin: Pin, hertz: float) -> None:
        self._pin = pin
        self._hertz = hertz
        self._duty = START_DUTY

    def begin(self) -> None:
        """Output the duty cycle that begins external control.

        The sensor needs this duty cycle for `START_S` seconds.
        """
        self._pin.value = START_DUTY

    def update(self, measured_hz: float, seconds: float) -> None:
        """Correct the duty cycle.

        Args:
            measured_hz: the reported speed.
            seconds: the time since the last correction.
        """
        deviation = self._hertz - measured_hz
        self._duty += INTEGRAL * deviation * min(seconds, MAX_STEP_S)
        self._duty = min(max(self._duty, 0.0), 1.0)
        self._pin.value = min(max(self._duty + PROPORTIONAL * deviation, 0.0), 1.0)


def make_pin(pin: str, pwm: str) -> Pin:
    """Return the PWM output that the options name."""
    if pwm:
        return LinuxPwm(Path(pwm))
    try:
        from gpiozero import PWMOutputDevice
    except ImportError:
        raise SystemExit("--pin requires gpiozero: pip install gpiozero pigpio") from None
    output: Any = PWMOutputDevice(pin, frequency=FREQUENCY_HZ)
    return output  # type: ignore[no-any-return]


def main() -> None:
    """Hold the speed until the program is interrupted."""
    parser = argparse.ArgumentParser(description="Hold the speed of an STL-27L by PWM.")
    parser.add_argument("source", help="the port of the sensor, such as /dev/ttyUSB0")
    parser.add_argument("--hertz", type=float, default=10.0, help="revolutions per second")
    parser.add_argument("--pin", default="GPIO18", help="output for gpiozero")
    parser.add_argument("--pwm", default="", help="folder of a channel in /sys/class/pwm")
    options = parser.parse_args()
    if not options.hertz >= MIN_SPEED_HZ:  # also refuses nan; the manual gives no limits
        parser.error(f"--hertz: expected at least {MIN_SPEED_HZ}, got {options.hertz:g}")
    pin = make_pin(options.pin, options.pwm)
    control = SpeedControl(pin, options.hertz)
    control.begin()
    time.sleep(START_S)
    before = time.monotonic()
    with ls.open(options.source, "ldrobot-stl27l") as device:
        for packets in device.packets(wait=MAX_STEP_S):
            if not len(packets):
                continue
            now = time.monotonic()
            measured_hz = packets["speed"][-1] / 360
            control.update(measured_hz, now - before)
            before = now
            print(f"\r{measured_hz:6.2f} Hz, duty cycle {pin.value:6.1%}", end="", flush=True)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
