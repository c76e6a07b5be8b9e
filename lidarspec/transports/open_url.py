"""SOURCE, the one noun for where bytes come from: text to transport."""

from __future__ import annotations

import importlib
import os
import re
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs

from lidarspec.device.settings import find_device
from lidarspec.errors import SpecError, UnknownOption, UsageError
from lidarspec.plugins import registry
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.links import Http, Link, Tcp, Udp
from lidarspec.stores import is_stored
from lidarspec.transports.addresses import Address, resolve_host
from lidarspec.transports.base import source_error
from lidarspec.transports.files import open_file
from lidarspec.transports.protocol import LiveTransport, Transport

#: scheme -> the module of lidarspec.transports whose `connect(address, sensor)` opens it.
SCHEMES = {"serial": "serial", "udp": "udp", "tcp": "tcp", "sim": "simulated"}
#: what may stand behind the ? of a file: who sent, and which file of an archive.
FILE_OPTIONS = {"src", "file"}
_SCHEME = re.compile(r"^([a-z][a-z0-9+.-]+):")
#: names of serial ports: Windows' COM4, and everything that POSIX systems call theirs.
_PORT = re.compile(r"(COM\d+|\\\\\.\\\w+|/dev/(tty|cu\.|pts/|serial/|rfcomm).*)", re.IGNORECASE)
#: what stands in /dev and is read like a file.
_NO_PORTS = {"null", "zero", "full", "random", "urandom", "stdin", "fd"}


def transport(source: str | Path, sensor: Sensor | None = None) -> Transport:
    """The open transport for a SOURCE.

    Args:
        sensor: whose declared link says what the source leaves out: baud rate, control lines,
            ports.

    Raises:
        UsageError: for a scheme that neither the package nor a plugin knows, and what each kind of
            source does not take.
        SourceError: where it cannot be opened.
        SpecError: where a plugin gives something that is no `Transport`.
    """
    text = resolve(source)
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


def live(source: str | Path, sensor: Sensor | None = None) -> LiveTransport:
    """The open transport for a SOURCE that does not end by itself.

    Args:
        sensor: whose declared link says what the source leaves out: baud rate, control lines,
            ports.

    Raises:
        UsageError: for a file, a scheme that nobody knows, and what its kind of source does not
            take.
        SourceError: where it cannot be opened.
    """
    opened = transport(source, sensor)
    if isinstance(opened, LiveTransport):
        return opened
    opened.close()
    raise UsageError(f"{source} is a file: nothing can be sent to it")


def resolve(source: str | Path) -> str:
    """The SOURCE itself: that of the device where it is the name of one in `lidarspec.toml`."""
    device = find_device(source)
    if device is None:
        return str(source)
    return device.source


def is_live(source: str | Path) -> bool:
    """Whether a SOURCE, or the device of this name, goes on by itself."""
    return live_address(resolve(source)) is not None


def live_address(source: str | Path) -> Address | None:
    """What a SOURCE says where it is no file: its scheme, place and options; None for files and
    standard input.
    """
    text = str(source)
    if is_port(text):
        return Address.parse(text, scheme="serial")
    scheme = _SCHEME.match(text)
    is_file = scheme is None or is_stored(text) or os.path.exists(text)
    if is_file:
        return None
    return Address.parse(text)


def is_port(text: str) -> bool:
    """Whether a SOURCE without a scheme names a serial port."""
    name = text.partition("?")[0]
    path = Path(name)
    if os.path.exists(name) and path.is_char_device():
        return path.name not in _NO_PORTS and path.resolve().name not in _NO_PORTS
    return _PORT.fullmatch(name) is not None and not os.path.isfile(name)


def has_control(source: str | Path) -> bool:
    """Whether a source says by itself where commands go: ``control=HOST[:PORT]``."""
    address = live_address(source)
    return address is not None and bool(address.options.get("control"))


def control_link(source: str | Path, name: str, link: Link, host: str | None) -> LiveTransport:
    """The open transport of a link that commands go over apart from the data.

    Args:
        name, link: the link as the sensor declares it.
        host: the sensor's address as far as it is known; ``control=HOST[:PORT]`` of the source
            comes before it.

    Raises:
        UsageError: where nobody says the address.
        SourceError: where it cannot be opened.
    """
    address = live_address(source)
    if address is not None:
        said = address.options.get("control", "")
    else:
        said = ""
    if live_address(said) is not None:
        return live(said)
    found, port = Address(said, "", said).host_and_port()
    known = found or host
    if isinstance(link, Tcp) and known:
        return live(f"tcp://{_bracket(known)}:{port or link.port}")
    if isinstance(link, Http) and known:
        from lidarspec.transports.http import HttpTransport

        return HttpTransport(known, replace(link, port=port or link.port))
    if isinstance(link, Udp) and (known or link.broadcast):
        from lidarspec.transports.udp import UdpTransport

        if address is not None:
            everybody = address.options.get("broadcast", "255.255.255.255")
        else:
            everybody = ""
        remote = (
            resolve_host(known or everybody, str(source)),
            port or (link.ports[0] if known and link.ports else link.broadcast),
        )
        own = "::" if ":" in remote[0] else ""
        label = f"udp://{_bracket(remote[0])}:{remote[1]}"
        return UdpTransport(
            label,
            [link.local],
            host=own,
            sender=remote[0] if known else None,
            remote=remote,
            broadcast=not known,
        )
    opened = registry().call("lidarspec_link", source=str(source), link=link, host=known)
    if isinstance(opened, LiveTransport):
        return opened
    if opened is not None:
        raise SpecError(
            f"{name} link: what a plugin gives has to derive from LiveTransport, and is a"
            f" {type(opened).__name__}"
        )
    if not isinstance(link, Tcp | Udp | Http):
        raise UsageError(
            f"{source}: no plugin is installed that opens a {type(link).__name__} link, which"
            f" {name} is"
        )
    raise source_error(
        f"{source}: nobody knows the address of the {name} link",
        f"the same with ?control=ADDRESS in {source}",
    )


def _open(address: Address, sensor: Sensor | None) -> Transport:
    """The open transport of a SOURCE with a scheme, which the package or a plugin knows."""
    if address.scheme in SCHEMES:
        module = importlib.import_module(f"lidarspec.transports.{SCHEMES[address.scheme]}")
        opened: Transport = module.connect(address, sensor)
        return opened
    plugged = registry().call("lidarspec_source", url=address.text, sensor=sensor)
    if plugged is None:
        known = ", ".join(f"{scheme}:" for scheme in SCHEMES)
        raise UsageError(
            f"no transport is installed for {address.scheme!r} sources; known are files, -"
            f" (standard input), {known}"
        )
    if not isinstance(plugged, Transport):
        raise SpecError(
            f"{address.scheme!r} sources: what a plugin gives has to derive from Transport, and is"
            f" a {type(plugged).__name__}"
        )
    return plugged


def _bracket(host: str) -> str:
    if ":" in host:
        return f"[{host}]"
    return host
