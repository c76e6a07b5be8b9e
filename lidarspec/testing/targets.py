"""What can be checked: an installed sensor, a file that describes sensors, a distribution with all of its plugins."""

from __future__ import annotations

import importlib.util
import inspect
import re
import tomllib
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lidarspec.errors import SourceError, SpecError
from lidarspec.installed import EntryPoint, entry_points
from lidarspec.plugins import GROUP, Registry, file_module, registry
from lidarspec.spec import Sensor
from lidarspec.testing.findings import Finding

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
)


@dataclass(eq=False)
class Target:
    """Something to check.

    Attributes:
        sensors: that were found in it.
        findings: what kept others from being found.
        files: the modules that it is written in.
        vectors: its golden vectors: beside a file; of a distribution with one sensor, in its folder or its tests.
    """

    sensors: list[Sensor] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)
    vectors: Path | None = None


def target(text: str | Path) -> Target:
    """What a name stands for: a file, the id or alias of an installed sensor, or a distribution, by its name or its folder.

    Raises:
        SourceError: for a file that is not there, and for the folder of a distribution that is not installed.
        UnknownSensor: for a name that is nothing of all this.
    """
    name = str(text)
    if (Path(name) / "pyproject.toml").is_file():
        return _folder(Path(name))
    if "/" in name or "\\" in name or name.endswith(".py"):
        return _file(Path(name))
    entries = [entry for entry in entry_points(GROUP) if _normal(entry.distribution) == _normal(name)]
    if entries:
        return _distribution(entries)
    sensor = registry().sensor(name)
    homes = [plugin for plugin in registry().plugins if sensor.id in plugin.sensors]
    files = [file for plugin in homes for file in module_files(plugin.entry_point.partition(" = ")[2])]
    alone = [file.parent for file in files if [plugin.sensors for plugin in homes] == [(sensor.id,)]]
    return Target([sensor], [], files, _vectors(*alone, *(folder.parent for folder in alone)))


def _file(file: Path) -> Target:
    found = Target(files=[file], vectors=_vectors(file.parent))
    try:
        found.sensors = _added(file_module(file), str(file))
        if not found.sensors:
            raise SpecError("there is no function lidarspec_sensors, marked @hookimpl, that returns a sensor")
    except SourceError:
        raise
    except (Exception, SystemExit) as error:
        found.findings.append(loading(error, [file]))
        found.files = found.files if _readable(file) else []
    return found


def _folder(folder: Path) -> Target:
    """The distribution whose source is in a folder."""
    try:
        name = str(tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]["name"])
    except (ValueError, KeyError) as error:
        raise SourceError(f"{folder / 'pyproject.toml'} names no project: {error}") from None
    entries = [entry for entry in entry_points(GROUP) if _normal(entry.distribution) == _normal(name)]
    if not entries:
        raise SourceError(f"{name} is not installed, or has no sensors: pip install -e {folder}")
    found = _distribution(entries)
    found.vectors = _vectors(folder, folder / "tests") if len(found.sensors) == 1 else None
    return found


def _vectors(*folders: Path) -> Path | None:
    return next((folder / VECTORS for folder in folders if (folder / VECTORS).is_file()), None)


def _distribution(entries: list[EntryPoint]) -> Target:
    found = Target()
    known = registry().sensors()
    for entry in entries:
        value = entry.value
        try:
            sensors = _added(entry.load(), value)
        except (Exception, SystemExit) as error:
            finding = loading(error, module_files(value))
            found.findings.append(replace(finding, path=finding.path or f"{entry.name} = {value}"))
            continue
        found.files += [file for file in module_files(value) if file not in found.files]
        found.sensors += [known.get(sensor.id, sensor) for sensor in sensors if sensor.id not in {one.id for one in found.sensors}]
    names = {_normal(entry.distribution) for entry in entries}
    told = [(plugin, _said(plugin.error)) for plugin in registry().plugins if _normal(plugin.distribution) in names and plugin.error]
    found.findings += [Finding(code, plugin.error, plugin.entry_point) for plugin, code in told if code in ("LS005", "LS010")]
    return found


def _added(plugin: Any, name: str) -> list[Sensor]:
    """The sensors of a plugin, loaded on its own, with its own hooks applied.

    Raises:
        Exception: whatever it fails with.
    """
    local = Registry()
    ids = local.add(plugin, name=name)
    sensors = [local.sensor(one) for one in ids]
    hook: Any = getattr(plugin, "lidarspec_checksum", None)
    for sensor in sensors if callable(hook) else []:
        for frame in sensor.frames.values():
            given = {"sensor": sensor, "frame": frame}
            try:
                _asked(hook, given)
            except Exception as error:
                raise SpecError(f"lidarspec_checksum for {sensor.id}: {type(error).__name__}: {error}", rule="LS010") from error
    return [registry().hooked(sensor) for sensor in sensors]


def _asked(hook: Callable[..., Any], given: dict[str, Any]) -> None:
    """Call a hook with those of the arguments that it wants."""
    hook(**{key: given[key] for key in inspect.signature(hook).parameters})


def loading(error: BaseException, files: list[Path]) -> Finding:
    """The finding for what a plugin failed with when it was loaded."""
    cause = error.__cause__ if isinstance(error, SpecError) and error.__cause__ is not None else error
    spots = [(spot.filename, spot.lineno or 0) for each in (error, cause) for spot in traceback.extract_tb(each.__traceback__)]
    own = [spot for spot in spots if any(Path(spot[0]) == file.resolve() or Path(spot[0]) == file for file in files)]
    if isinstance(cause, SyntaxError) and cause.filename:
        own = [(cause.filename, cause.lineno or 0)]
    file, line = own[-1] if own else (str(files[0]) if len(files) == 1 else "", 0)
    path = error.path if isinstance(error, SpecError) and error.rule else ""
    sensor = getattr(error, "sensor", "")
    text = error.reason if isinstance(error, SpecError) and cause is error else f"{type(cause).__name__}: {cause}"
    return Finding(_loading_rule(error, cause), " ".join(text.split()), path, sensor, file, line)


def _loading_rule(error: BaseException, cause: BaseException) -> str:
    """The rule of a failure, by its kind and by what was going on."""
    functions = [spot.name for spot in traceback.extract_tb(cause.__traceback__)]
    if isinstance(error, SpecError) and error.rule:
        return error.rule
    if isinstance(cause, TypeError) and "max_length" in str(cause):
        return "LS009"
    if "sizeof" in functions or "_sizeof" in functions:
        return "LS008"
    if isinstance(cause, SpecError):
        return _said(str(cause)) or "LS007"
    return "LS006" if "lidarspec_sensors" in functions else "LS001"


def _said(text: str) -> str:
    return next((code for words, code in SAID if words in text), "")


def module_files(value: str) -> list[Path]:
    """The files of the module, or of the package, that an entry point names; none where there is none."""
    try:
        found = importlib.util.find_spec(value.partition("[")[0].partition(":")[0].strip())
    except (Exception, SystemExit):
        return []
    if found is None or not found.origin or not found.origin.endswith(".py"):
        return []
    file = Path(found.origin)
    return sorted(file.parent.rglob("*.py")) if file.name == "__init__.py" else [file]


def _readable(file: Path) -> bool:
    """Whether its text is Python."""
    try:
        compile(file.read_text(encoding="utf-8"), str(file), "exec")
    except (SyntaxError, ValueError):
        return False
    return True


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
