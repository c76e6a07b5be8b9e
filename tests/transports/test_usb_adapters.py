"""Tests that name the missing drivers of USB serial adapters, from lists of devices.

The lists are those of Linux, macOS and Windows, and are written by the tests.
"""

from __future__ import annotations

import json
import plistlib
from pathlib import Path

import pytest

from lidarspec.detect import doctor
from lidarspec.transports import usb_adapters
from lidarspec.transports.usb_adapters import (
    KINDS,
    MissingDriver,
    UsbDevice,
    describe_missing_driver,
    parse_ioreg,
    parse_pnp_json,
    read_sysfs,
)

CP2102 = (0x10C4, 0xEA60)
CH340 = (0x1A86, 0x7523)
FT232R = (0x0403, 0x6001)
HUB = (0x1D6B, 0x0002)


def make_device(folder: Path, name: str, ids: tuple[int, int], port: str = "") -> None:
    """Write a device as in /sys/bus/usb/devices."""
    device = folder / name
    interface = device / f"{name}:1.0"
    interface.mkdir(parents=True)
    (device / "idVendor").write_text(f"{ids[0]:04x}\n", encoding="ascii")
    (device / "idProduct").write_text(f"{ids[1]:04x}\n", encoding="ascii")
    if port:
        (interface / port).mkdir(parents=True)


def test_linux_lists_devices_with_and_without_a_port(tmp_path: Path) -> None:
    make_device(tmp_path, "1-1", CP2102, "ttyUSB0")
    make_device(tmp_path, "1-2", CH340)
    make_device(tmp_path, "1-3", FT232R, "tty/ttyACM0")
    make_device(tmp_path, "usb1", HUB)
    (tmp_path / "1-9:1.0").mkdir()
    devices = list(read_sysfs(tmp_path))
    assert [device.has_driver for device in devices] == [True, False, True, False]
    assert [device.kind and device.kind.name for device in devices] == [
        "CP210x",
        "CH340",
        "FTDI",
        None,
    ]


def test_macos_compares_devices_with_ports() -> None:
    tree = {
        "IORegistryEntryName": "Root",
        "IORegistryEntryChildren": [
            {
                "idVendor": HUB[0],
                "idProduct": HUB[1],
                "IORegistryEntryChildren": [
                    {"idVendor": CP2102[0], "idProduct": CP2102[1]},
                    {"idVendor": CH340[0], "idProduct": CH340[1]},
                ],
            },
        ],
    }
    devices = set(parse_ioreg(plistlib.dumps(tree), [CH340]))
    assert devices == {
        UsbDevice(*HUB, False),
        UsbDevice(*CP2102, False),
        UsbDevice(*CH340, True),
    }
    assert list(parse_ioreg(b"", [])) == []


@pytest.mark.parametrize("is_list", [True, False])
def test_windows_reports_an_error_code_without_a_driver(is_list: bool) -> None:
    missing = {"DeviceID": r"USB\VID_10C4&PID_EA60\0001", "ConfigManagerErrorCode": 28}
    working = {"DeviceID": r"USB\VID_0403&PID_6001\A5", "ConfigManagerErrorCode": 0}
    hub = {"DeviceID": r"USB\ROOT_HUB30\4", "ConfigManagerErrorCode": 0}
    listed = [missing, working, hub] if is_list else missing
    devices = list(parse_pnp_json(json.dumps(listed).encode()))
    expected = [UsbDevice(*CP2102, False), UsbDevice(*FT232R, True)]
    assert devices == (expected if is_list else expected[:1])
    assert list(parse_pnp_json(b"\r\n")) == []


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_the_missing_driver_is_named_on_each_platform(kind: usb_adapters.AdapterKind) -> None:
    device = UsbDevice(kind.vendor_id, min(kind.product_ids), has_driver=False)
    for platform in ("darwin", "win32"):
        driver = describe_missing_driver(device, kind, platform)
        assert kind.name in driver.text
        assert kind.website in driver.text
        assert driver.fix == ""
    driver = describe_missing_driver(device, kind, "linux")
    assert kind.module in driver.text
    assert driver.fix.startswith("sudo ")


def test_doctor_reports_missing_drivers(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = MissingDriver("USB adapter CH340 has no serial port", "sudo modprobe ch341")
    monkeypatch.setattr(doctor, "list_missing_drivers", lambda: [driver])
    everything = doctor.Diagnosis(False, driver.text, driver.fix)
    assert everything in list(doctor.examine_computer())
    assert everything in list(doctor.examine("serial:///dev/ttyUSB97"))


def test_a_program_that_does_not_exist_lists_nothing() -> None:
    assert usb_adapters._read_output("no-such-program-anywhere") == b""
    assert usb_adapters.list_usb_devices("plan9") == []
