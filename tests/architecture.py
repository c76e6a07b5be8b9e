"""The layers of the modules, and architecture rules that return violations.

The rules read syntax trees and import nothing.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

#: Modules and packages in the order of the data flow, lowest layer first. A listed module has its
#: own layer, all others have their package's. Imports within functions and for types also count.
LAYERS = (
    "_version notebook_display errors optional_libraries"
    " trusted_files remote_files entry_points known_sensors leap_seconds",
    "transports.protocol",  # what a source is, as values that plugins give too
    "spec",
    "frames",
    "expressions",
    "framing",
    "points",  # functions of a batch of packets: `Packets.points` hands over to them
    "packets",
    "scans",
    "sensor_operations",  # `Sensor`: a description, and the engines as its methods
    "simulation",
    "plugins unfinished_files",
    "spec.__init__ captures recording",  # the names of authors
    "device.named_devices device.session",
    "transports",
    "drafting",
    "detect",
    "device",
    "explaining exports formats view",
    "batch testing",
    "cli",
    "__main__ __init__",
)
LAYER_OF = {name: layer for layer, names in enumerate(LAYERS) for name in names.split()}
IO_LAYER = LAYER_OF["plugins"]
#: packages with a face above their modules.
PACKAGES = {name.removesuffix(".__init__") for name in LAYER_OF if name.endswith(".__init__")}

IO = {"asyncio", "logging", "serial", "socket", "threading", "time"}
#: who may import a library; whoever is not named here may not.
CONFINED = {
    "numba": {"points.numba_kernels.arithmetic", "points.numba_kernels.cache"},
    "llvmlite": {"points.numba_kernels.arithmetic"},
    "construct": {
        "spec.syntax",
        "spec.fields",
        "spec.description",
        "framing.plain_frames",
        "frames.parse",
        "frames.build",
        "frames.encode",
        "frames.plain",
    },
    "pluggy": {"plugins"},
    "serial": {"transports.serial", "transports.ports"},
    "click": {"cli"},
    "rich": {"cli", "view"},
    "starlette": set(),  # these four are for lidarspec-web
    "uvicorn": set(),
    "websockets": set(),
    "anywidget": set(),
    "hypothesis": {"testing"},
    "pytest": {"testing"},
}
_QUOTED = re.compile(r"\"\"\"[\s\S]*?\"\"\"|\'\'\'[\s\S]*?\'\'\'")
_IMPORT = re.compile(
    r"^ *(?:from +[\w.]+ +import +(?:\([^)]*\)|[^\n(#]+)|import +[^\n#]+)", re.MULTILINE
)
_IMPORT_BY_NAME = re.compile(r"\b(?:import_module|__import__)\(\s*[\"']([\w.]+)[\"']")
_TYPING_BLOCK = re.compile(
    r"^( *)if (?:typing\.)?TYPE_CHECKING:\n(?:\1 +.*\n|\s*\n)*", re.MULTILINE
)
#: the one package that asks which of construct's classes something is.
SYNTAX = "lidarspec.spec.syntax"

PLUGINS_MAY_IMPORT = {"construct", "numpy"} | sys.stdlib_module_names
FACES = ("lidarspec", "lidarspec.spec")
#: modules of the core that lidarspec-web imports beside the public names. Keep this list short: a
#: change to one of them may break the page.
PAGE_MAY_IMPORT = {
    "errors",
    "explaining.assignments",
    "explaining.clock_text",
    "explaining.file_contents",
    "explaining.explanation",
    "explaining.input_segments",
    "explaining.formatting",
    "exports.reference",
    "formats",
    "frames.commands",
    "framing.results",
    "packets.clock_monitor",
    "points.conventions",
    "points.appearance",
    "recording.recorder_switch",
    "scans.provenance",
    "spec.arguments",
    "transports.host_clock",
    "transports.open_url",
    "view.live_scans",
    "view.svg",
}


@dataclass(frozen=True)
class Module:
    """A source file: its dotted name, text, and whether it is a package's __init__."""

    name: str
    text: str
    is_package: bool

    @cached_property
    def tree(self) -> ast.Module:
        return ast.parse(self.text, self.name)

    @cached_property
    def code(self) -> str:
        """The text with every triple-quoted string emptied; lines keep their numbers."""
        return _QUOTED.sub(lambda quoted: "\n" * quoted[0].count("\n"), self.text)

    @cached_property
    def imports(self) -> list[tuple[int, str]]:
        """Return line and full dotted name of everything that the module imports.

        Imports at any depth and for types are included. They are found in the text, because parsing
        every module takes ten times as long.
        """
        found = []
        for match in _IMPORT.finditer(self.code):
            line = self.code.count("\n", 0, match.start()) + 1
            (statement,) = ast.parse(match[0].strip()).body
            if isinstance(statement, ast.ImportFrom):
                origin = absolute(self, statement)
                found += [(line, f"{origin}.{alias.name}") for alias in statement.names]
            elif isinstance(statement, ast.Import):
                found += [(line, alias.name) for alias in statement.names]
        for match in _IMPORT_BY_NAME.finditer(self.code):
            found.append((self.code.count("\n", 0, match.start()) + 1, match[1]))
        return found

    @cached_property
    def typing_lines(self) -> set[int]:
        """The lines of `if TYPE_CHECKING` blocks."""
        lines = set[int]()
        for match in _TYPING_BLOCK.finditer(self.code):
            first = self.code.count("\n", 0, match.start()) + 1
            lines.update(range(first, first + match[0].count("\n") + 1))
        return lines


def read(package: Path) -> dict[str, Module]:
    """Return every module of a package, by dotted name."""
    modules = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package.parent).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        name = ".".join(parts[:-1] if is_package else parts)
        modules[name] = Module(name, path.read_text(encoding="utf-8"), is_package)
    return modules


def name_of(expression: ast.expr) -> str:
    """Return the last part of a dotted name; empty for any other expression."""
    match expression:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name
    return ""


def absolute(module: Module, node: ast.ImportFrom) -> str:
    """Return the dotted name that `from ...x import` refers to."""
    if not node.level:
        return str(node.module)
    parts = module.name.split(".")
    base = parts[: len(parts) - node.level + module.is_package]
    return ".".join([*base, node.module] if node.module else base)


def resolve(name: str, modules: Mapping[str, Module]) -> str | None:
    """Return the module that contains an imported name; None for a name outside the tree."""
    while name not in modules:
        name, dot, _ = name.rpartition(".")
        if not dot:
            return None
    return name


def layer(name: str) -> int | None:
    """Return the layer of a module: its own, otherwise its package's, otherwise None."""
    inside = name.partition(".")[2] or "__init__"
    if inside in PACKAGES:
        inside = f"{inside}.__init__" if f"{inside}.__init__" in LAYER_OF else inside
    while inside not in LAYER_OF and "." in inside:
        inside = inside.rpartition(".")[0]
    return LAYER_OF.get(inside)


def find_upward_imports(modules: Mapping[str, Module]) -> list[str]:
    """Return modules without a layer, imports from a higher layer, and the first cycle.

    Imports for types are included.
    """
    complaints = [
        f"{name} has no layer: add it to LAYERS" for name in modules if layer(name) is None
    ]
    graph: dict[str, set[str]] = {name: set() for name in modules}
    for module in modules.values():
        here = layer(module.name)
        for line, imported in module.imports:
            target = resolve(imported, modules)
            if target is None or target == module.name:
                continue
            graph[module.name].add(target)
            there = layer(target)
            if here is not None and there is not None and there > here:
                complaints.append(
                    f"{module.name}:{line} (layer {here}) imports {target} (layer {there})"
                )
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as circle:
        complaints.append("circle: " + " imports ".join(reversed(circle.args[1])))
    return complaints


def find_misplaced_imports(modules: Mapping[str, Module]) -> list[str]:
    """Return imports for I/O below the I/O layer, and of optional libraries elsewhere."""
    complaints = []
    for module in modules.values():
        here = layer(module.name)
        inside = module.name.partition(".")[2]
        for line, imported in module.imports:
            if line in module.typing_lines:
                continue
            library = imported.partition(".")[0]
            if library in IO and here is not None and here < IO_LAYER:
                complaints.append(f"{module.name}:{line} imports {library} below layer {IO_LAYER}")
            allowed = CONFINED.get(library)
            if allowed is not None and not any(
                inside == name or inside.startswith(f"{name}.") for name in allowed
            ):
                complaints.append(
                    f"{module.name}:{line} imports {library}, which is for"
                    f" {', '.join(sorted(allowed))}"
                )
    return complaints


def find_construct_checks(modules: Mapping[str, Module]) -> list[str]:
    """Return type checks for construct's classes outside construct's layer."""
    complaints = []
    for module in modules.values():
        if f"{module.name}.".startswith(f"{SYNTAX}."):
            continue
        if "construct" not in module.text or "isinstance" not in module.text:
            continue
        froms = [
            node
            for node in ast.walk(module.tree)
            if isinstance(node, ast.ImportFrom) and node.module == "construct"
        ]
        names = {alias.asname or alias.name for node in froms for alias in node.names}
        for node in ast.walk(module.tree):
            if not isinstance(node, ast.Call) or name_of(node.func) != "isinstance":
                continue
            asked = {
                ast.unparse(part)
                for part in ast.walk(node.args[1])
                if isinstance(part, ast.Name | ast.Attribute)
            }
            if asked & names or any(name.startswith("construct.") for name in asked):
                complaints.append(f"{module.name}:{node.lineno} asks for a class of construct's")
    return complaints


def find_private_imports(
    modules: Mapping[str, Module], public: Mapping[str, Collection[str]]
) -> list[str]:
    """Return the imports of a plugin that are not permitted.

    Permitted are public names of `lidarspec` and `lidarspec.spec`, numpy, construct and the
    standard library.

    Args:
        public: the names of each of these two modules.
    """
    known = {*public, *(f"{face}.{name}" for face, names in public.items() for name in names)}
    complaints = []
    for module in modules.values():
        own = module.name.partition(".")[0]
        for line, imported in module.imports:
            library = imported.partition(".")[0]
            if library == "lidarspec" and imported not in known:
                complaints.append(f"{module.name}:{line} imports {imported}, which is not public")
            elif library not in PLUGINS_MAY_IMPORT | {own, "lidarspec"}:
                complaints.append(f"{module.name}:{line} imports {library}")
        used = [
            (line, name) for line, name in attributes(module) if name not in public["lidarspec"]
        ]
        complaints += [
            f"{module.name}:{line} uses {name}, which is not public" for line, name in used
        ]
    return complaints


def core_modules(
    modules: Mapping[str, Module], core: Mapping[str, Module], public: Mapping[str, Collection[str]]
) -> set[str]:
    """Return the modules of the core that a program imports in addition to public names.

    Args:
        public: the names of `lidarspec` and of `lidarspec.spec`.
    """
    faces = {f"{face}.{name}" for face, names in public.items() for name in names}
    imported = {name for module in modules.values() for _, name in module.imports}
    inside = {resolve(name, core) for name in imported - faces} - {None, *public}
    return {str(name).removeprefix("lidarspec.") for name in inside}


def attributes(module: Module) -> Iterator[tuple[int, str]]:
    """Yield the line and name of every attribute that is read from lidarspec itself."""
    nodes = list(ast.walk(module.tree))
    imported = [alias for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    aliases = [alias for alias in imported if alias.name == "lidarspec"]
    bound = {alias.asname or alias.name for alias in aliases}
    for node in nodes:
        if (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id in bound
        ):
            yield node.lineno, node.attr


def name_pattern(name: str) -> re.Pattern[str]:
    """Return a pattern for a vendor, model or id as a word, with any separator.

    A word of one or two characters matches only in its own case, and not at the end of another
    name.
    """
    parts = [re.escape(part) for part in re.split(r"[\W_]+", name) if part]
    before, flags = (
        (r"(?<![^\W_])", re.IGNORECASE) if len(name) > 2 else (r"(?<![^\W_]|-)", re.NOFLAG)
    )
    return re.compile(before + r"[\W_]?".join(parts) + r"(?![^\W_])", flags)


def named_sensors(modules: Mapping[str, Module], names: Collection[str]) -> list[str]:
    """Return the places where a module names a sensor, by its id, vendor or model."""
    complaints, letters = [], re.compile(r"[\W_]+")
    sought = {name: letters.sub("", name).lower() for name in names}
    for module in modules.values():
        # A name that is missing in the joined letters needs no search.
        run = letters.sub("", module.text).lower()
        for name in (name for name, joined in sought.items() if joined in run):
            if found := name_pattern(name).search(module.text):
                complaints.append(
                    f"{module.name}:{module.text.count(chr(10), 0, found.start()) + 1} names {name}"
                )
    return complaints
