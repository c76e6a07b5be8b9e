"""Open the transport of a SOURCE: a file, a port, a URL or a device name."""

from __future__ import annotations

import importlib
import os
import re
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs

from lidarspec.device.named_devices import find_device
from lidarspec.errors import SpecError, UnknownOption, UsageError
from lidarspec.plugins import registry
from lidarspec.remote_files import is_remote
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Http, Link, Tcp, Udp
from lidarspec.transports.addresses import SourceAddress, resolve_host
from lidarspec.transports.base import source_error
from lidarspec.transports.files import open_file
from lidarspec.transports.protocol import LiveTransport, Transport

#: scheme -> module of lidarspec.transports. Its function `connect(address, sensor)` opens the
#: transport.
SCHEMES = {"serial": "serial", "udp": "udp", "tcp": "tcp", "sim": "simulated"}
#: options of a file, after "?": the sender of datagrams, and the name of a file in an archive.
FILE_OPTIONS = {"src", "file"}
_SCHEME = re.compile(r"^([a-z][a-z0-9+.-]+):")
#: matches the name of a serial port, on Windows or on POSIX systems.
_PORT_NAME = re.compile(
    r"(COM\d+|\\\\\.\\\w+|/dev/(tty|cu\.|pts/|serial/|rfcomm).*)", re.IGNORECASE
)
#: names of devices in /dev that are read as files.
_FILE_DEVICES = {"null", "zero", "full", "random", "urandom", "stdin", "fd"}


def open_transport(source: str | Path, sensor: Sensor | None = None) -> Transport:
    """Open the transport of a SOURCE.

    Args:
        source: a file, "-", a port, a URL, or the name of a device in `lidarspec.toml`.
        sensor: the sensor whose baud rate, control lines and ports are the defaults; None for no
            defaults.

    Raises:
        UsageError: for an unknown scheme, or an option that this kind of source does not accept.
        SourceError: if the source cannot be opened.
        SpecError: if a plugin returns an object that is not a `Transport`.
    """
    text = resolve_device_name(source)
    address = live_address(text)
    if address is not None:
        return _open(address, sensor)
    path, mark, query = text.rpartition("?")
    if mark and not os.path.exists(text):
        options = parse_qs(query, keep_blank_values=True)
        if unknown := set(options) - FILE_OPTIONS:
            raise UnknownOption(min(unknown), FILE_OPTIONS, place=text)
        return open_file(
            path,
            sender=options["src"][-1] if "src" in options else None,
            member=options.get("file", [""])[-1],
        )
    return open_file(text)


def open_live(source: str | Path, sensor: Sensor | None = None) -> LiveTransport:
    """Open the transport of a live SOURCE.

    Args:
        sensor: the sensor whose baud rate, control lines and ports are the defaults; None for no
            defaults.

    Raises:
        UsageError: for a file, an unknown scheme, or an unknown option.
        SourceError: if the source cannot be opened.
    """
    opened = open_transport(source, sensor)
    if isinstance(opened, LiveTransport):
        return opened
    opened.close()
    raise UsageError(f"{source} is a file, so nothing can be sent to it")


def resolve_device_name(source: str | Path) -> str:
    """Return the SOURCE of a device in `lidarspec.toml`; any other text unchanged."""
    device = find_device(source)
    if device is None:
        return str(source)
    return device.source


def is_live(source: str | Path) -> bool:
    """Return whether a SOURCE, or a device of `lidarspec.toml`, is live; False for a file."""
    return live_address(resolve_device_name(source)) is not None


def live_address(source: str | Path) -> SourceAddress | None:
    """Return the parts of a live SOURCE; None for files and standard input."""
    text = str(source)
    if is_port(text):
        return SourceAddress.parse(text, scheme="serial")
    scheme = _SCHEME.match(text)
    is_file = scheme is None or is_remote(text) or os.path.exists(text)
    if is_file:
        return None
    return SourceAddress.parse(text)


def is_port(text: str) -> bool:
    """Return whether a SOURCE without a scheme names a serial port."""
    name = text.partition("?")[0]
    path = Path(name)
    if os.path.exists(name) and path.is_char_device():
        return path.name not in _FILE_DEVICES and path.resolve().name not in _FILE_DEVICES
    return _PORT_NAME.fullmatch(name) is not None and not os.path.isfile(name)


def has_control(source: str | Path) -> bool:
    """Return whether a source has the option ``control=HOST[:PORT]``."""
    address = live_address(source)
    return address is not None and bool(address.options.get("control"))


def open_control_link(source: str | Path, name: str, link: Link, host: str | None) -> LiveTransport:
    """Open the transport of a link that carries commands, but no data.

    Args:
        source: the SOURCE of the data. Its option ``control=HOST[:PORT]`` overrides `host`.
        host: the sensor's address; None if it is unknown.

    Raises:
        UsageError: if no plugin opens a link of this type.
        SourceError: if the address is unknown, or the link cannot be opened.
    """
    address = live_address(source)
    if address is not None:
        control = address.options.get("control", "")
    else:
        control = ""
    if live_address(control) is not None:
        return open_live(control)
    control_host, port = SourceAddress(control, "", control).host_and_port()
    remote_host = control_host or host
    if isinstance(link, Tcp) and remote_host:
        return open_live(f"tcp://{_bracket(remote_host)}:{port or link.port}")
    if isinstance(link, Http) and remote_host:
        from lidarspec.transports.http import HttpTransport

        return HttpTransport(remote_host, replace(link, port=port or link.port))
    if isinstance(link, Udp) and (remote_host or link.broadcast):
        from lidarspec.transports.udp import UdpTransport

        if address is not None:
            broadcast_host = address.options.get("broadcast", "255.255.255.255")
        else:
            broadcast_host = ""
        remote = (
            resolve_host(remote_host or broadcast_host, str(source)),
            port or (link.ports[0] if remote_host and link.ports else link.broadcast),
        )
        local_host = "::" if ":" in remote[0] else ""
        label = f"udp://{_bracket(remote[0])}:{remote[1]}"
        return UdpTransport(
            label,
            [link.local],
            host=local_host,
            sender=remote[0] if remote_host else None,
            remote=remote,
            broadcast=not remote_host,
        )
    opened = registry().call("lidarspec_link", source=str(source), link=link, host=remote_host)
    if isinstance(opened, LiveTransport):
        return opened
    if opened is not None:
        raise SpecError(
            f"the plugin must return a LiveTransport for the {name} link, not a"
            f" {type(opened).__name__}"
        )
    if not isinstance(link, Tcp | Udp | Http):
        raise UsageError(
            f"{source}: the link {name!r} is a {type(link).__name__} link, which no installed"
            " plugin can open"
        )
    raise source_error(
        f"{source}: the address of the {name} link is unknown",
        f"repeat with ?control=ADDRESS in {source}",
    )


def _open(address: SourceAddress, sensor: Sensor | None) -> Transport:
    """Open a SOURCE with a scheme."""
    if address.scheme in SCHEMES:
        module = importlib.import_module(f"lidarspec.transports.{SCHEMES[address.scheme]}")
        opened: Transport = module.connect(address, sensor)
        return opened
    plugged = registry().call("lidarspec_source", url=address.text, sensor=sensor)
    if plugged is None:
        schemes = ", ".join(f"{scheme}:" for scheme in SCHEMES)
        raise UsageError(
            f"unknown scheme {address.scheme!r}: expected a file, - (standard input), {schemes}"
        )
    if not isinstance(plugged, Transport):
        raise SpecError(
            f"the plugin must return a Transport for {address.scheme!r} sources, not a"
            f" {type(plugged).__name__}"
        )
    return plugged


def _bracket(host: str) -> str:
    if ":" in host:
        return f"[{host}]"
    return host
