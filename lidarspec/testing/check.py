"""`lidarspec check` without the command line: every property and every rule over a sensor, a file
or a distribution.

A name is made a `Target` first: the sensors that it stands for, what kept others from being loaded,
and the modules that they are written in. The text of these modules is read twice: for mistakes that
show in it alone (what Python accepts, and what then does something else than it says), and for
where fields, frames, functions, commands and sensors stand, so that a finding names file and line
(`Places`). Then each sensor is held to its declaration and to the properties of `properties`, in
their order, and what it acknowledges is left out of the `Report`.
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
from lidarspec.plugins import Registry, file_and_id, file_module, registry
from lidarspec.sensor_operations import Sensor
from lidarspec.testing.declared import check_declaration
from lidarspec.testing.findings import Finding, left_over
from lidarspec.testing.properties import PROPERTIES
from lidarspec.testing.subject import EXAMPLES, Subject
from lidarspec.testing.vectors import lacking
from lidarspec.trust import document

#: the name of a file of golden vectors.
VECTORS = "vectors.json"
#: what the registry says -> the rule.
SAID = (
    ("there is no hook", "LS002"),
    ("lacks @hookimpl", "LS003"),
    ("another sensor has this id", "LS005"),
    ("returns sensors, not", "LS006"),
    ("that returns a sensor", "LS006"),
    ("definition", "LS004"),
    ("lidarspec_checksum for", "LS010"),
    ("max_length may be left out", "LS009"),
)


@dataclass(eq=False)
class Target:
    """Something to check.

    Attributes:
        sensors: that were found in it.
        findings: what kept others from being found.
        files: the modules that it is written in.
        vectors: its golden vectors: beside its modules, or in the folder of its distribution's
            source or the tests there.
        family: the ids of the sensors that share them: of the file, or of the whole distribution.
    """

    sensors: list[Sensor] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    vectors: Path | None = None
    family: tuple[str, ...] = ()


def target(text: str | Path) -> Target:
    """What a name stands for: a file, one sensor of it ("FILE.py:id"), the id or alias of an
    installed one, a distribution or its folder.

    Raises:
        SourceError: for a file that is not there, and for the folder of a distribution that is not
            installed.
        UnknownSensor: for a name that is nothing of all this.
    """
    name = str(text)
    if (Path(name) / "pyproject.toml").is_file():
        return _folder(Path(name))
    file, wanted = file_and_id(name)
    if "/" in name or "\\" in name or file.suffix == ".py":
        return _file(file, wanted)
    entries = _entries(name)
    if entries:
        return _distribution(entries)
    sensor = registry().sensor(name)
    homes = [plugin for plugin in registry().plugins if sensor.id in plugin.sensors]
    files = [
        file for plugin in homes for file in module_files(plugin.entry_point.partition(" = ")[2])
    ]
    family = [
        one
        for plugin in registry().plugins
        if plugin.distribution in {home.distribution for home in homes}
        for one in plugin.sensors
    ]
    return Target([sensor], _rivals([sensor]), files, _vectors(files), tuple(family))


def _file(file: Path, wanted: str) -> Target:
    found = Target(files=[file], vectors=_vectors([file]))
    try:
        found.sensors = _load_sensors(file_module(file), str(file))
        found.family = tuple(sensor.id for sensor in found.sensors[1:] and found.sensors)
        found.findings += _holders(found.sensors, file)
        if not found.sensors:
            raise SpecError(
                "there is no function lidarspec_sensors, marked @hookimpl, that returns a sensor"
            )
    except SourceError:
        raise
    except (Exception, SystemExit) as error:
        found.findings.append(loading(error, [file]))
        found.files = found.files if _readable(file) else []
        return found
    ids = [sensor.id for sensor in found.sensors]
    found.sensors = [sensor for sensor in found.sensors if wanted in ("", sensor.id)]
    if not found.sensors:
        raise UnknownSensor(wanted, ids, place=str(file))
    return found


def _folder(folder: Path) -> Target:
    """The distribution whose source is in a folder."""
    file = folder / "pyproject.toml"
    project = document(file).get("project")
    if isinstance(project, dict):
        name = project.get("name")
    else:
        name = None
    if not isinstance(name, str):
        raise SourceError(f"{file} names no project")
    entries = _entries(name)
    if not entries:
        raise SourceError(f"{name} is not installed, or has no sensors: pip install -e {folder}")
    return _distribution(entries)


def _vectors(files: Iterable[Path]) -> Path | None:
    """The golden vectors of some modules."""
    beside = dict.fromkeys(file.resolve().parent for file in files)
    sources = [
        home
        for folder in beside
        for home in (folder, *folder.parents[:2])
        if (home / "pyproject.toml").is_file()
    ]
    folders = [*beside, *sources, *(home / "tests" for home in sources)]
    return next((folder / VECTORS for folder in folders if (folder / VECTORS).is_file()), None)


def _entries(distribution: str) -> list[EntryPoint]:
    """What a distribution adds: modules with hooks, and sensors by id and alias."""
    entries = [*entry_points(GROUP), *entry_points(SENSORS)]
    return [entry for entry in entries if _normal(entry.distribution) == _normal(distribution)]


def _distribution(entries: list[EntryPoint]) -> Target:
    found = Target()
    for entry in entries:
        try:
            sensors = _load_sensors(entry.load(), entry.value)
        except (Exception, SystemExit) as error:
            finding = loading(error, module_files(entry.value))
            found.findings.append(
                replace(finding, path=finding.path or f"{entry.name} = {entry.value}")
            )
            continue
        found.files += [file for file in module_files(entry.value) if file not in found.files]
        found.sensors += [
            sensor for sensor in sensors if sensor.id not in {one.id for one in found.sensors}
        ]
    found.vectors = _vectors(found.files)
    found.family = tuple(sensor.id for sensor in found.sensors)
    names = {_normal(entry.distribution) for entry in entries}
    failing = [
        plugin
        for plugin in registry().plugins
        if _normal(plugin.distribution) in names and _strip_markup(plugin.error) == "LS010"
    ]
    found.findings += [Finding("LS010", plugin.error, plugin.entry_point) for plugin in failing]
    found.findings += _rivals(found.sensors)
    return found


def _rivals(sensors: list[Sensor]) -> list[Finding]:
    """The plugins that were refused because of a name of these sensors, or that these were refused
    for: each with who has it.
    """
    names = {name for sensor in sensors for name in (sensor.id, *sensor.aliases)}
    refused = [
        plugin
        for plugin in registry().plugins
        if _strip_markup(plugin.error) == "LS005" and plugin.error.partition(":")[0] in names
    ]
    return [
        Finding("LS005", f"{plugin.distribution} has {plugin.error}", plugin.entry_point)
        for plugin in refused
    ]


def _holders(sensors: list[Sensor], file: Path) -> list[Finding]:
    """The installed plugins, written in other files than this one, that have the ids of its
    sensors.
    """
    return [
        Finding(
            "LS005",
            f"{plugin.distribution} is installed, and has it ({plugin.entry_point})",
            "",
            sensor.id,
        )
        for sensor in sensors
        for plugin in registry().plugins
        if sensor.id in plugin.sensors
        and not any(
            file.samefile(own) for own in module_files(plugin.entry_point.partition(" = ")[2])
        )
    ]


def _load_sensors(plugin: Any, name: str) -> list[Sensor]:
    """The sensors of a plugin, loaded on its own, with its own hooks applied.

    Raises:
        Exception: whatever it fails with.
    """
    if isinstance(plugin, Sensor):
        return [registry().apply_hooks(plugin)]
    local = Registry()
    ids = local.add(plugin, name=name)
    sensors = [local.sensor(one) for one in ids]
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


def loading(error: BaseException, files: list[Path]) -> Finding:
    """The finding for what a plugin failed with when it was loaded."""
    if isinstance(error, SpecError) and error.__cause__ is not None:
        cause = error.__cause__
    else:
        cause = error
    spots = [
        (spot.filename, spot.lineno or 0)
        for each in (error, cause)
        for spot in traceback.extract_tb(each.__traceback__)
    ]
    own = [
        spot
        for spot in spots
        if any(Path(spot[0]) == file.resolve() or Path(spot[0]) == file for file in files)
    ]
    if isinstance(cause, SyntaxError) and cause.filename:
        own = [(cause.filename, cause.lineno or 0)]
    file, line = own[-1] if own else (str(files[0]) if len(files) == 1 else "", 0)
    if isinstance(error, SpecError) and error.rule:
        path = error.path
    else:
        path = ""
    sensor = getattr(error, "sensor", "")
    if isinstance(error, SpecError) and cause is error:
        text = error.reason
    else:
        text = f"{type(cause).__name__}: {cause}"
    return Finding(_loading_rule(error, cause), " ".join(text.split()), path, sensor, file, line)


def _loading_rule(error: BaseException, cause: BaseException) -> str:
    """The rule of a failure, by its kind and by what was going on."""
    functions = [spot.name for spot in traceback.extract_tb(cause.__traceback__)]
    if isinstance(error, SpecError) and error.rule:
        return error.rule
    if "sizeof" in functions or "_sizeof" in functions:
        return "LS008"
    if isinstance(cause, SpecError):
        return _strip_markup(str(cause)) or "LS007"
    if "lidarspec_sensors" in functions:
        return "LS006"
    return "LS001"


def _strip_markup(text: str) -> str:
    return next((code for words, code in SAID if words in text), "")


def module_files(value: str) -> list[Path]:
    """The files of the module, or of the package, that an entry point names; none where there is
    none.
    """
    try:
        found = importlib.util.find_spec(value.partition("[")[0].partition(":")[0].strip())
    except (Exception, SystemExit):
        return []
    if found is None or not found.origin or not found.origin.endswith(".py"):
        return []
    file = Path(found.origin)
    if file.name == "__init__.py":
        return sorted(file.parent.rglob("*.py"))
    return [file]


def _readable(file: Path) -> bool:
    """Whether its text is Python."""
    try:
        compile(file.read_text(encoding="utf-8"), str(file), "exec")
    except (SyntaxError, ValueError):
        return False
    return True


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


Spot = tuple[str, int]


class Places:
    """The text of some modules by file, to be asked where things stand in it: fields by their
    names, all else by kind and name.
    """

    def __init__(self, trees: Mapping[str, ast.Module]) -> None:
        self._fields = [
            (chain, (file, line))
            for file, tree in trees.items()
            for chain, line in _fields(tree, ())
        ]
        self._others: dict[tuple[str, str], Spot] = {}
        for file, tree in trees.items():
            for kind, name, line in _iter_names(tree):
                self._others.setdefault((kind, name), (file, line))

    def locate(self, finding: Finding, sensor: Sensor | None = None) -> Finding:
        """The finding with the file and line of what it is about, where they can be told."""
        if finding.file:
            return finding
        spot = self._spot(finding.path, sensor) or (
            self._others.get(("sensor", sensor.id)) if sensor else None
        )
        if spot:
            return replace(finding, file=spot[0], line=spot[1])
        return finding

    def _spot(self, path: str, sensor: Sensor | None) -> Spot | None:
        path = re.sub(r"\[\d*\]", "", path.rpartition(" ")[2])
        frame, _, below = path.partition(".")
        if frame == "commands":
            return self._others.get(("key", below.partition(".")[0]))
        return (
            _function(frame, below, sensor)
            or (self._field(tuple(below.split("."))) if below else None)
            or self._others.get(("frame", frame))
        )

    def _field(self, parts: tuple[str, ...]) -> Spot | None:
        """The field whose names in the text are the longest end of the path."""
        fitting = [
            (len(chain), spot) for chain, spot in self._fields if parts[-len(chain) :] == chain
        ]
        if fitting:
            return max(fitting, key=lambda found: found[0])[1]
        return None


def _function(frame: str, name: str, sensor: Sensor | None) -> Spot | None:
    """Where a function of a frame type is written."""
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
    """What may be a key, a frame type or a sensor: kind, name and line."""
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


def _fields(node: ast.AST, chain: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], int]]:
    """Every ``"name" / construct`` with the names that it stands within."""
    match node:
        case ast.BinOp(op=ast.Div(), left=ast.Constant(value=str(name)), right=right):
            yield (*chain, name), node.lineno
            yield from _fields(right, (*chain, name))
        case _:
            for child in ast.iter_child_nodes(node):
                yield from _fields(child, chain)


#: calls that read the clock of the wall.
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
BROAD = frozenset({"Exception", "BaseException"})


def check_texts(trees: Mapping[str, ast.Module]) -> list[Finding]:
    """The findings in the text of some modules, by file."""
    return [
        Finding(code, what, file=file, line=node.lineno)
        for file, tree in trees.items()
        for code, what, node in _mistakes(tree)
    ]


def _mistakes(
    tree: ast.Module,
) -> Iterator[tuple[str, str, ast.expr | ast.stmt | ast.ExceptHandler]]:
    expressions = _names_of_this(tree)
    sockets = any(
        isinstance(node, ast.Import | ast.ImportFrom) and "socket" in ast.unparse(node)
        for node in ast.walk(tree)
    )
    for node in ast.walk(tree):
        match node:
            case ast.ExceptHandler() if (
                node.type is None or _names(node.type) & BROAD
            ) and _silent(node.body):
                yield (
                    "LS801",
                    (
                        f"except {ast.unparse(node.type) if node.type else ''}:"
                        f" {ast.unparse(node.body[0])}"
                    ),
                    node,
                )
            case ast.Call() if ast.unparse(node.func) in WALL_CLOCKS:
                yield "LS802", f"{ast.unparse(node.func)}()", node
            case ast.Call(func=ast.Name(id="hasattr"), args=[ast.Name(id=name), *_]) if (
                name in expressions
            ):
                yield "LS805", ast.unparse(node), node
            case ast.Expr(value=ast.Call() as call) if _short_write(call, sockets=sockets):
                yield "LS803", f"what {ast.unparse(call.func)} returns is dropped", node
        for test in _tests(node):
            if _is_expression(test, expressions):
                yield "LS804", f"Python asks whether `{ast.unparse(test)}` is true", test


def _names_of_this(tree: ast.Module) -> set[str]:
    """The names under which construct's `this` and `obj_` are known in a module."""
    imported = [
        alias
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "construct"
        for alias in node.names
    ]
    return {
        alias.asname or alias.name for alias in imported if alias.name in ("this", "obj_", "len_")
    }


def _tests(node: ast.AST) -> list[ast.expr]:
    """The expressions whose truth Python asks for at a node."""
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
    """Whether a test is an expression of construct: made of `this`, and no call."""
    return not isinstance(test, ast.BoolOp | ast.Call) and bool(_names(test) & names)


def _names(tree: ast.AST) -> set[str]:
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def _silent(body: list[ast.stmt]) -> bool:
    """Whether a handler does nothing with what it caught."""
    match body:
        case [ast.Pass() | ast.Continue() | ast.Expr(value=ast.Constant())]:
            return True
        case [ast.Return(value=None | ast.Constant() | ast.List() | ast.Dict() | ast.Tuple())]:
            return True
    return False


def _short_write(call: ast.Call, *, sockets: bool) -> bool:
    """Whether a call writes as much as it can, and its count is what is dropped."""
    match call.func:
        case ast.Attribute(value=ast.Name(id="os"), attr="write"):
            return True
        case ast.Attribute(attr="send"):
            return sockets and len(call.args) == 1 and not isinstance(call.args[0], ast.Constant)
    return False


#: Rules without which there is nothing to try.
FATAL = frozenset({"LS213", "LS114", "LS115", "LS301"})
#: Name of the properties that are skipped then.
ELSE = "everything else"


#: Called with what is looked at, and with how many properties are done, of how many.
Watch = Callable[[str, int, int], None]


@dataclass(eq=False)
class Report:
    """What was found.

    Attributes:
        name: the sensor's id, or what was checked where there is none.
        findings: what is wrong.
        held: how many properties hold.
        skipped: property -> why it does not apply.
        measured: what was measured of frames along the way.
        picture: what was measured of points, and what it has to be held against.
    """

    name: str
    findings: list[Finding]
    held: int = 0
    skipped: dict[str, str] = field(default_factory=dict)
    measured: dict[str, str] = field(default_factory=dict)
    picture: dict[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON has it."""
        return {**vars(self), "findings": [finding.to_dict() for finding in self.findings]}


def reports(
    target: Target,
    name: str,
    *,
    examples: int = EXAMPLES,
    strategies: Mapping[str, Any] | None = None,
    vectors: Path | None = None,
    tested: Sequence[Sensor] = (),
    watch: Watch = lambda text, done, total: None,
) -> Iterator[Report]:
    """A report of the text and the loading of a target, where there is something to say, and one of
    each of its sensors.

    Args:
        name: what was asked for.
        examples: of each frame type, for each property.
        strategies: "frame.field" -> how its raw value is drawn, for fields of which no valid value
            can be derived.
        vectors: golden vectors; by default those that the target has.
        tested: related models that are tested too: what they share with a sensor is not tested
            again.
        watch: is called with what is looked at before it is, and how many properties of how many
            are done.
    """
    trees = {
        str(file): ast.parse(file.read_text(encoding="utf-8"), str(file)) for file in target.files
    }
    places = Places(trees)
    known = {sensor.id: sensor for sensor in target.sensors}
    mistakes = [
        places.locate(finding, known.get(finding.sensor)) for finding in target.findings
    ] + check_texts(trees)
    single = [sensor for sensor in target.sensors if len(target.sensors) == 1]
    if mistakes and not single:
        yield Report(name, mistakes)
    total = len(PROPERTIES) * len(target.sensors)
    for index, sensor in enumerate(target.sensors):
        family = () if vectors and single else target.family
        subject = Subject(
            sensor, examples, strategies or {}, vectors or target.vectors, family, tested
        )
        before = len(PROPERTIES) * index
        yield _report(
            subject,
            places,
            mistakes if single else [],
            functools.partial(_watch_sensor, watch, before, total),
        )


def _watch_sensor(watch: Watch, before: int, total: int, text: str, done: int) -> None:
    """Pass on what is looked at in one sensor of several."""
    watch(text, before + done, total)


def _beside(subject: Subject) -> Iterator[tuple[str, str]]:
    """What the picture of a sensor has to be held against."""
    sensor = subject.sensor
    missing = lacking(subject)
    if missing:
        yield "vectors", f"{missing}; x and y of points in two quadrants would prove the picture"
    yield (
        "vendor_axes",
        f"x, y, z are {', '.join(sensor.vendor_axes)}" if sensor.vendor_axes else "not declared",
    )
    yield "source", sensor.source


def _watch_case(watch: Callable[[str, int], None], sensor_id: str, done: int, case: str) -> None:
    """Pass on which case of a property is looked at."""
    watch(f"{sensor_id}: {case}", done)


def _report(
    subject: Subject, places: Places, mistakes: list[Finding], watch: Callable[[str, int], None]
) -> Report:
    sensor: Sensor = subject.sensor
    report = Report(sensor.id, list(mistakes))
    if not sensor.frames:
        report.skipped["all properties"] = "it has no frames before it is configured with its file"
        return report
    watch(f"{sensor.id}: declaration", 0)
    report.findings += check_declaration(subject)
    for done, one in enumerate(PROPERTIES):
        known = sorted(
            {finding.code for finding in left_over(report.findings, sensor, whole=False)}
            & set(one.unless)
        )
        reason = one.lacks(subject) or (f"{', '.join(known)} is found already" if known else "")
        if reason:
            report.skipped[one.name] = reason
            continue
        found = one.findings(subject, functools.partial(_watch_case, watch, sensor.id, done))
        report.held += not found
        report.findings += found
        if any(finding.code in FATAL for finding in report.findings):
            report.skipped[ELSE] = "nothing can be tried before what is found is mended"
            break
    distinct = list(
        {(finding.code, finding.path): finding for finding in reversed(report.findings)}.values()
    )[::-1]
    left = left_over(distinct, sensor, whole=ELSE not in report.skipped and not subject.tested)
    report.findings = [places.locate(finding, sensor) for finding in left]
    report.measured = subject.measured
    report.picture = subject.picture and {
        **dict(sorted(subject.picture.items())),
        **dict(_beside(subject)),
    }
    return report
