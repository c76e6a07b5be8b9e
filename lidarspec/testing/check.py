"""Check a sensor, a file or a distribution with every property and every rule.

`find_target` finds the sensors to check, and `iter_reports` checks them. `check_texts` searches a
plugin's source for code that is valid Python but a mistake, such as `if this.n == 1`.
"""

from __future__ import annotations

import ast
import functools
import importlib.util
import inspect
import re
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lidarspec.entry_points import GROUP, SENSORS, EntryPoint, entry_points
from lidarspec.errors import SourceError, SpecError, UnknownSensor
from lidarspec.plugins import (
    Registry,
    import_file,
    no_sensors_error,
    registry,
    require_sensor,
    split_file_and_id,
)
from lidarspec.sensor_operations import Sensor
from lidarspec.testing.declaration import check_declaration
from lidarspec.testing.findings import Finding, list_unacknowledged
from lidarspec.testing.properties import PROPERTIES
from lidarspec.testing.sensor_under_test import EXAMPLES, SensorUnderTest
from lidarspec.testing.vectors import describe_missing_vectors
from lidarspec.trusted_files import read_document

#: Name of a file of golden vectors.
VECTORS = "vectors.json"
#: Rules about the hooks of a plugin. A finding with one of these rules has the plugin's name as its
#: path.
HOOK_RULES = frozenset({"LS002", "LS003", "LS004"})


@dataclass(eq=False)
class CheckTarget:
    """The sensors to check.

    Attributes:
        sensors: the sensors that could be loaded.
        findings: the reasons why sensors could not be loaded.
        files: the modules that declare the sensors.
        vectors: the file of golden vectors; None if there is no such file.
        family: the ids of all sensors of the checked file or distribution, which share the file of
            vectors.
    """

    sensors: list[Sensor] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    vectors: Path | None = None
    family: tuple[str, ...] = ()


def find_target(text: str | Path) -> CheckTarget:
    """Return the sensors that `lidarspec check` checks for a name.

    Args:
        text: a file, a sensor of a file ("FILE.py:id"), the id or alias of an installed sensor, a
            distribution, or the folder of a distribution.

    Raises:
        SourceError: for a file that does not exist, or for a folder if the distribution is not
            installed from this folder.
        UnknownSensor: for any other name.
    """
    name = str(text)
    if (Path(name) / "pyproject.toml").is_file():
        return _find_folder_target(Path(name))
    file, wanted = split_file_and_id(name)
    if "/" in name or "\\" in name or file.suffix == ".py":
        return _find_file_target(file, wanted)
    entries = _find_entry_points(name)
    if entries:
        return _find_distribution_target(entries)
    try:
        sensor = registry().sensor(name)
    except UnknownSensor as error:
        if not error.failure:
            raise
        # The distribution failed to load: its findings name the line and what to change.
        return _find_distribution_target(_find_entry_points(error.distribution))
    homes = [plugin for plugin in registry().plugins if sensor.id in plugin.sensors]
    files = [
        file
        for plugin in homes
        for file in find_module_files(plugin.entry_point.partition(" = ")[2])
    ]
    family = [
        sensor_id
        for plugin in registry().plugins
        if plugin.distribution in {home.distribution for home in homes}
        for sensor_id in plugin.sensors
    ]
    return CheckTarget(
        [sensor], _check_rivals([sensor]), files, _find_vectors(files), tuple(family)
    )


def _find_file_target(file: Path, wanted: str) -> CheckTarget:
    target = CheckTarget(files=[file], vectors=_find_vectors([file]))
    try:
        target.sensors = _load_sensors(import_file(file), str(file))
        target.family = tuple(sensor.id for sensor in target.sensors[1:] and target.sensors)
        target.findings += _check_taken_ids(target.sensors, file)
        if not target.sensors:
            raise no_sensors_error()
    except SourceError:
        raise
    except (Exception, SystemExit) as error:
        target.findings.append(describe_loading_error(error, [file]))
        target.files = target.files if _is_readable(file) else []
        return target
    ids = [sensor.id for sensor in target.sensors]
    target.sensors = [sensor for sensor in target.sensors if wanted in ("", sensor.id)]
    if not target.sensors:
        raise UnknownSensor(wanted, ids, place=str(file))
    return target


def _find_folder_target(folder: Path) -> CheckTarget:
    """Return the target of the distribution whose source is in a folder."""
    file = folder / "pyproject.toml"
    project = read_document(file).get("project")
    if isinstance(project, dict):
        name = project.get("name")
    else:
        name = None
    if not isinstance(name, str):
        raise SourceError(f"{file} contains no name of a project")
    entries = _find_entry_points(name)
    if not entries:
        raise SourceError(f"{name} is not installed, or has no sensors: pip install -e {folder}")
    elsewhere = [
        module
        for entry in entries
        for module in find_module_files(entry.value)
        if folder.resolve() not in module.resolve().parents
    ]
    if elsewhere:
        raise SourceError(
            f"the installed {name} contains the module {elsewhere[0]}, which is not in {folder}:"
            f" run pip install -e {folder}"
        )
    return _find_distribution_target(entries)


def _find_vectors(files: Iterable[Path]) -> Path | None:
    """Return the file of golden vectors of some modules; None if it does not exist."""
    beside = dict.fromkeys(file.resolve().parent for file in files)
    sources = [
        home
        for folder in beside
        for home in (folder, *folder.parents[:2])
        if (home / "pyproject.toml").is_file()
    ]
    folders = [*beside, *sources, *(home / "tests" for home in sources)]
    return next((folder / VECTORS for folder in folders if (folder / VECTORS).is_file()), None)


def _find_entry_points(distribution: str) -> list[EntryPoint]:
    """Return a distribution's entry points for modules with hooks and for sensors."""
    entries = [*entry_points(GROUP), *entry_points(SENSORS)]
    return [
        entry for entry in entries if _normalize(entry.distribution) == _normalize(distribution)
    ]


def _find_distribution_target(entries: list[EntryPoint]) -> CheckTarget:
    target = CheckTarget()
    sensor_entries = entry_points(SENSORS)
    for entry in entries:
        try:
            plugin = entry.load()
            if entry in sensor_entries:
                require_sensor(entry, plugin)
            sensors = _load_sensors(plugin, entry.value)
        except (Exception, SystemExit) as error:
            finding = describe_loading_error(error, find_module_files(entry.value))
            target.findings.append(
                replace(finding, path=finding.path or f"{entry.name} = {entry.value}")
            )
            continue
        target.files += [
            file for file in find_module_files(entry.value) if file not in target.files
        ]
        target.sensors += [
            sensor for sensor in sensors if sensor.id not in {other.id for other in target.sensors}
        ]
    target.vectors = _find_vectors(target.files)
    target.family = tuple(sensor.id for sensor in target.sensors)
    names = {_normalize(entry.distribution) for entry in entries}
    failing = [
        plugin
        for plugin in registry().plugins
        if _normalize(plugin.distribution) in names and plugin.rule == "LS010"
    ]
    target.findings += [Finding("LS010", plugin.error, plugin.entry_point) for plugin in failing]
    target.findings += _check_rivals(target.sensors)
    return target


def _check_rivals(sensors: list[Sensor]) -> list[Finding]:
    """Return a finding for each id or alias that several plugins use."""
    names = {name for sensor in sensors for name in (sensor.id, *sensor.aliases)}
    refused = [
        plugin
        for plugin in registry().plugins
        if plugin.rule == "LS005" and plugin.failed_sensor in names
    ]
    return [
        Finding("LS005", f"{plugin.distribution}: {plugin.error}", plugin.entry_point)
        for plugin in refused
    ]


def _check_taken_ids(sensors: list[Sensor], file: Path) -> list[Finding]:
    """Return a finding for each id in a file that an installed sensor already has."""
    return [
        Finding(
            "LS005",
            f"the installed {plugin.distribution} has a sensor with this id ({plugin.entry_point})",
            "",
            sensor.id,
        )
        for sensor in sensors
        for plugin in registry().plugins
        if sensor.id in plugin.sensors
        and not any(
            file.samefile(own) for own in find_module_files(plugin.entry_point.partition(" = ")[2])
        )
    ]


def _load_sensors(plugin: Any, name: str) -> list[Sensor]:
    """Return the sensors of one plugin, changed by the hooks of all plugins.

    Raises:
        Exception: any error of the plugin.
    """
    if isinstance(plugin, Sensor):
        return [registry().apply_hooks(plugin)]
    local = Registry()
    ids = local.add(plugin, name=name)
    sensors = [local.sensor(sensor_id) for sensor_id in ids]
    hook: Any = getattr(plugin, "lidarspec_checksum", None)
    for sensor in sensors if callable(hook) else []:
        for frame in sensor.frames.values():
            given = {"sensor": sensor, "frame": frame}
            try:
                hook(**{key: given[key] for key in inspect.signature(hook).parameters})
            except Exception as error:
                raise SpecError(
                    f"lidarspec_checksum for {sensor.id}: {type(error).__name__}: {error}",
                    rule="LS010",
                ) from error
    return [registry().apply_hooks(sensor) for sensor in sensors]


def describe_loading_error(error: BaseException, files: list[Path]) -> Finding:
    """Return the finding for an error that loading a plugin has raised."""
    if isinstance(error, SpecError) and error.__cause__ is not None:
        cause = error.__cause__
    else:
        cause = error
    locations = [
        (location.filename, location.lineno or 0)
        for each in (error, cause)
        for location in traceback.extract_tb(each.__traceback__)
    ]
    own = [
        location
        for location in locations
        if any(Path(location[0]) == file.resolve() or Path(location[0]) == file for file in files)
    ]
    if isinstance(cause, SyntaxError) and cause.filename:
        own = [(cause.filename, cause.lineno or 0)]
    file, line = own[-1] if own else (str(files[0]) if len(files) == 1 else "", 0)
    if isinstance(error, SpecError) and error.rule and error.rule not in HOOK_RULES:
        path = error.path
    else:
        path = ""
    sensor = getattr(error, "sensor", "")
    if isinstance(error, SpecError) and cause is error:
        text = error.reason
    else:
        text = f"{type(cause).__name__}: {cause}"
    return Finding(
        _find_loading_rule(error, cause), " ".join(text.split()), path, sensor, file, line
    )


def _find_loading_rule(error: BaseException, cause: BaseException) -> str:
    """Return the code of the rule for an error that occurred while loading a plugin."""
    functions = [location.name for location in traceback.extract_tb(cause.__traceback__)]
    if isinstance(error, SpecError) and error.rule:
        return error.rule
    if "sizeof" in functions or "_sizeof" in functions:
        return "LS008"
    if isinstance(cause, SpecError):
        return cause.rule or "LS007"
    if "lidarspec_sensors" in functions:
        return "LS006"
    return "LS001"


def find_module_files(value: str) -> list[Path]:
    """Return the source files of the module or package of an entry point, if any."""
    try:
        module = importlib.util.find_spec(value.partition("[")[0].partition(":")[0].strip())
    except (Exception, SystemExit):
        return []
    if module is None or not module.origin or not module.origin.endswith(".py"):
        return []
    file = Path(module.origin)
    if file.name == "__init__.py":
        return sorted(file.parent.rglob("*.py"))
    return [file]


def _is_readable(file: Path) -> bool:
    """Return whether a file is valid Python."""
    try:
        compile(file.read_text(encoding="utf-8"), str(file), "exec")
    except (SyntaxError, ValueError):
        return False
    return True


def _normalize(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


Location = tuple[str, int]


class SourceTexts:
    """Finds the file and line of declarations in the source of some modules."""

    def __init__(self, trees: Mapping[str, ast.Module]) -> None:
        self._iter_fields = [
            (chain, (file, line))
            for file, tree in trees.items()
            for chain, line in _iter_fields(tree, ())
        ]
        self._others: dict[tuple[str, str], Location] = {}
        for file, tree in trees.items():
            for kind, name, line in _iter_names(tree):
                self._others.setdefault((kind, name), (file, line))

    def locate(self, finding: Finding, sensor: Sensor | None = None) -> Finding:
        """Return the finding, with its file and line if they can be found."""
        if finding.file:
            return finding
        location = self._find_location(finding.path, sensor) or (
            self._others.get(("sensor", sensor.id)) if sensor else None
        )
        if location:
            return replace(finding, file=location[0], line=location[1])
        return finding

    def _find_location(self, path: str, sensor: Sensor | None) -> Location | None:
        path = re.sub(r"\[\d*\]", "", path.rpartition(" ")[2])
        frame, _, below = path.partition(".")
        if frame == "commands":
            return self._others.get(("key", below.partition(".")[0]))
        return (
            _find_function(frame, below, sensor)
            or (self._find_field(tuple(below.split("."))) if below else None)
            or self._others.get(("frame", frame))
        )

    def _find_field(self, parts: tuple[str, ...]) -> Location | None:
        """Return the location of a field in the source; None if there is no such field."""
        fitting = [
            (len(chain), location)
            for chain, location in self._iter_fields
            if parts[-len(chain) :] == chain
        ]
        if fitting:
            return max(fitting, key=lambda match: match[0])[1]
        return None


def _find_function(frame: str, name: str, sensor: Sensor | None) -> Location | None:
    """Return the location of a function of a frame type."""
    if sensor is None or frame not in sensor.frames:
        return None
    own = sensor.frames[frame]
    simulated = sensor.simulation_of(frame)
    functions = {
        "points": own.points or sensor.points,
        "plausible": own.plausible,
        "sweep": simulated.sweep,
    }
    function = {**functions, "directions": simulated.directions}.get(name)
    while isinstance(function, functools.partial):
        function = function.func
    if inspect.isfunction(function):
        return (function.__code__.co_filename, function.__code__.co_firstlineno)
    return None


def _iter_names(tree: ast.Module) -> Iterator[tuple[str, str, int]]:
    """Yield (kind, name, line) of each text that may name a part of a sensor."""
    for node in ast.walk(tree):
        match node:
            case ast.Dict(keys=keys, values=values):
                for key, value in zip(keys, values, strict=True):
                    if isinstance(key, ast.Constant) and isinstance(key.value, str):
                        yield "key", key.value, key.lineno
                        if isinstance(value, ast.Call) and ast.unparse(value.func).endswith(
                            ("Frame", "replace")
                        ):
                            yield "frame", key.value, key.lineno
            case ast.Call(args=[ast.Constant(value=str(name)), *_]):
                yield "sensor", name, node.lineno
            case ast.keyword(arg="id", value=ast.Constant(value=str(name))):
                yield "sensor", name, node.value.lineno


def _iter_fields(node: ast.AST, chain: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], int]]:
    """Yield (names of the path, line) for each expression ``"name" / construct``."""
    match node:
        case ast.BinOp(op=ast.Div(), left=ast.Constant(value=str(name)), right=right):
            yield (*chain, name), node.lineno
            yield from _iter_fields(right, (*chain, name))
        case _:
            for child in ast.iter_child_nodes(node):
                yield from _iter_fields(child, chain)


#: Calls that read the system clock.
WALL_CLOCKS = frozenset(
    [
        "time.time",
        "time.time_ns",
        "datetime.now",
        "datetime.utcnow",
        "datetime.today",
        "datetime.datetime.now",
        "datetime.datetime.utcnow",
    ]
)
BROAD_EXCEPTIONS = frozenset({"Exception", "BaseException"})


def check_texts(trees: Mapping[str, ast.Module]) -> list[Finding]:
    """Return the findings in the source of some modules.

    Args:
        trees: file name -> its syntax tree.
    """
    return [
        Finding(code, what, file=file, line=node.lineno)
        for file, tree in trees.items()
        for code, what, node in _iter_mistakes(tree)
    ]


def _iter_mistakes(
    tree: ast.Module,
) -> Iterator[tuple[str, str, ast.expr | ast.stmt | ast.ExceptHandler]]:
    expressions = _find_expression_names(tree)
    sockets = any(
        isinstance(node, ast.Import | ast.ImportFrom) and "socket" in ast.unparse(node)
        for node in ast.walk(tree)
    )
    for node in ast.walk(tree):
        match node:
            case ast.ExceptHandler() if (
                node.type is None or _collect_names(node.type) & BROAD_EXCEPTIONS
            ) and _is_silent(node.body):
                yield (
                    "LS801",
                    f"`{_format_handler(node)}` ignores the exception",
                    node,
                )
            case ast.Call() if ast.unparse(node.func) in WALL_CLOCKS:
                yield "LS802", f"{ast.unparse(node.func)}()", node
            case ast.Call(func=ast.Name(id="hasattr"), args=[ast.Name(id=name), *_]) if (
                name in expressions
            ):
                yield "LS805", ast.unparse(node), node
            case ast.Expr(value=ast.Call() as call) if _is_short_write(call, sockets=sockets):
                yield "LS803", f"the result of {ast.unparse(call.func)} is not used", node
        for test in _list_tests(node):
            if _is_expression(test, expressions):
                yield (
                    "LS804",
                    f"`{ast.unparse(test)}` is an expression of construct, which Python always"
                    " treats as true",
                    test,
                )


def _format_handler(handler: ast.ExceptHandler) -> str:
    """Return the first two lines of an exception handler as one line."""
    kind = f" {ast.unparse(handler.type)}" if handler.type else ""
    return f"except{kind}: {ast.unparse(handler.body[0])}"


def _find_expression_names(tree: ast.Module) -> set[str]:
    """Return the names under which a module imports construct's `this`, `obj_` and `len_`."""
    imported = [
        alias
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "construct"
        for alias in node.names
    ]
    return {
        alias.asname or alias.name for alias in imported if alias.name in ("this", "obj_", "len_")
    }


def _list_tests(node: ast.AST) -> list[ast.expr]:
    """Return the conditions of a syntax node, for example of `if`, `while` or `and`."""
    match node:
        case (
            ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test) | ast.Assert(test=test)
        ):
            return [test]
        case ast.BoolOp(values=values):
            return values
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return [operand]
    return []


def _is_expression(test: ast.expr, names: set[str]) -> bool:
    """Return whether a condition is a construct expression, and thus always true."""
    return not isinstance(test, ast.BoolOp | ast.Call) and bool(_collect_names(test) & names)


def _collect_names(tree: ast.AST) -> set[str]:
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def _is_silent(body: list[ast.stmt]) -> bool:
    """Return whether an exception handler ignores the exception."""
    match body:
        case [ast.Pass() | ast.Continue() | ast.Expr(value=ast.Constant())]:
            return True
        case [ast.Return(value=None | ast.Constant() | ast.List() | ast.Dict() | ast.Tuple())]:
            return True
    return False


def _is_short_write(call: ast.Call, *, sockets: bool) -> bool:
    """Return whether a call may write only a part of its data without an error."""
    match call.func:
        case ast.Attribute(value=ast.Name(id="os"), attr="write"):
            return True
        case ast.Attribute(attr="send"):
            return sockets and len(call.args) == 1 and not isinstance(call.args[0], ast.Constant)
    return False


#: Rules whose violation makes it impossible to test properties.
FATAL_RULES = frozenset({"LS213", "LS114", "LS115", "LS301"})


#: Called with the name of the current step, the number of finished properties and the total number
#: of properties.
Watch = Callable[[str, int, int], None]


@dataclass(eq=False)
class Report:
    """The result of a check.

    Attributes:
        name: the sensor's id, or the checked name if the report is about loading errors.
        findings: the findings.
        skipped: property -> the reason why it does not apply.
        measured: quantity that was measured for frames -> result as text.
        picture: quantity that was measured for points -> result as text, for example "data: rate"
            -> "4500 points per second, simulated". The author compares the results with the manual.
    """

    name: str
    findings: list[Finding]
    held: int = 0
    skipped: dict[str, str] = field(default_factory=dict)
    measured: dict[str, str] = field(default_factory=dict)
    picture: dict[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as a JSON object."""
        return {**vars(self), "findings": [finding.to_dict() for finding in self.findings]}


def iter_reports(
    target: CheckTarget,
    name: str,
    *,
    examples: int = EXAMPLES,
    strategies: Mapping[str, Any] | None = None,
    vectors: Path | None = None,
    tested: Sequence[Sensor] = (),
    watch: Watch = lambda text, done, total: None,
) -> Iterator[Report]:
    """Yield a report of each sensor, and a report of loading errors if there are any.

    Args:
        name: the checked name, as the user typed it.
        examples: number of examples of each frame type for each property.
        strategies: "frame.field" -> a hypothesis strategy or function for its raw value. It is
            needed for fields whose valid values cannot be derived from the spec.
        vectors: the file of golden vectors; by default the file of the target.
        tested: related models; parts that they share with a sensor are not tested again.
        watch: called before each step with its name, the number of finished properties and the
            total number of properties.
    """
    trees = {
        str(file): ast.parse(file.read_text(encoding="utf-8"), str(file)) for file in target.files
    }
    source_texts = SourceTexts(trees)
    sensors_by_id = {sensor.id: sensor for sensor in target.sensors}
    mistakes = [
        source_texts.locate(finding, sensors_by_id.get(finding.sensor))
        for finding in target.findings
    ] + check_texts(trees)
    single = [sensor for sensor in target.sensors if len(target.sensors) == 1]
    if mistakes and not single:
        yield Report(name, mistakes)
    total = len(PROPERTIES) * len(target.sensors)
    for index, sensor in enumerate(target.sensors):
        family = () if vectors and single else target.family
        subject = SensorUnderTest(
            sensor, examples, strategies or {}, vectors or target.vectors, family, tested
        )
        before = len(PROPERTIES) * index
        yield _make_report(
            subject,
            source_texts,
            mistakes if single else [],
            functools.partial(_watch_sensor, watch, before, total),
        )


def _watch_sensor(watch: Watch, before: int, total: int, text: str, done: int) -> None:
    """Report the progress of one sensor as progress of the whole check."""
    watch(text, before + done, total)


def _iter_reference_facts(subject: SensorUnderTest) -> Iterator[tuple[str, str]]:
    """Yield (name, text) of declared facts to compare with the measured values."""
    sensor = subject.sensor
    missing = describe_missing_vectors(subject)
    if missing:
        yield (
            "vectors",
            f"{missing}; to verify these values, add vectors with points in two quadrants",
        )
    yield (
        "vendor_axes",
        f"x, y, z are {', '.join(sensor.vendor_axes)}" if sensor.vendor_axes else "not declared",
    )
    yield "source", sensor.source


def _watch_case(watch: Callable[[str, int], None], sensor_id: str, done: int, case: str) -> None:
    """Report the progress before a case of a property is tested."""
    watch(f"{sensor_id}: {case}", done)


def _make_report(
    subject: SensorUnderTest,
    source_texts: SourceTexts,
    mistakes: list[Finding],
    watch: Callable[[str, int], None],
) -> Report:
    sensor: Sensor = subject.sensor
    report = Report(sensor.id, list(mistakes))
    if not sensor.frames:
        report.skipped["all properties"] = "the sensor has no frames without its configuration file"
        return report
    watch(f"{sensor.id}: declaration", 0)
    report.findings += check_declaration(subject)
    is_whole = not subject.tested  # whether all rules were checked
    for done, tested_property in enumerate(PROPERTIES):
        violated = sorted(
            {finding.code for finding in list_unacknowledged(report.findings, sensor, whole=False)}
            & set(tested_property.unless)
        )
        reason = tested_property.lacks(subject) or (
            f"not tested because of {', '.join(violated)}" if violated else ""
        )
        is_whole = is_whole and not violated
        if reason:
            report.skipped[tested_property.name] = reason
            continue
        findings = tested_property.findings(
            subject, functools.partial(_watch_case, watch, sensor.id, done)
        )
        report.held += not findings
        report.findings += findings
        fatal = sorted({finding.code for finding in report.findings} & FATAL_RULES)
        if fatal:
            report.skipped |= {
                remaining.name: f"not tested because of {', '.join(fatal)}"
                for remaining in PROPERTIES[done + 1 :]
            }
            is_whole = False
            break
    distinct = list(
        {(finding.code, finding.path): finding for finding in reversed(report.findings)}.values()
    )[::-1]
    left = list_unacknowledged(distinct, sensor, whole=is_whole)
    report.findings = [source_texts.locate(finding, sensor) for finding in left]
    report.measured = subject.measured
    report.picture = subject.picture and {
        **dict(sorted(subject.picture.items())),
        **dict(_iter_reference_facts(subject)),
    }
    return report
