"""The verbs and what they share: loaded when asked for, failures told in one message, exit codes.

Nothing here imports NumPy or construct, so that ``lidarspec --help`` is quick.
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
from lidarspec.cli.terminal import note, say, silence, streams, voice
from lidarspec.entry_points import VERBS as PLUGGED, EntryPoint, entry_points
from lidarspec.errors import did_you_mean, suggest
from lidarspec.known_sensors import install_command

#: group -> verb -> (module, what it does); the texts are those of the verbs' own help.
GROUPS = {
    "look": {
        "sensors": ("sensors", "The installed sensors, and how far each is proven."),
        "show": ("sensors", "What a sensor is, and the wire table of each of its frames."),
        "ports": (
            "finding",
            "The serial ports of this computer, and the UDP ports that installed sensors send to.",
        ),
        "detect": ("finding", "Which installed sensor sends, and at which port and baud rate."),
        "doctor": (
            "finding",
            "What keeps a sensor's bytes from coming, and the command that mends it.",
        ),
        "plugins": (
            "sensors",
            "The plugins that were found, and what is wrong with those that do not load.",
        ),
        "trust": (
            "sensors",
            "Allow a folder: its lidarspec.toml may name Python files, and files elsewhere.",
        ),
        "demo": (
            "sim",
            "Start a simulated sensor on a port, read it over a bad line, record it and draw it.",
        ),
        "help": ("root", "What a verb does, and its options; without a verb, all of them."),
    },
    "stream": {
        "read": ("read", "The points that a sensor sends, a row each; or its packets."),
        "view": ("view", "A sensor at work, drawn in the terminal, or with --web in the browser."),
        "record": (
            "recordings",
            "Record a source, with the time of every arrival, in one file that survives a crash.",
        ),
        "replay": (
            "recordings",
            "A recording or capture, sent again as it came: bit for bit, and by the clock.",
        ),
        "sim": ("sim", "A simulated sensor on a serial port, UDP, TCP or in a file."),
        "send": ("build", "Send a command to a sensor, and print its reply."),
        "stats": ("read", "How a sensor is doing: speed, rates, errors, loss, jitter, queue."),
    },
    "files": {
        "info": (
            "info",
            "What is in a file: kind, times, senders, sensor, rates, loss, and how it is read.",
        ),
        "convert": (
            "convert",
            "Write the points of a capture or raw file to a file, in the format of its suffix.",
        ),
        "plot": ("plot", "A scan as a picture; or intensities, ranges and rates over time."),
    },
    "bytes": {
        "parse": ("frames", "The fields of each frame in some bytes."),
        "explain": (
            "frames",
            "Every byte of each frame: offset, hex, field, value, unit, meaning.",
        ),
        "build": (
            "build",
            "The bytes of one frame from field=value; a unit makes a value physical.",
        ),
        "crc": (
            "finding",
            "Which checksum seals some sample frames: XOR, sums, or a CRC of 8, 16 or 32 bits.",
        ),
    },
    "authors": {
        "new": (
            "authors",
            (
                "A distribution for a sensor of your own, which works before anything in it is"
                " changed."
            ),
        ),
        "check": (
            "authors",
            "Check a sensor, a file or a distribution against every promise of the test kit.",
        ),
        "export": (
            "authors",
            "A sensor's spec for another tool: wireshark, c, ksy (Kaitai), md, svg, json, pyi.",
        ),
    },
}
VERBS = {verb: place for verbs in GROUPS.values() for verb, place in verbs.items()}
#: verbs of plugins that are installed only where somebody asks for them.
ELSEWHERE = {"ros2": "lidarspec-ros2"}


def _make_verbosity_option(loudness: int, *names: str, help: str) -> click.Option:
    """An option that says how much is said."""

    def set_verbosity(ctx: click.Context, param: click.Parameter, value: bool) -> None:
        if value:
            voice.loudness = loudness

    return click.Option(names, is_flag=True, expose_value=False, callback=set_verbosity, help=help)


#: the options of all verbs, but for those that have one of the same name.
SPOKEN = (
    _make_verbosity_option(
        -1,
        "-q",
        "--quiet",
        help="No remarks, and nothing on how far it is; failures are told all the same.",
    ),
    _make_verbosity_option(
        1,
        "-v",
        "--verbose",
        help=(
            "Also how long it took, the memory that it needed, and where in the code a failure"
            " arose."
        ),
    ),
)


@functools.cache
def find_added_verbs() -> dict[str, EntryPoint]:
    """The verbs of installed plugins, none of which is loaded for it; ours come first."""
    return {entry.name: entry for entry in entry_points(PLUGGED) if entry.name not in VERBS}


class Verbs(click.Group):
    """The group of all verbs; a verb's module is imported when the verb is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*VERBS, *find_added_verbs()]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in VERBS:
            found: click.Command = getattr(
                importlib.import_module(f"lidarspec.cli.{VERBS[cmd_name][0]}"), cmd_name
            )
        elif cmd_name in find_added_verbs():
            from lidarspec.plugins import verb

            found = verb(find_added_verbs()[cmd_name])
        else:
            return None
        known = {param.name for param in found.params}
        found.params += [option for option in SPOKEN if option.name not in known]
        if ctx.resilient_parsing:
            from lidarspec.cli.completion import attach

            attach(found)
        return found

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args[0] not in VERBS and args[0] not in find_added_verbs() and not ctx.resilient_parsing:
            if args[0] in ELSEWHERE:
                error = click.UsageError(
                    f"the verb {args[0]!r} comes with a plugin that is not installed", ctx
                )
                raise suggest(error, install_command(ELSEWHERE[args[0]], extra=args[0]))
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
                    [(verb, _from(entry)) for verb, entry in find_added_verbs().items()]
                )

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[Any]:
        """The verbs, none of which is loaded for it; and the options."""
        from click.shell_completion import CompletionItem

        known = {verb: text for verb, (_, text) in VERBS.items()} | {
            verb: _from(entry) for verb, entry in find_added_verbs().items()
        }
        found = [
            CompletionItem(verb, help=text)
            for verb, text in known.items()
            if verb.startswith(incomplete)
        ]
        return found + click.Command.shell_complete(self, ctx, incomplete)

    def main(  # type: ignore[override]
        self, args: Sequence[str] | None = None, prog_name: str | None = None, **extra: Any
    ) -> NoReturn:
        """Run one verb and exit with its code; no exception leaves this."""
        if instruction := os.environ.get("_LIDARSPEC_COMPLETE"):
            from lidarspec.cli.completion import complete

            sys.exit(complete(self, instruction))
        words = list(sys.argv[1:] if args is None else args)
        sys.exit(_run(self, words))


def _from(entry: EntryPoint) -> str:
    return f"Of the plugin {entry.distribution} {entry.version}."


def _run(group: click.Group, words: list[str]) -> int:
    began = time.monotonic()
    try:
        with streams(), group.make_context("lidarspec", words) as ctx:
            group.invoke(ctx)
            if voice.loudness > 0:
                note(_spent(time.monotonic() - began))
        return 0
    except click.exceptions.Exit as done:
        return done.exit_code
    except (KeyboardInterrupt, click.Abort):
        note("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        silence()
        return 0
    except Exception as error:
        return report(
            error, next((word for word in words if word in VERBS or word in find_added_verbs()), "")
        )


def _spent(seconds: float) -> str:
    """The time that a verb took, and its memory, where the system counts it."""
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
    """Read, record, simulate and explain lidars, each from one description of its wire protocol.

    SOURCE is a serial port (/dev/ttyUSB0, COM4), a socket (udp://:2368, tcp://HOST:PORT), a
    simulated sensor (sim:ID), a file (.lsr, .pcap, .pcapng, .bin, .hex) or - for standard input.

    Exit codes: 0 ok, 1 findings, 2 usage, 3 source cannot be opened, 4 no valid data, 5 device
    refused, 130 interrupted.
    """
    if ctx.invoked_subcommand is None:
        from lidarspec.cli.sensors import guide

        say(guide())


main.params += SPOKEN


@click.command()
@click.argument("verb", required=False)
@click.pass_context
def help(ctx: click.Context, verb: str | None) -> None:
    """What a verb does, and its options; without a verb, all of them."""
    root = ctx.find_root()
    if verb is None:
        say(root.get_help())
        return
    _, command, _ = main.resolve_command(root, [verb])
    assert command is not None
    say(command.get_help(click.Context(command, info_name=verb, parent=root)))
