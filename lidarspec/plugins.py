"""Plugins: the hooks that they may have, how they are found, and the registry of what they add.

A distribution names its sensors in the entry-point group ``lidarspec.sensors``, one entry for each id and alias, so that asking for
one sensor loads one plugin; modules with other hooks stand in the group ``lidarspec``, and are loaded before any sensor is handed out.
A hook is a function of a name below, marked with ``@hookimpl``.

Entry points are read straight from the folders that Python imports from: importlib.metadata finds the same ones, but importing it takes
longer than all else that finding a sensor takes. It is asked where something could be installed in another way than as a folder: in a
zip file or an egg, or by an import hook.

Each plugin is loaded on its own. One that cannot be imported, names a hook that does not exist or adds a sensor that cannot be, is named
with its distribution and its error, rolled back, and disturbs no other.
"""

from __future__ import annotations

import contextlib
import copyreg
import functools
import importlib
import importlib.util
import inspect
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.machinery import PathFinder
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple
from zlib import crc32

import pluggy

from lidarspec.errors import NO_SENSORS, LidarSpecError, SourceError, SpecError, UnknownSensor, UsageError
from lidarspec.spec.checksums import Checksum
from lidarspec.spec.construct_layer import prepare, seals
from lidarspec.spec.description import Frame
from lidarspec.spec.results import Points
from lidarspec.spec.sensor import Sensor

if TYPE_CHECKING:
    from pathlib import Path

NAMESPACE = "lidarspec"

hookspec = pluggy.HookspecMarker(NAMESPACE)
hookimpl = pluggy.HookimplMarker(NAMESPACE)


@hookspec
def lidarspec_sensors() -> Iterable[Sensor]:  # type: ignore[empty-body]
    """The sensors that the plugin adds."""


@hookspec(firstresult=True)
def lidarspec_checksum(sensor: Sensor, frame: Frame) -> Checksum | None:
    """The checksum algorithm of a frame type, or None to leave it as declared; never field or span."""


@hookspec(firstresult=True)
def lidarspec_points(sensor: Sensor, fields: Any) -> Points | None:
    """The points of a batch of packets, or None to leave them to the sensor: a site's own calibration, for example."""


@hookspec(firstresult=True)
def lidarspec_source(url: str) -> Any:
    """A transport for a URL scheme that the package does not know, or None."""


@hookspec
def lidarspec_formats() -> Iterable[Any]:  # type: ignore[empty-body]
    """File formats by suffix that the plugin adds."""


_FOLDERS = (".dist-info", ".egg-info")


class _NotOnlyFolders(Exception):
    """Something that only importlib.metadata knows how to search."""


class EntryPoint(NamedTuple):
    """One entry point: its name, the module or object that it stands for, and the distribution that declares it."""

    name: str
    value: str
    distribution: str
    version: str

    @property
    def module(self) -> str:
        """The module that it stands for, or that holds its object."""
        return self.value.partition("[")[0].partition(":")[0].strip()

    def load(self) -> Any:
        """The module, or the object in it, imported."""
        attributes = self.value.partition("[")[0].partition(":")[2]
        names = [name for name in attributes.strip().split(".") if name]
        return functools.reduce(getattr, names, importlib.import_module(self.module))


def entry_points(group: str) -> list[EntryPoint]:
    """Every entry point of a group, sorted by name and value; of several distributions of one name those of the first."""
    try:
        found = [entry for folder in _distributions() for entry in _declared(folder, group)]
    except _NotOnlyFolders:
        found = _by_metadata(group)
    return sorted(found, key=lambda entry: (entry.name, entry.value))


def _distributions() -> Iterator[str]:
    """The folders that describe the installed distributions, the first one of each name."""
    if any(hasattr(finder, "find_distributions") and finder is not PathFinder for finder in sys.meta_path):
        raise _NotOnlyFolders
    seen = set()
    for place in sys.path:
        for name in _listed(place or os.curdir):
            stem, kind = os.path.splitext(name)
            if kind.lower() in _FOLDERS:
                normal = re.sub(r"[-_.]+", "_", stem.partition("-")[0]).lower()
                if normal not in seen:
                    seen.add(normal)
                    yield os.path.join(place, name)


def _listed(place: str) -> list[str]:
    if place.lower().rstrip("/\\").endswith(".egg"):
        raise _NotOnlyFolders
    try:
        return os.listdir(place)
    except NotADirectoryError:
        raise _NotOnlyFolders from None
    except OSError:
        return []


def _declared(folder: str, group: str) -> Iterator[EntryPoint]:
    """The entry points of a group that one distribution declares."""
    section = ""
    for line in map(str.strip, _text(folder, "entry_points.txt").splitlines()):
        if line.startswith("[") and line.endswith("]"):
            section = line[1:-1]
        elif section == group and line and not line.startswith("#"):
            name, _, value = line.partition("=")
            yield EntryPoint(name.strip(), value.strip(), *_name_and_version(folder))


def _name_and_version(folder: str) -> tuple[str, str]:
    header = (_text(folder, "METADATA") or _text(folder, "PKG-INFO")).partition("\n\n")[0]
    fields = dict(re.findall(r"^(Name|Version):[ \t]*(.*?)[ \t\r]*$", header, re.MULTILINE))
    return fields.get("Name", "?"), fields.get("Version", "?")


def _text(folder: str, name: str) -> str:
    try:
        with open(os.path.join(folder, name), encoding="utf-8") as file:
            return file.read()
    except OSError:
        return ""


def _by_metadata(group: str) -> list[EntryPoint]:
    import importlib.metadata

    found = importlib.metadata.entry_points(group=group)
    return [EntryPoint(e.name, e.value, e.dist.name if e.dist else "?", e.dist.version if e.dist else "?") for e in found]


GROUP = "lidarspec"
SENSORS = "lidarspec.sensors"
HOOKS = tuple(name for name in globals() if name.startswith("lidarspec_"))


@dataclass(frozen=True, eq=False)
class HookedPoints:
    """A `points` function of a sensor that asks the hooks of installed plugins first."""

    sensor: Sensor
    own: Callable[[Any], Points]
    hooks: Callable[..., Points | None]

    def __call__(self, fields: Any) -> Points:
        answer = self.hooks(sensor=self.sensor, fields=fields)
        return self.own(fields) if answer is None else answer


@dataclass(frozen=True)
class Plugin:
    """A plugin that was found: where it comes from, the ids it adds, and its error if it was not loaded."""

    distribution: str
    version: str
    entry_point: str
    sensors: tuple[str, ...] = ()
    error: str = ""
    traceback: str = ""


class Registry:
    """The plugins of this environment, and the sensors with their hooks applied.

    Two threads may load the same sensor at the same time: it is then added twice, and is the same.

    Args:
        modules: entry points of modules with hooks; each is loaded at once.
        offered: entry points of sensors, by id and alias; each is loaded when it is asked for.
    """

    def __init__(self, modules: Iterable[EntryPoint] = (), offered: Iterable[EntryPoint] = ()) -> None:
        self._manager = pluggy.PluginManager(NAMESPACE)
        self._manager.add_hookspecs(sys.modules[__name__])
        self._loaded: dict[str, Sensor] = {}
        self._aliases: dict[str, str] = {}
        self._owners: dict[str, Any] = {}
        self._ready: dict[str, Sensor] = {}
        self._offered: dict[tuple[str, str], list[EntryPoint]] = {}
        for entry in offered:
            self._offered.setdefault((entry.distribution, entry.module), []).append(entry)
        self._tried: dict[EntryPoint, Plugin] = {}
        self._modules = [
            _loaded(entry, entry.name, functools.partial(self.add, name=f"{entry.distribution}:{entry.name}")) for entry in modules
        ]

    @property
    def plugins(self) -> list[Plugin]:
        """Every plugin that was found; those that could not be loaded say why."""
        self._load_all()
        return self._modules + [self._together(entries) for entries in self._offered.values()]

    def add(self, plugin: Any, *, name: str) -> list[str]:
        """Register one plugin (a module or object with hooks) and return the ids that it adds.

        Raises:
            SpecError: for an unknown hook, a wrong signature, or a sensor that cannot be; nothing is left registered.
        """
        _check_hooks(plugin, name)
        try:
            self._manager.register(plugin, name)
            sensors = self._sensors_of(plugin)
        except BaseException as error:
            if self._manager.has_plugin(name):
                self._manager.unregister(name=name)
            if isinstance(error, pluggy.PluginValidationError):
                raise SpecError(" ".join(str(error).split()), path=name) from None
            raise
        self._keep(plugin, sensors)
        self._ready.clear()
        return [sensor.id for sensor in sensors]

    def _load(self, entry: EntryPoint) -> None:
        if entry not in self._tried:
            self._tried[entry] = _loaded(entry, entry.name, functools.partial(self._add_offered, entry))

    def _load_all(self) -> None:
        for entries in self._offered.values():
            for entry in entries:
                self._load(entry)

    def _add_offered(self, entry: EntryPoint, sensor: Any) -> list[str]:
        """Keep a sensor that an entry point names by its id or one of its aliases."""
        owner = (entry.distribution, entry.module)
        self._check(sensor, [sensor], owner)
        if entry.name not in (sensor.id, *sensor.aliases):
            raise SpecError(f"its entry point is called {entry.name!r}, which is none of its names", sensor=sensor.id)
        self._keep(owner, [sensor])
        return [sensor.id]

    def _together(self, entries: list[EntryPoint]) -> Plugin:
        """What became of all sensors that a module offers."""
        tried = [self._tried[entry] for entry in entries]
        ids = dict.fromkeys(name for plugin in tried for name in plugin.sensors)
        failed = next((plugin for plugin in tried if plugin.error), tried[0])
        return replace(failed, entry_point=f"{SENSORS} = {entries[0].module}", sensors=tuple(ids))

    def _sensors_of(self, plugin: Any) -> list[Sensor]:
        function = getattr(plugin, "lidarspec_sensors", None)
        sensors = list(function()) if function is not None and _is_hook(function) else []
        for sensor in sensors:
            self._check(sensor, sensors, plugin)
        return sensors

    def _keep(self, plugin: Any, sensors: list[Sensor]) -> None:
        for sensor in sensors:
            self._loaded[sensor.id] = sensor
            self._aliases |= dict.fromkeys(sensor.aliases, sensor.id)
            self._owners |= dict.fromkeys((sensor.id, *sensor.aliases), plugin)

    def names(self) -> list[str]:
        """Every id and alias, sorted; what only has an entry point is not loaded for it."""
        offered = {entry.name for entries in self._offered.values() for entry in entries}
        return sorted(offered | set(self._loaded) | set(self._aliases))

    def __contains__(self, name: str) -> bool:
        """Whether there is a sensor of this id or alias."""
        self._load_all()
        return name in self._loaded or name in self._aliases

    def sensors(self) -> dict[str, Sensor]:
        """Every sensor by id, sorted, with its hooks applied."""
        self._load_all()
        return {name: self.sensor(name) for name in sorted(self._loaded)}

    def sensor(self, name: str) -> Sensor:
        """One sensor by id or alias, in capitals and with other hyphens too, with its hooks applied.

        Raises:
            UnknownSensor: with a suggestion, or with what to install where there is no sensor at all.
        """
        for entries in self._offered.values():
            for entry in entries:
                if entry.name == name:
                    self._load(entry)
        if name not in self._loaded and name not in self._aliases:
            self._load_all()
            name = next((known for known in (*self._loaded, *self._aliases) if _letters(known) == _letters(name)), name)
        name = self._aliases.get(name, name)
        if name not in self._loaded:
            hint = "" if self._loaded else f"; {NO_SENSORS}"
            raise UnknownSensor(name, self._loaded, hint=hint, aliases=self._aliases)
        if name not in self._ready:
            self._ready[name] = self.hooked(self._loaded[name])
        return self._ready[name]

    def hooked(self, sensor: Sensor) -> Sensor:
        """The sensor with the checksum and points hooks of all plugins applied to it."""
        frames = {name: self._sealed(sensor, frame) for name, frame in sensor.frames.items()}
        points = self._manager.hook.lidarspec_points
        if not points.get_hookimpls():
            return replace(sensor, frames=frames, hooked=self.hooked)

        def asked(function: Any) -> Any:
            if isinstance(function, Mapping):
                return {path: asked(own) for path, own in function.items()}
            return function if function is None or isinstance(function, HookedPoints) else HookedPoints(sensor, function, points)

        frames = {name: replace(frame, points=asked(frame.points)) for name, frame in frames.items()}
        return replace(sensor, frames=frames, points=asked(sensor.points), hooked=self.hooked)

    def call(self, hook: str, **arguments: Any) -> Any:
        """The result of another hook."""
        return getattr(self._manager.hook, hook)(**arguments)

    def _sealed(self, sensor: Sensor, frame: Frame) -> Frame:
        """The frame with the checksum of the first hook that has one for it; a hook that fails is named and passed over."""
        arguments = {"sensor": sensor, "frame": frame}
        for hook in reversed(self._manager.hook.lidarspec_checksum.get_hookimpls()):
            try:
                algorithm = hook.function(**{name: arguments[name] for name in hook.argnames})
                if algorithm is not None:
                    return _resealed(frame, algorithm)
            except Exception as error:
                self._failed(hook.plugin_name, f"lidarspec_checksum for {sensor.id}: {type(error).__name__}: {error}")
        return frame

    def _failed(self, name: str, reason: str) -> None:
        for index, plugin in enumerate(self._modules):
            if f"{plugin.distribution}:{plugin.entry_point.partition(' = ')[0]}" == name and not plugin.error:
                self._modules[index] = replace(plugin, error=reason, traceback=traceback.format_exc())

    def _check(self, sensor: Any, own: list[Any], plugin: Any) -> None:
        if not isinstance(sensor, Sensor):
            raise SpecError(f"lidarspec_sensors returns sensors, not {type(sensor).__name__}")
        for name in (sensor.id, *sensor.aliases):
            owner = self._owners.get(name, plugin)
            if owner != plugin or sum(name in (s.id, *s.aliases) for s in own) > 1:
                whose = "one of the same plugin" if owner == plugin else f"that of {self._place(owner)}"
                raise SpecError(f"another sensor has this id already: {whose}", sensor=name)

    def _place(self, plugin: Any) -> str:
        """A plugin that is loaded, as "distribution:module" or "distribution:entry"."""
        return ":".join(plugin) if isinstance(plugin, tuple) else str(self._manager.get_name(plugin))


def _loaded(entry: EntryPoint, names: str, add: Callable[[Any], list[str]]) -> Plugin:
    """What became of an entry point that is loaded and added; whatever it raises disturbs no other."""
    plugin = Plugin(entry.distribution, entry.version, f"{names} = {entry.value}")
    try:
        return replace(plugin, sensors=tuple(add(entry.load())))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        reason = str(error) if isinstance(error, LidarSpecError) else f"{type(error).__name__}: {error}"
        return replace(plugin, error=reason, traceback=traceback.format_exc())


def _letters(name: str) -> str:
    return re.sub(r"[\W_]", "", name).lower()


def _resealed(frame: Frame, algorithm: Any) -> Frame:
    if not isinstance(algorithm, Checksum):
        raise SpecError(f"returns a Checksum or None, not {type(algorithm).__name__}")
    struct = prepare(frame.struct)
    seal = next(seals(struct), None)
    if seal is None:
        raise SpecError("answers for a frame without a checksum")
    seal.algorithm = algorithm
    return replace(frame, struct=struct)


def _is_hook(function: Any) -> bool:
    return inspect.isroutine(function) and getattr(function, f"{NAMESPACE}_impl", None) is not None


def _check_hooks(plugin: Any, name: str) -> None:
    """pluggy passes over a misspelt hook in silence; a name that begins like one has to be one."""
    for attribute in dir(plugin):
        function = getattr(plugin, attribute, None)
        if not _is_hook(function) and not (attribute.startswith("lidarspec_") and inspect.isfunction(function)):
            continue
        if attribute not in HOOKS:
            raise SpecError(f"there is no hook {attribute!r}; hooks are {', '.join(HOOKS)}", path=name)
        if not _is_hook(function):
            raise SpecError(f"{attribute} lacks @hookimpl", path=name)


#: the registry of this environment, once it is asked for, and those that stand in for it.
_registries: list[Registry] = []


def registry() -> Registry:
    """The registry of this environment."""
    if not _registries:
        _registries.append(Registry(entry_points(GROUP), entry_points(SENSORS)))
    return _registries[-1]


@contextlib.contextmanager
def standing_in(other: Registry) -> Iterator[Registry]:
    """As long as this context lasts, `other` is the registry of this environment."""
    registry()
    _registries.append(other)
    try:
        yield other
    finally:
        _registries.remove(other)


def sensors() -> dict[str, Sensor]:
    """Every installed sensor by id."""
    return registry().sensors()


def sensor(name: str | Path | Sensor) -> Sensor:
    """One sensor: an installed one by id or alias, or one out of a file, "./mysensor.py" ("./mysensor.py:id" if it has several).

    A sensor is given back as it is.

    Raises:
        UnknownSensor: with a suggestion.
        SourceError, SpecError: for a file that cannot be read, or describes no sensor.
    """
    if isinstance(name, Sensor):
        return name
    text = str(name)
    if "/" in text or "\\" in text or text.endswith(".py"):
        return _from_file(text)
    return registry().sensor(text)


def file_and_id(text: str) -> tuple[Path, str]:
    """The file of "FILE" or "FILE.py:id", and the id, "" where none is named."""
    from pathlib import Path

    path, colon, wanted = text.partition(".py:")
    return Path(f"{path}.py" if colon else text), wanted


def _from_file(text: str) -> Sensor:
    file, wanted = file_and_id(text)
    module = file_module(file)
    local = Registry()
    with _faults_of(file):
        ids = local.add(module, name=str(file))
    if not ids:
        raise SpecError("there is no function lidarspec_sensors, marked @hookimpl, that returns a sensor", path=str(file))
    if len(ids) > 1 and not wanted:
        raise UsageError(f"{file} describes several sensors, name one: {', '.join(f'{file}:{name}' for name in ids)}")
    chosen = local._loaded.get(wanted or ids[0])
    if chosen is None:
        raise UnknownSensor(wanted, ids, place=str(file))
    return registry().hooked(local.hooked(chosen))


def file_module(file: Path) -> ModuleType:
    """A file as a module, which `sys.modules` has under a name of its own, as dataclasses, pickle and typing expect it.

    Raises:
        SourceError, SpecError: for one that is not there, or cannot be imported.
    """
    if not file.is_file():
        raise SourceError(f"{file}: no such file")
    module_spec = importlib.util.spec_from_file_location(f"lidarspec_file_{file.stem}_{crc32(bytes(file.resolve())):08x}", file)
    assert module_spec is not None
    assert module_spec.loader is not None
    module = importlib.util.module_from_spec(module_spec)
    sys.modules[module.__name__] = module
    try:
        with _faults_of(file):
            module_spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[module.__name__]
        raise
    return module


@contextlib.contextmanager
def _faults_of(file: Path) -> Iterator[None]:
    """Whatever the code of a file raises, as a `SpecError` that names the file."""
    try:
        yield
    except LidarSpecError:
        raise
    except (Exception, SystemExit) as error:
        raise SpecError(f"{type(error).__name__}: {error}", path=str(file)) from error


def rebuilt(sensor_id: str, options: Mapping[str, Any]) -> Sensor:
    """An installed sensor, configured: what a pickled one is read back from."""
    known = sensor(sensor_id)
    return known.configure(**options) if options else known


def _reduced(value: Sensor) -> tuple[Callable[..., Sensor], tuple[str, dict[str, Any]]]:
    return rebuilt, (value.id, dict(value.options))


copyreg.pickle(Sensor, _reduced)
