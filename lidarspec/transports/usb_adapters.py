"""Find USB serial adapters without a driver.

An adapter without a driver has no serial port, so it is found in the system's list of USB devices.
"""

from __future__ import annotations

import contextlib
import json
import plistlib
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lidarspec.transports.ports import list_usb_ids

LIST_TIMEOUT_S = 10.0
#: prints the USB devices of a Windows computer as JSON.
_WINDOWS_QUERY = (
    "Get-CimInstance Win32_PnPEntity -Filter \"DeviceID LIKE 'USB%'\""
    " | Select-Object DeviceID, ConfigManagerErrorCode | ConvertTo-Json"
)
_WINDOWS_ID = re.compile(r"VID_([0-9A-F]{4})&PID_([0-9A-F]{4})", re.IGNORECASE)


@dataclass(frozen=True)
class AdapterKind:
    """A family of USB serial adapters.

    Attributes:
        brltty: whether the program brltty mistakes the adapters for braille displays.
    """

    name: str
    vendor_id: int
    product_ids: frozenset[int]
    module: str
    website: str
    brltty: bool = False


#: Sources: the id tables of the Linux drivers cp210x, ch341 and ftdi_sio. Only ids of the chips'
#: vendors are included.
KINDS = (
    AdapterKind(
        "CP210x",
        0x10C4,
        frozenset((0xEA60, 0xEA61, 0xEA63, 0xEA70, 0xEA71, 0xEA80)),
        "cp210x",
        "https://www.silabs.com/developers/usb-to-uart-bridge-vcp-drivers",
        brltty=True,
    ),
    AdapterKind(
        "CH340",
        0x1A86,
        frozenset((0x5523, 0x7522, 0x7523)),
        "ch341",
        "https://www.wch-ic.com/downloads/CH341SER_ZIP.html",
        brltty=True,
    ),
    AdapterKind(
        "FTDI",
        0x0403,
        frozenset((0x6001, 0x6010, 0x6011, 0x6014, 0x6015)),
        "ftdi_sio",
        "https://ftdichip.com/drivers/vcp-drivers/",
    ),
)


@dataclass(frozen=True)
class UsbDevice:
    """A USB device.

    Attributes:
        vendor_id, product_id: its USB ids.
        has_driver: whether a driver makes a serial port for the device.
    """

    vendor_id: int
    product_id: int
    has_driver: bool

    @property
    def kind(self) -> AdapterKind | None:
        """The family of the adapter; None for other devices."""
        for kind in KINDS:
            if self.vendor_id == kind.vendor_id and self.product_id in kind.product_ids:
                return kind
        return None


@dataclass(frozen=True)
class MissingDriver:
    """A description of the driver that an adapter needs.

    Attributes:
        fix: the command that loads or installs the driver; "" if there is none.
    """

    text: str
    fix: str = ""


def list_missing_drivers(platform: str = sys.platform) -> list[MissingDriver]:
    """Return the driver that each known USB adapter without a driver needs."""
    return [
        describe_missing_driver(device, device.kind, platform)
        for device in list_usb_devices(platform)
        if device.kind is not None and not device.has_driver
    ]


def describe_missing_driver(device: UsbDevice, kind: AdapterKind, platform: str) -> MissingDriver:
    """Return the driver that an adapter needs on a platform (`sys.platform`)."""
    adapter = f"USB adapter {kind.name} ({device.vendor_id:04x}:{device.product_id:04x})"
    if platform.startswith("linux"):
        text = f"{adapter} has no serial port: the driver {kind.module} is not loaded"
        if kind.brltty and Path("/usr/bin/brltty").exists():
            text += ", or the program brltty uses the adapter"
            return MissingDriver(text, "sudo apt remove brltty")
        return MissingDriver(text, f"sudo modprobe {kind.module}")
    text = f"{adapter} has no serial port: install the driver from {kind.website}"
    return MissingDriver(text)


def list_usb_devices(platform: str = sys.platform) -> list[UsbDevice]:
    """Return the USB devices of this computer; an empty list if the system does not list them."""
    if platform.startswith("linux"):
        return list(read_sysfs(Path("/sys/bus/usb/devices")))
    if platform == "darwin":
        listed = _read_output("ioreg", "-p", "IOUSB", "-a", "-l")
        return list(parse_ioreg(listed, list_usb_ids()))
    if platform == "win32":
        listed = _read_output("powershell", "-NoProfile", "-Command", _WINDOWS_QUERY)
        return list(parse_pnp_json(listed))
    return []


def read_sysfs(folder: Path) -> Iterator[UsbDevice]:
    """Yield the USB devices in a folder like /sys/bus/usb/devices."""
    for device in sorted(folder.glob("*")):
        with contextlib.suppress(OSError, ValueError):
            vendor_id = int((device / "idVendor").read_text(encoding="ascii"), 16)
            product_id = int((device / "idProduct").read_text(encoding="ascii"), 16)
            # ttyUSB0 is in the folder of the interface, ttyACM0 in "tty" below it
            has_port = any(device.glob("*:*/ttyUSB*")) or any(device.glob("*:*/tty/tty*"))
            yield UsbDevice(vendor_id, product_id, has_port)


def parse_ioreg(listed: bytes, ids_of_ports: Iterable[tuple[int, int]]) -> Iterator[UsbDevice]:
    """Yield the USB devices in the output of `ioreg -a`.

    Args:
        listed: a property list; empty if the program failed.
        ids_of_ports: the USB ids of all serial ports.
    """
    if not listed:
        return
    with_port = set(ids_of_ports)
    pending = [plistlib.loads(listed)]
    while pending:
        entry = pending.pop()
        if isinstance(entry, list):
            pending += entry
        elif isinstance(entry, Mapping):
            pending += entry.get("IORegistryEntryChildren", [])
            ids = (entry.get("idVendor"), entry.get("idProduct"))
            if isinstance(ids[0], int) and isinstance(ids[1], int):
                yield UsbDevice(ids[0], ids[1], ids in with_port)


def parse_pnp_json(listed: bytes) -> Iterator[UsbDevice]:
    """Yield the USB devices in the JSON output of `_WINDOWS_QUERY`.

    Args:
        listed: a JSON object, or a list of objects; empty if PowerShell failed or found no device.
    """
    if not listed.strip():
        return
    entries: Any = json.loads(listed)
    for entry in entries if isinstance(entries, list) else [entries]:
        found = _WINDOWS_ID.search(entry["DeviceID"])
        if found:
            ids = [int(digits, 16) for digits in found.groups()]
            yield UsbDevice(ids[0], ids[1], entry["ConfigManagerErrorCode"] == 0)


def _read_output(*command: str) -> bytes:
    """Return the output of a program; empty if it fails or does not exist."""
    try:
        done = subprocess.run(command, capture_output=True, timeout=LIST_TIMEOUT_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return b""
    return done.stdout
