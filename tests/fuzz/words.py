"""Make command lines from bytes: each byte selects the next argument.

Arguments are a verb's own options and values, or difficult ones. No command opens a port or runs
without end: sources are files, and simulations write some milliseconds into a file.
"""

from __future__ import annotations

import functools
from pathlib import Path

import click
from click.testing import CliRunner

import lidarspec as ls
from lidarspec.cli.root import VERBS, main
from tests.representatives import REPRESENTATIVES

#: text that makes trouble where a name, number, path or hex is taken.
HOSTILE = (
    *(
        "",
        " ",
        "-",
        "--",
        ".",
        "..",
        "/",
        "~",
        "\x00",
        "\x1b[2J",
        "\u202e",
        "\ud800".encode("utf-8", "replace").decode(),
        "a" * 5000,
        "%s%n",
        "${HOME}",
    ),
    *(
        "0",
        "-1",
        "1e999",
        "nan",
        "inf",
        "1_0",
        "\u0661",
        "0x",
        "99999999999999999999",
        "1e-400",
        "10ms",
        "-5s",
        "0s",
        "1%",
        "101%",
        "4:2",
        ":",
        "::",
    ),
    *(
        "54 2c",
        "54:2c",
        "0x54, 0x2C}",
        "5",
        "zz",
        "#",
        "//",
        "\\x54\\x",
        "0000: 54",
        "\u00b2\u00b2",
    ),
    *(
        "udp://",
        "udp://[",
        "udp://[::1",
        "udp://:0",
        "udp://:99999",
        "udp://:\u0662",
        "tcp://:",
        "tcp://a:b:c",
        "serial:",
        "serial://?baud=1e9",
    ),
    *(
        "udp://:2368?src=%00",
        "serial:///dev/x?dtr=maybe",
        "x:y",
        "sim:",
        "sim:nobody",
        "sim:a?b&c=",
        "COM0",
        "file:///etc/x",
        "udp://\u2100:1",
    ),
)
#: verbs that end by themselves when their sources are files; `crc` and `check` search for seconds.
ENDING = (
    "sensors",
    "show",
    "help",
    "parse",
    "explain",
    "build",
    "convert",
    "plot",
    "export",
    "read",
    "stats",
    "replay",
    "record",
    "new",
    "sim",
)
#: what a file is called that is written.
TARGETS = (
    "out.csv",
    "out.npz",
    "out.svg",
    "out.lsr",
    "out.pcap",
    "out.bin",
    "out.xyz",
    "out",
    "none/out.csv",
)
#: files that are there, by their content.
SOURCES = ("stl.bin", "stl.hex", "vlp.pcap", "stl.lsr", "empty.bin", "noise.bin")


def make_first_inputs() -> list[bytes]:
    """Return the first inputs: the bytes of every verb, with a few options."""
    return [
        bytes([verb, *range(start, start + 12)])
        for verb in range(len(ENDING))
        for start in (0, 40, 90)
    ]


def words(data: bytes) -> list[str]:
    """Return the command line that bytes select."""
    if not data:
        return []
    verb = ENDING[data[0] % len(ENDING)]
    command = main.get_command(click.Context(main), verb)
    assert command is not None
    arguments = [parameter for parameter in command.params if isinstance(parameter, click.Argument)]
    options = [
        option
        for option in command.params
        if isinstance(option, click.Option) and option.name not in ("loop", "help")
    ]
    found, rest = [verb], iter(data[1:14])
    for argument in arguments:
        found += [
            _value(argument.name or "", next(rest, 0), next(rest, 0))
            for _ in range(1 if argument.nargs == 1 else next(rest, 0) % 3)
        ]
    for byte in rest:
        option = options[byte % len(options)] if options else None
        if option is not None:
            found += (
                [option.opts[-1]]
                if option.is_flag
                else [option.opts[-1], _value(option.name or "", next(rest, 0), next(rest, 0))]
            )
    if verb == "sim":  # into a file, and not much of it
        found += ["--to", TARGETS[3 + data[-1] % 3], "-t", "10ms", "--rate", "max"]
    if verb == "record":  # what is live has no end
        found += ["-t", "10ms"]
    if verb in ("replay", "record"):
        found += ["--to" if verb == "replay" else "-o", TARGETS[3 + data[-1] % 3]]
    return found


def _value(name: str, kind: int, choice: int) -> str:
    """Return a value for an argument or option, usually a valid one."""
    if kind % 4 == 0:
        return HOSTILE[choice % len(HOSTILE)]
    known = _list_known(name)
    return known[choice % len(known)]


@functools.cache
def _list_known(name: str) -> tuple[str, ...]:
    frames = tuple({frame for sensor in REPRESENTATIVES for frame in ls.sensor(sensor).frames})
    return {
        "verb": tuple(VERBS),
        "sensor_id": REPRESENTATIVES,
        "frame": frames,
        "kind": ("wireshark", "c", "ksy", "md", "svg", "json", "pyi"),
        "assignments": (
            "speed=1",
            "speed=1.5rpm",
            "points[0].distance=3",
            "points=[]",
            "a=b=c",
            "=",
            "speed",
            "start_angle=360deg",
            "x[=1",
            "points[99]=1",
        ),
        "options": (
            "frame=vendor",
            "answer=data",
            "answer=x",
            "zero=1e9",
            "calibration=stl.bin",
            "=",
            "frame",
            "calibration=none.csv",
        ),
        "output": TARGETS,
        "target": TARGETS,
        "to": TARGETS[3:6],
        "link": ("serial", "udp", "out"),
        "scene": ("scene.toml", "stl.bin", "none.toml"),
        "speed": ("max",),
        "backend": ("numpy", "jit", "auto"),
    }.get(name, (*SOURCES, "1", "2", "10ms", "0:47", "54 2c 68", "points", "max"))


def run_command(folder: Path, data: bytes) -> None:
    """Run a command line.

    It must end with a documented exit code, and must not print that the error is a bug.

    Args:
        folder: the working directory, in which the files that it names are made.
    """
    _fill_folder(folder)
    line = words(data)
    done = CliRunner(catch_exceptions=False).invoke(main, line, input=b"")
    said = done.output
    if (
        done.exit_code not in (0, 1, 2, 3, 4, 5)
        or "a bug in lidarspec" in said
        or ("Traceback" in said and not {"-v", "--verbose"} & {*line})
    ):
        raise AssertionError(f"{line} ends with {done.exit_code}: {said[-300:]}")


def _fill_folder(folder: Path) -> None:
    """Write the files that command lines name, if they are missing or changed."""
    for name, content in _contents().items():
        if not (folder / name).is_file() or (folder / name).stat().st_size != len(content):
            (folder / name).write_bytes(content)
    for name in TARGETS:
        (folder / name).unlink(missing_ok=True)


@functools.cache
def _contents() -> dict[str, bytes]:
    from tests import made_captures as made
    from tests.fuzz.targets import write_recording

    frames = [ls.sensor("ldrobot-stl27l").example("data", seed=seed) for seed in range(4)]
    datagrams = [ls.sensor("velodyne-vlp16").example("data", seed=seed) for seed in range(3)]
    return {
        "stl.bin": b"".join(frames),
        "stl.hex": frames[0].hex(" ").encode(),
        "vlp.pcap": made.pcap(*map(made.frame, datagrams)),
        "stl.lsr": write_recording("ldrobot-stl27l", frames),
        "empty.bin": b"",
        "noise.bin": bytes(range(256)) * 4,
        "scene.toml": b"[room]\nlow=[-3.0,-2.2,-1.2]\nhigh=[4.6,3.1,1.6]\n",
    }
