"""Write the manual pages, and the generated parts of two pages of the reference.

    python docs/command_pages.py          # everything
    python docs/command_pages.py --man    # only the manual pages

`make reference` runs the first command, `make wheels` the second. The manual pages go to docs/man,
which git ignores. In docs/reference/command-line.md (shared options; usage and options of each
verb) and docs/reference/ros2.md (parameters of the node) only the text between the marks is
generated. tests/docs/test_reference_pages.py fails if a generated part is out of date.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections import Counter
from pathlib import Path

import click

from lidarspec import __version__
from lidarspec.cli.root import COMMON_OPTIONS, VERBS, main as root

DOCS = Path(__file__).parent
PAGE = "reference/command-line.md"
NODE = "reference/ros2.md"
BEGIN = "<!--generated-->"
END = "<!--end-->"
SHARED = "Shared options"
#: Options with one meaning in all verbs; they are described once. "output" belongs to verbs that
#: print a result: `-o` of the others has a row of its own.
SHARED_OPTIONS = {
    "sensor": ("-s", "-O", "--calibration"),
    "selection": ("--slice", "--scans", "--every", "--range", "--time"),
    "output": ("--json", "-o"),
}
#: Limits that need no mention: the smallest number that makes sense.
OBVIOUS_LIMIT = re.compile(r"; x>=?[01](?=\])| \[x>=?[01]\]")


def context(verb: str) -> click.Context:
    """Return the context of the verb; of the command itself if the name is ""."""
    top = click.Context(root, info_name="lidarspec", **root.context_settings)
    command = root.get_command(top, verb)
    return click.Context(command, info_name=verb, parent=top) if command else top


def paragraphs(verb: str) -> list[str]:
    """Return the description of the verb, each paragraph in one line."""
    return [
        " ".join(text.split())
        for text in inspect.cleandoc(context(verb).command.help or "").split("\n\n")
    ]


def usage(verb: str) -> str:
    """Return the usage line of the verb."""
    command = context(verb)
    return " ".join([command.command_path, *command.command.collect_usage_pieces(command)])


def options(verb: str) -> list[tuple[str, str]]:
    """Return each option of the verb as typed, with its help text."""
    own = (
        param
        for param in context(verb).command.params
        if isinstance(param, click.Option) and param not in COMMON_OPTIONS
    )
    records = (param.get_help_record(context(verb)) for param in own)
    return [(typed, " ".join(text.split())) for typed, text in filter(None, records)]


def option_name(option: tuple[str, str]) -> str:
    """Return the first name of an option: `-o` of `-o, --output FILE`."""
    return re.split("[ ,]", option[0])[0]


def shared_options() -> dict[str, tuple[str, str]]:
    """Return the options of `SHARED_OPTIONS` by name, with the text that most verbs have."""
    names = {name for group in SHARED_OPTIONS.values() for name in group}
    counts = Counter(option for verb in VERBS for option in options(verb))
    shared: dict[str, tuple[str, str]] = {}
    for option, _ in counts.most_common():
        if option_name(option) in names:
            shared.setdefault(option_name(option), option)
    return shared


def is_shared(option: tuple[str, str]) -> bool:
    """Return whether the shared options describe this option of a verb."""
    name = option_name(option)
    return name == "--json" or shared_options().get(name) == option


def option_list(rows: list[tuple[str, str]]) -> list[str]:
    """Return one line for each option."""
    return [f"* `{typed}`: {OBVIOUS_LIMIT.sub('', text)}" for typed, text in rows]


def shared_lists() -> list[str]:
    """Return the lines that describe the shared options, by group."""
    shared = shared_options()
    lines = []
    for group, names in SHARED_OPTIONS.items():
        lines += [f"{group.capitalize()}:", "", *option_list([shared[name] for name in names]), ""]
    return lines[:-1]


def shared_names(names: list[str]) -> list[str]:
    """Return the names of the shared options; a group's name if all its options are there."""
    words = []
    for group, members in SHARED_OPTIONS.items():
        present = [name for name in members if name in names]
        is_whole = len(present) == len(members)
        words += [group] if is_whole else [f"`{name}`" for name in present]
    return words


def section(verb: str) -> str:
    """Return the generated part of a verb's section.

    Shared options are listed by name only. Of the help, only the first paragraph is printed. The
    usage is printed only if the verb has arguments.
    """
    lines = ["", paragraphs(verb)[0]]
    typed = usage(verb).replace(" [OPTIONS]", "")
    if typed != f"lidarspec {verb}":
        lines = ["", f"`{typed}`", *lines]
    names = [option_name(option) for option in options(verb) if is_shared(option)]
    if names:
        lines += ["", f"[Shared](#shared-options): {', '.join(shared_names(names))}"]
    own = [option for option in options(verb) if not is_shared(option)]
    if own:
        lines += ["", *option_list(own)]
    return "\n".join([BEGIN, *lines, "", END])


def page(text: str) -> str:
    """Return command-line.md with every generated part renewed.

    A verb without a generated part gets one below its heading.
    """
    generated = {verb: section(verb) for verb in VERBS}
    generated[SHARED] = "\n".join([BEGIN, "", *shared_lists(), "", END])
    for title, part in generated.items():
        before, heading, after = text.partition(f"## {title}\n\n")
        rest = re.sub(rf"\A{re.escape(BEGIN)}.*?{re.escape(END)}\n\n?", "", after, flags=re.DOTALL)
        text = f"{before}{heading}{part}\n\n{rest}" if heading else text
    return text


def node(text: str) -> str:
    """Return ros2.md with the current parameters."""
    sys.path.insert(0, str(DOCS.parent / "plugins" / "lidarspec-ros2"))
    from lidarspec_ros2.parameters import PARAMETERS

    rows = []
    for parameter in PARAMETERS:
        name = f"`{parameter.name}`" + ("\\*" if parameter.live else "")
        is_empty = parameter.default in ("", [""], 0.0) and parameter.default is not False
        default = "" if is_empty else f" [default: {json.dumps(parameter.default)}]"
        rows.append(f"* {name}: {parameter.text}{default}")
    before = text.partition(BEGIN)[0]
    after = text.partition(END)[2]
    return "\n".join([f"{before}{BEGIN}", "", *rows, "", f"{END}{after}"])


def manual(verb: str) -> str:
    """Return the manual page of a verb; of the command itself if the name is ""."""
    name = f"lidarspec-{verb}" if verb else "lidarspec"
    description = paragraphs(verb)
    lines = [
        f'.TH {name.upper()} 1 "" "lidarspec {__version__}" "lidarspec"',
        ".SH NAME",
        f"{name} \\- {_roff(description[0])}",
    ]
    lines += [
        ".SH SYNOPSIS",
        _roff(usage(verb)),
        ".SH DESCRIPTION",
        "\n.PP\n".join(map(_roff, description)),
    ]
    terms = [(".SH OPTIONS", options(verb))] if options(verb) else []
    if not verb:
        terms.append(
            (".SH VERBS", [(f"lidarspec-{name}(1)", text) for name, (_, text) in VERBS.items()])
        )
    for heading, items in terms:
        lines += [heading, *(f".TP\n\\fB{_roff(term)}\\fR\n{_roff(text)}" for term, text in items)]
    return "\n".join([*lines, *([".SH SEE ALSO\nlidarspec(1)"] if verb else []), ""])


def _roff(text: str) -> str:
    escaped = text.replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{escaped}" if escaped.startswith((".", "'")) else escaped


def make_manuals() -> dict[str, str]:
    """Return the text of every manual page, by its path under docs."""
    manuals = {f"man/lidarspec-{verb}.1": manual(verb) for verb in VERBS}
    manuals["man/lidarspec.1"] = manual("")
    return manuals


def update_pages() -> dict[str, str]:
    """Return the pages of the reference with their generated parts renewed, by path under docs."""
    return {
        PAGE: page((DOCS / PAGE).read_text(encoding="utf-8")),
        NODE: node((DOCS / NODE).read_text(encoding="utf-8")),
    }


def main() -> None:
    files = make_manuals()
    if "--man" not in sys.argv[1:]:
        files |= update_pages()
    (DOCS / "man").mkdir(exist_ok=True)
    for path, text in files.items():
        (DOCS / path).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
