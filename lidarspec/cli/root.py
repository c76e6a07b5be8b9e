"""The verbs, their shared options, and the entry point `main`.

The module of a verb is imported when the verb is used. This module imports neither NumPy nor
construct, so that ``lidarspec --help`` is fast.
"""

from __future__ import annotations

import functools
import importlib
import os
import sys
import time
from collections.abc import Sequence
from typing import Any, NoReturn

import click

from lidarspec._version import __version__
from lidarspec.cli.failures import INTERRUPTED, report
from lidarspec.cli.terminal import discard_output, note, prepare_streams, say, verbosity
from lidarspec.entry_points import VERBS as PLUGGED, EntryPoint, entry_points
from lidarspec.errors import did_you_mean, suggest
from lidarspec.known_sensors import install_command

#: Group -> verb -> (module, summary). The summary is the same as the first line of the verb's help.
GROUPS = {
    "look": {
        "sensors": ("sensors", "List the installed sensors, and how each was verified."),
        "show": ("sensors", "Describe a sensor, with a table of the fields of each frame."),
        "ports": (
            "finding",
            "List the serial ports of this computer, and the UDP ports of installed sensors.",
        ),
        "detect": (
            "finding",
            "Identify the sensor that sends data, its port and its baud rate.",
        ),
        "doctor": ("finding", "Diagnose why no data arrives from a sensor, and suggest a fix."),
        "plugins": (
            "sensors",
            "List the installed plugins, with the error of each plugin that fails.",
        ),
        "trust": (
            "sensors",
            "Trust a folder, so that its lidarspec.toml may name Python files.",
        ),
        "demo": (
            "sim",
            "Simulate a sensor on a port, read it over a noisy line, record it and draw it.",
        ),
        "help": ("root", "Print the help of a verb, or the list of all verbs."),
    },
    "stream": {
        "read": ("read", "Print the points or the packets of a sensor, one per row."),
        "view": ("view", "Draw a live sensor in the terminal, or with --web in the browser."),
        "record": (
            "recordings",
            "Record a source with arrival times; a crash does not damage the file.",
        ),
        "replay": ("recordings", "Replay a recording or capture, byte for byte and in real time."),
        "sim": ("sim", "Simulate a sensor on a serial port, UDP, TCP or in a file."),
        "send": ("build", "Send a command to a sensor, and print its reply."),
        "clock": (
            "clock",
            "Diagnose sensor clocks: time source, synchronization, offset, drift, jumps.",
        ),
        "stats": (
            "read",
            "Print scan rate, packet rate, errors, loss, jitter and queue of a sensor.",
        ),
    },
    "files": {
        "info": (
            "info",
            "Describe the contents of files: kind, times, senders, sensor, rates, loss.",
        ),
        "convert": (
            "convert",
            "Write the points of a recording or capture to a file of another format.",
        ),
        "plot": ("plot", "Draw a scan, a histogram of intensities, or ranges or rates over time."),
    },
    "bytes": {
        "parse": ("frames", "Read frames from hexadecimal text or a file, and print their fields."),
        "explain": (
            "frames",
            "Explain every byte of each frame: offset, hex, field, value, unit, meaning.",
        ),
        "build": ("build", "Build one frame from the values of its fields."),
        "crc": (
            "finding",
            "Find the checksum of sample frames: XOR, sums, or a CRC of 8, 16 or 32 bits.",
        ),
    },
    "authors": {
        "new": (
            "authors",
            "Create a distribution for your own sensor, with a working example.",
        ),
        "check": (
            "authors",
            "Run the checks of the test kit on a sensor, a file or a distribution.",
        ),
        "export": (
            "authors",
            "Export a sensor's spec: wireshark, c, ksy (Kaitai), md, svg, json, pyi.",
        ),
    },
}
VERBS = {verb: entry for verbs in GROUPS.values() for verb, entry in verbs.items()}
#: Verbs of plugins that are installed separately -> distribution.
SEPARATE_VERBS = {"ros2": "lidarspec-ros2"}


def _make_verbosity_option(loudness: int, *names: str, help: str) -> click.Option:
    """Return an option that sets how many remarks are printed."""

    def set_verbosity(ctx: click.Context, param: click.Parameter, value: bool) -> None:
        if value:
            verbosity.loudness = loudness

    return click.Option(names, is_flag=True, expose_value=False, callback=set_verbosity, help=help)


#: Options of every verb. A verb's own option with the same name has priority.
COMMON_OPTIONS = (
    _make_verbosity_option(
        -1,
        "-q",
        "--quiet",
        help="Print errors only, no remarks and no progress.",
    ),
    _make_verbosity_option(
        1,
        "-v",
        "--verbose",
        help="Also print time and memory used, and the code location of an error.",
    ),
)


@functools.cache
def find_added_verbs() -> dict[str, EntryPoint]:
    """Return the verbs of installed plugins, without loading the plugins."""
    return {entry.name: entry for entry in entry_points(PLUGGED) if entry.name not in VERBS}


class Verbs(click.Group):
    """The group of all verbs; the module of a verb is imported when the verb is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*VERBS, *find_added_verbs()]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in VERBS:
            command: click.Command = getattr(
                importlib.import_module(f"lidarspec.cli.{VERBS[cmd_name][0]}"), cmd_name
            )
        elif cmd_name in find_added_verbs():
            from lidarspec.plugins import load_verb

            command = load_verb(find_added_verbs()[cmd_name])
        else:
            return None
        parameters = {param.name for param in command.params}
        command.params += [option for option in COMMON_OPTIONS if option.name not in parameters]
        if ctx.resilient_parsing:
            from lidarspec.cli.completion import attach

            attach(command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args[0] not in VERBS and args[0] not in find_added_verbs() and not ctx.resilient_parsing:
            if args[0] in SEPARATE_VERBS:
                error = click.UsageError(
                    f"the verb {args[0]!r} requires a plugin that is not installed", ctx
                )
                raise suggest(error, install_command(SEPARATE_VERBS[args[0]], extra=args[0]))
            raise click.UsageError(
                f"unknown verb {args[0]!r}{did_you_mean(args[0], self.list_commands(ctx))}", ctx
            )
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for group, verbs in GROUPS.items():
            with formatter.section(group):
                formatter.write_dl([(verb, text) for verb, (_, text) in verbs.items()])
        if find_added_verbs():
            with formatter.section("plugins"):
                formatter.write_dl(
                    [(verb, _load_verb(entry)) for verb, entry in find_added_verbs().items()]
                )

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[Any]:
        """Return the names of verbs and options, without loading the verbs."""
        from click.shell_completion import CompletionItem

        verbs = {verb: text for verb, (_, text) in VERBS.items()} | {
            verb: _load_verb(entry) for verb, entry in find_added_verbs().items()
        }
        items = [
            CompletionItem(verb, help=text)
            for verb, text in verbs.items()
            if verb.startswith(incomplete)
        ]
        return items + click.Command.shell_complete(self, ctx, incomplete)

    def main(  # type: ignore[override]
        self, args: Sequence[str] | None = None, prog_name: str | None = None, **extra: Any
    ) -> NoReturn:
        """Run one verb, and exit with its code; raises no exception except SystemExit."""
        if instruction := os.environ.get("_LIDARSPEC_COMPLETE"):
            from lidarspec.cli.completion import complete

            sys.exit(complete(self, instruction))
        words = list(sys.argv[1:] if args is None else args)
        sys.exit(_run_verb(self, words))


def _load_verb(entry: EntryPoint) -> str:
    return f"From the plugin {entry.distribution} {entry.version}."


def _run_verb(group: click.Group, words: list[str]) -> int:
    began = time.monotonic()
    try:
        with prepare_streams(), group.make_context("lidarspec", words) as ctx:
            group.invoke(ctx)
            if verbosity.loudness > 0:
                note(_format_cost(time.monotonic() - began))
        return 0
    except click.exceptions.Exit as done:
        return done.exit_code
    except (KeyboardInterrupt, click.Abort):
        note("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        discard_output()
        return 0
    except Exception as error:
        return report(
            error, next((word for word in words if word in VERBS or word in find_added_verbs()), "")
        )


def _format_cost(seconds: float) -> str:
    """Format the duration of a verb, and its memory use if the system reports it."""
    try:
        import resource
    except ImportError:
        return f"{seconds:.1f} s"
    unit = 1 if sys.platform == "darwin" else 1024
    return (
        f"{seconds:.1f} s, {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6:.0f} MB"
        " of memory"
    )


@click.group(
    cls=Verbs,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
)
@click.version_option(__version__, prog_name="lidarspec", message="%(prog)s %(version)s")
@click.pass_context
def main(ctx: click.Context) -> None:
    """Read, record and simulate lidars, and explain the bytes that they send.

    Each sensor is described once, and all verbs use this description of its wire protocol.

    SOURCE is a serial port (/dev/ttyUSB0, COM4), a socket (udp://:2368, tcp://HOST:PORT), a
    simulated sensor (sim:ID), a file (.lsr, .pcap, .pcapng, .bin, .hex) or - for standard input.

    Exit codes: 0 ok, 1 a fault was found, 2 wrong usage, 3 the source cannot be opened, 4 no valid
    data, 5 the device refused or sent nothing, 130 interrupted.
    """
    if ctx.invoked_subcommand is None:
        from lidarspec.cli.sensors import guide

        say(guide())


main.params += COMMON_OPTIONS


@click.command()
@click.argument("verb", required=False)
@click.pass_context
def help(ctx: click.Context, verb: str | None) -> None:
    """Print the help of a verb, or the list of all verbs."""
    root = ctx.find_root()
    if verb is None:
        say(root.get_help())
        return
    _, command, _ = main.resolve_command(root, [verb])
    assert command is not None
    say(command.get_help(click.Context(command, info_name=verb, parent=root)))
