"""The registry: plugins found through entry points, each loaded on its own, and the sensors that they add.

A plugin that cannot be imported, names a hook that does not exist or adds a sensor that cannot be, is named with its
distribution and its error, rolled back, and disturbs no other.
"""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import inspect
import traceback
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pluggy

from lidarspec import hookspecs
from lidarspec.checksums import Checksum
from lidarspec.errors import LidarSpecError, SourceError, SpecError, UnknownSensor, UsageError
from lidarspec.fields import Checksummed
from lidarspec.rules import children
from lidarspec.spec import Frame, Sensor, replaced

GROUP = "lidarspec"
HOOKS = tuple(name for name in vars(hookspecs) if name.startswith("lidarspec_"))


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
    """The plugins of this environment, and the sensors with their hooks applied."""

    def __init__(self) -> None:
        self._manager = pluggy.PluginManager(hookspecs.NAMESPACE)
        self._manager.add_hookspecs(hookspecs)
        self._loaded: dict[str, Sensor] = {}
        self._aliases: dict[str, str] = {}
        self._ready: dict[str, Sensor] = {}
        self.plugins: list[Plugin] = []

    def load(self, entry_points: Iterable[importlib.metadata.EntryPoint]) -> None:
        """Load each entry point; failures are kept in `plugins`."""
        for entry in entry_points:
            distribution = entry.dist.name if entry.dist else "?"
            version = entry.dist.version if entry.dist else "?"
            try:
                sensors = self.add(entry.load(), name=f"{distribution}:{entry.name}")
                self.plugins.append(Plugin(distribution, version, f"{entry.name} = {entry.value}", tuple(sensors)))
            except KeyboardInterrupt:
                raise
            except BaseException as error:
                reason = str(error) if isinstance(error, LidarSpecError) else f"{type(error).__name__}: {error}"
                text = traceback.format_exc()
                self.plugins.append(Plugin(distribution, version, f"{entry.name} = {entry.value}", (), reason, text))

    def add(self, plugin: Any, *, name: str) -> list[str]:
        """Register one plugin (a module or object with hooks) and return the ids that it adds.

        Raises:
            SpecError: for an unknown hook, a wrong signature, or a sensor that cannot be; nothing is left registered.
        """
        _check_hooks(plugin, name)
        try:
            self._manager.register(plugin, name)
            function = getattr(plugin, "lidarspec_sensors", None)
            sensors = list(function()) if function is not None and _is_hook(function) else []
            for sensor in sensors:
                self._check(sensor, sensors)
        except pluggy.PluginValidationError as error:
            self._rollback(name)
            raise SpecError(" ".join(str(error).split()), path=name) from None
        except BaseException:
            self._rollback(name)
            raise
        for sensor in sensors:
            self._loaded[sensor.id] = sensor
            self._aliases |= dict.fromkeys(sensor.aliases, sensor.id)
        self._ready.clear()
        return [sensor.id for sensor in sensors]

    def sensors(self) -> dict[str, Sensor]:
        """Every sensor by id, sorted, with its hooks applied."""
        return {name: self.sensor(name) for name in sorted(self._loaded)}

    def sensor(self, name: str) -> Sensor:
        """One sensor by id or alias, with its hooks applied.

        Raises:
            UnknownSensor: with a suggestion, or with what to install where there is no sensor at all.
        """
        name = self._aliases.get(name, name)
        if name not in self._loaded:
            hint = "" if self._loaded else "; no sensor is installed: pip install 'lidarspec[all]'"
            raise UnknownSensor(name, [*self._loaded, *self._aliases], hint=hint)
        if name not in self._ready:
            self._ready[name] = self.hooked(self._loaded[name])
        return self._ready[name]

    def hooked(self, sensor: Sensor) -> Sensor:
        """The sensor with the checksum and points hooks of all plugins applied to it."""
        frames = {name: self._sealed(sensor, frame) for name, frame in sensor.frames.items()}
        points = self._manager.hook.lidarspec_points
        if not points.get_hookimpls():
            return sensor if all(frames[name] is frame for name, frame in sensor.frames.items()) else replaced(sensor, frames=frames)

        def with_hooks(function: Any) -> Any:
            if function is None or getattr(function, "asks_hooks", False):
                return function

            def hooked_points(fields: Any) -> Any:
                found = points(sensor=sensor, fields=fields)
                return function(fields) if found is None else found

            hooked_points.asks_hooks = True  # type: ignore[attr-defined]  # configured sensors come here a second time
            return hooked_points

        frames = {name: _with_points(frame, with_hooks(frame.points)) for name, frame in frames.items()}
        return replaced(sensor, frames=frames, points=with_hooks(sensor.points))

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
        for index, plugin in enumerate(self.plugins):
            if f"{plugin.distribution}:{plugin.entry_point.partition(' = ')[0]}" == name and not plugin.error:
                self.plugins[index] = replace(plugin, error=reason, traceback=traceback.format_exc())

    def _check(self, sensor: Any, own: list[Any]) -> None:
        if not isinstance(sensor, Sensor):
            raise SpecError(f"lidarspec_sensors returns sensors, not {type(sensor).__name__}")
        for name in (sensor.id, *sensor.aliases):
            if name in self._loaded or name in self._aliases or sum(name in (s.id, *s.aliases) for s in own) > 1:
                raise SpecError("another sensor has this id already", sensor=name)

    def _rollback(self, name: str) -> None:
        if self._manager.has_plugin(name):
            self._manager.unregister(name=name)


def _seals(con: Any) -> list[Checksummed]:
    found = [con] if isinstance(con, Checksummed) else []
    return found + [seal for child in children(con) for seal in _seals(child)]


def _resealed(frame: Frame, algorithm: Any) -> Frame:
    if not isinstance(algorithm, Checksum):
        raise SpecError(f"returns a Checksum or None, not {type(algorithm).__name__}")
    changed = replaced(frame)
    seal = next(iter(_seals(changed.prepared)), None)
    if seal is None:
        raise SpecError("answers for a frame without a checksum")
    seal.algorithm = algorithm
    return changed


def _with_points(frame: Frame, points: Any) -> Frame:
    if points is None:
        return frame
    changed = replaced(frame, points=points)
    object.__setattr__(changed, "prepared", frame.prepared)
    return changed


def _is_hook(function: Any) -> bool:
    return inspect.isroutine(function) and getattr(function, f"{hookspecs.NAMESPACE}_impl", None) is not None


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


@functools.cache
def registry() -> Registry:
    """The registry of this environment, loaded at first use."""
    found = Registry()
    found.load(sorted(importlib.metadata.entry_points(group=GROUP), key=lambda entry: (entry.name, entry.value)))
    return found


def sensors() -> dict[str, Sensor]:
    """Every installed sensor by id."""
    return registry().sensors()


def sensor(name: str | Path) -> Sensor:
    """One sensor: an installed one by id or alias, or one out of a file, "./mysensor.py" ("./mysensor.py:id" if it has several).

    Raises:
        UnknownSensor: with a suggestion.
        SourceError, SpecError: for a file that cannot be read, or describes no sensor.
    """
    text = str(name)
    if "/" in text or "\\" in text or text.endswith(".py"):
        return _from_file(text)
    return registry().sensor(text)


def _from_file(text: str) -> Sensor:
    path, colon, wanted = text.partition(".py:")
    file = Path(f"{path}.py" if colon else text)
    module = _module(file)
    local = Registry()
    try:
        ids = local.add(module, name=str(file))
    except LidarSpecError:
        raise
    except (Exception, SystemExit) as error:
        raise SpecError(f"{type(error).__name__}: {error}", path=str(file)) from error
    if not ids:
        raise SpecError("lidarspec_sensors returns no sensor", path=str(file))
    if len(ids) > 1 and not wanted:
        raise UsageError(f"{file} describes several sensors, name one: {', '.join(f'{file}:{name}' for name in ids)}")
    chosen = local._loaded.get(wanted or ids[0])
    if chosen is None:
        raise UnknownSensor(wanted, ids, place=str(file))
    return registry().hooked(local.hooked(chosen))


def _module(file: Path) -> ModuleType:
    if not file.is_file():
        raise SourceError(f"{file}: no such file")
    module_spec = importlib.util.spec_from_file_location(f"lidarspec_file_{file.stem}", file)
    assert module_spec is not None
    assert module_spec.loader is not None
    module = importlib.util.module_from_spec(module_spec)
    try:
        module_spec.loader.exec_module(module)
    except LidarSpecError:
        raise
    except (Exception, SystemExit) as error:
        raise SpecError(f"{type(error).__name__}: {error}", path=str(file)) from error
    return module
