"""Plugins: their hooks, and the registry of installed plugins.

A distribution names its sensors in the entry-point group ``lidarspec.sensors``, with one entry for
each id and alias, so that a request for one sensor loads only one plugin. A module with hooks is
named in the group ``lidarspec``, and is loaded before any sensor is returned. A hook is a function
with the name of a hook of this module, marked with ``@hookimpl``.

If a plugin cannot be loaded, its error is reported, and no other plugin is affected.
"""

from __future__ import annotations

import contextlib
import copyreg
import functools
import importlib
import importlib.util
import inspect
import itertools
import os
import re
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from reprlib import repr as shown
from types import ModuleType
from typing import TYPE_CHECKING, Any
from zlib import crc32

import pluggy

from lidarspec.entry_points import (
    GROUP,
    PAGE,
    SENSORS,
    VERBS,
    EntryPoint,
    entry_points,
    normalise_name,
)
from lidarspec.errors import (
    LidarSpecError,
    SourceError,
    SpecError,
    UnknownSensor,
    UsageError,
    suggest,
)
from lidarspec.known_sensors import (
    KnownLink,
    KnownSensor,
    select_known_sensors,
    unknown_sensor_error,
)
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.checksums import Checksum
from lidarspec.spec.description import Frame
from lidarspec.spec.links import Http, Link, Serial, Tcp, Udp
from lidarspec.spec.results import Points
from lidarspec.spec.syntax import iter_checksummed, prepare
from lidarspec.trusted_files import read_document, user_settings_path

if TYPE_CHECKING:
    from pathlib import Path

    import click

NAMESPACE = "lidarspec"

hookspec = pluggy.HookspecMarker(NAMESPACE)
hookimpl = pluggy.HookimplMarker(NAMESPACE)


@hookspec
def lidarspec_sensors() -> Iterable[Sensor]:  # type: ignore[empty-body]
    """Return the sensors that the plugin adds."""


@hookspec(firstresult=True)
def lidarspec_checksum(sensor: Sensor, frame: Frame) -> Checksum | None:
    """Return the checksum of a frame type; None to keep the declared checksum."""


@hookspec(firstresult=True)
def lidarspec_points(sensor: Sensor, fields: Any) -> Points | None:
    """Return the points of a batch of packets; None to use the sensor's own function."""


@hookspec(firstresult=True)
def lidarspec_source(url: str, sensor: Sensor | None) -> Any:
    """Return a transport for a URL scheme that lidarspec does not support, or None.

    Args:
        url: the source as the user typed it.
        sensor: the sensor that sends the data; None if unknown.
    """


@hookspec(firstresult=True)
def lidarspec_link(source: str, link: Link, host: str | None) -> Any:
    """Return the open transport of a link that lidarspec does not support, or None.

    Args:
        source: the URL of the source that was opened.
        link: the link that the sensor declares, over which commands are to be sent.
        host: the address of the sensor; None if unknown.
    """


@hookspec
def lidarspec_verbs() -> Iterable[click.Command]:  # type: ignore[empty-body]
    """Return the subcommands that a module adds to the command `lidarspec`.

    The module must be named in the entry-point group `lidarspec.verbs`.
    """


@hookspec(firstresult=True)
def lidarspec_page(
    source: str,
    sensor: str | Sensor | None,
    selection: Any,
    host: str,
    port: int,
    control: bool,
    report: Callable[[str], None],
) -> Any:
    """Open a source, and return the `lidarspec.view.page_server.PageServer` of its page.

    The module of this hook is named in the entry-point group `lidarspec.page`.

    Args:
        source: the source as the user typed it.
        sensor: the sensor; None to identify it.
        selection: the scans to show.
        host: the address to listen at.
        port: the port to listen at; 0 for any free port.
        control: whether pages may send commands to a real sensor.
        report: called with each message for the user.
    """


@hookspec
def lidarspec_formats() -> Iterable[Any]:  # type: ignore[empty-body]
    """Return the file formats that the plugin adds."""


#: If loading a plugin takes more than this time in seconds, a message is printed.
LOAD_WARNING_S = 5.0
#: If loading a plugin takes more than this time in seconds, it is treated as hanging.
LOAD_TIMEOUT_S = 10.0
#: The modules whose import hangs, and the error for each.
_hanging: dict[str, str] = {}
HOOKS = tuple(name for name in globals() if name.startswith("lidarspec_"))


#: The distribution and module of a plugin.
Home = tuple[str, str]


@dataclass(frozen=True, eq=False)
class HookedPoints:
    """A `points` function that calls the hooks of installed plugins first."""

    sensor: Sensor
    own: Callable[[Any], Points]
    hooks: Callable[..., Points | None]

    def __call__(self, fields: Any) -> Points:
        answer = self.hooks(sensor=self.sensor, fields=fields)
        if answer is None:
            return self.own(fields)
        return answer


@dataclass(frozen=True)
class Plugin:
    """An installed plugin.

    Attributes:
        distribution: the name of the distribution that contains the plugin.
        entry_point: the entry point that declares the plugin.
        sensors: the ids that the plugin adds.
        error: the reason why the plugin or one of its ids is not available; "" if there is no
            error.
        rule: the code of the rule of `lidarspec check` that explains the error; "" if there is
            none.
        failed_sensor: the id that the error concerns; "" if the error concerns the whole plugin.
        remark: a description of side effects of loading the plugin, such as printed text.
    """

    distribution: str
    version: str
    entry_point: str
    sensors: tuple[str, ...] = ()
    error: str = ""
    rule: str = ""
    failed_sensor: str = ""
    traceback: str = ""
    remark: str = ""

    @property
    def home(self) -> Home:
        """The distribution and the module of the plugin."""
        value = self.entry_point.partition(" = ")[2]
        entry = EntryPoint("", value, self.distribution, self.version)
        return self.distribution, entry.module


class Registry:
    """The plugins of this environment, and the sensors with their hooks applied.

    If several plugins have a sensor of the same name (id or alias), these rules decide, in this
    order, which plugin provides the sensor:

    * A plugin with an entry point of this name, or whose hook `lidarspec_sensors` returns the
      sensor, has priority over a plugin in which the name is only an id or alias of a sensor whose
      entry point has another name.
    * The user's settings may name the distribution that owns the name.
    * `lidarspec-VENDOR` owns the ids that begin with VENDOR, and the aliases of these sensors.
    * If one distribution has two modules with the name, the first module provides the sensor.

    If no rule decides, a request for the name is an error.

    Args:
        modules: entry points of modules with hooks, which are loaded immediately.
        offered: entry points of sensors, which are loaded on request, named by id or alias.
        owners: a function that returns the distributions that the user's settings name as owners,
            by id.
    """

    def __init__(
        self,
        modules: Iterable[EntryPoint] = (),
        offered: Iterable[EntryPoint] = (),
        owners: Callable[[], Mapping[str, str]] = dict,
    ) -> None:
        self._manager = pluggy.PluginManager(NAMESPACE)
        self._manager.add_hookspecs(sys.modules[__name__])
        self._named_owners = functools.cache(owners)
        self._sensors: dict[Home, dict[str, Sensor]] = {}
        # name -> the claiming plugins, and whether each claims it before it is loaded
        self._claims: dict[str, dict[Home, bool]] = {}
        self._ready: dict[str, Sensor] = {}
        self._offered: dict[Home, list[EntryPoint]] = {}
        self._tried: dict[EntryPoint, Plugin] = {}
        self._modules = [
            _load_entry(entry, entry.name, functools.partial(self._add_module, entry))
            for entry in modules
        ]
        for entry in offered:
            home = (entry.distribution, entry.module)
            self._offered.setdefault(home, []).append(entry)
            self._claims.setdefault(entry.name, {})[home] = True

    @property
    def plugins(self) -> list[Plugin]:
        """All installed plugins, including plugins that failed to load."""
        self._load_all()
        offered = [self._load_module(entries) for entries in self._offered.values()]
        return [self._drop_lost_names(plugin) for plugin in (*self._modules, *offered)]

    def _drop_lost_names(self, plugin: Plugin) -> Plugin:
        """Return a plugin without the ids that another plugin owns."""
        home = plugin.home
        own = sorted(name for name in self._sensors.get(home, {}) if self._find_owner(name) == home)
        lost = [
            name
            for name, homes in self._claims.items()
            if home in homes and self._find_owner(name) != home
        ]
        if lost and not plugin.error:
            holder = self._find_owner(lost[0])
            if holder:
                others = [holder]
            else:
                others = [other for other in self._claims[lost[0]] if other != home]
            owners = ", ".join(":".join(other) for other in others)
            plugin = replace(
                plugin,
                error=f"{lost[0]}: this id is already used by {owners}",
                rule="LS005",
                failed_sensor=lost[0],
            )
        return replace(plugin, sensors=tuple(own))

    def add(self, plugin: Any, *, name: str) -> list[str]:
        """Register a module or object with hooks, and return the ids that it adds.

        Raises:
            SpecError: for an unknown hook, a wrong signature, or an invalid sensor; nothing is
                registered.
        """
        _check_hooks(plugin, name)
        try:
            self._manager.register(plugin, name)
            sensors = self._make_sensors(plugin)
        except BaseException as error:
            if self._manager.has_plugin(name):
                self._manager.unregister(name=name)
            if isinstance(error, pluggy.PluginValidationError):
                raise SpecError(" ".join(str(error).split()), path=name, rule="LS004") from None
            raise
        distribution, _, module = name.partition(":")
        self._store_sensors((distribution, module), sensors, claimed=True)
        self._ready.clear()
        return [sensor.id for sensor in sensors]

    def _add_module(self, entry: EntryPoint, plugin: Any) -> list[str]:
        return self.add(plugin, name=f"{entry.distribution}:{entry.module}")

    def _load(self, entry: EntryPoint) -> None:
        # If two threads load an entry at the same time, its sensor is added twice, with no effect.
        if entry not in self._tried:
            self._tried[entry] = _load_entry(
                entry, entry.name, functools.partial(self._add_offered, entry)
            )

    def _load_all(self) -> None:
        for entries in self._offered.values():
            for entry in entries:
                self._load(entry)

    def _add_offered(self, entry: EntryPoint, sensor: Any) -> list[str]:
        """Store the sensor of an entry point, and return a list with the sensor's id."""
        require_sensor(entry, sensor)
        self._check(sensor, [sensor])
        home = (entry.distribution, entry.module)
        names = {other.name for other in self._offered[home] if other.value == entry.value}
        if sensor.id not in names and entry.name not in sensor.aliases:
            raise SpecError(
                "the name of an entry point must be the id or an alias of its sensor, not"
                f" {entry.name!r} ({entry.value})",
                sensor=sensor.id,
            )
        aliases = sorted(names.union(sensor.aliases) - {sensor.id})
        self._store_sensors(home, [replace(sensor, aliases=aliases)])
        return [sensor.id]

    def _load_module(self, entries: list[EntryPoint]) -> Plugin:
        """Load all sensors of a module, and return the resulting plugin."""
        tried = [self._tried[entry] for entry in entries]
        failed = next((plugin for plugin in tried if plugin.error), tried[0])
        return replace(failed, entry_point=f"{SENSORS} = {entries[0].module}")

    def _make_sensors(self, plugin: Any) -> list[Sensor]:
        function = getattr(plugin, "lidarspec_sensors", None)
        if function is not None and _is_hook(function):
            sensors = list(function())
        else:
            sensors = []
        for sensor in sensors:
            self._check(sensor, sensors)
        return sensors

    def _store_sensors(self, home: Home, sensors: list[Sensor], *, claimed: bool = False) -> None:
        for sensor in sensors:
            self._sensors.setdefault(home, {})[sensor.id] = sensor
            for name in (sensor.id, *sensor.aliases):
                self._claims.setdefault(name, {}).setdefault(home, claimed)

    def _find_owner(self, name: str) -> Home | None:
        """Return the plugin that provides the sensor with a name, or None."""
        claims = self._claims.get(name, {})
        homes = [home for home, claimed in claims.items() if claimed] or list(claims)
        first = {normalise_name(home[0]): home for home in reversed(homes)}
        if len(first) < 2:
            return next(iter(first.values()), None)
        alike = {home: self._find_same_names(home, name) for home in first.values()}
        named = self._named_owners()
        wanted = {
            home: {normalise_name(named[other]) for other in names if other in named}
            for home, names in alike.items()
        }
        chosen = [home for home in alike if normalise_name(home[0]) in wanted[home]]
        owners = chosen or [
            home for home, names in alike.items() if not wanted[home] and _is_vendor(home[0], names)
        ]
        if len(owners) == 1:
            return owners[0]
        return None

    def _find_same_names(self, home: Home, name: str) -> set[str]:
        """Return all names under which a plugin registers a sensor."""
        entries = self._offered.get(home, [])
        values = {entry.value for entry in entries if entry.name == name}
        loaded = [{sensor.id, *sensor.aliases} for sensor in self._sensors.get(home, {}).values()]
        return {entry.name for entry in entries if entry.value in values}.union(
            *(names for names in loaded if name in names)
        )

    def _find(self, name: str) -> Sensor | None:
        """Return the sensor with a name; None if it does not exist or cannot be loaded.

        Raises:
            UsageError: if several distributions claim the name, and none owns it.
        """
        home = self._find_owner(name)
        if home is None:
            if name not in self._claims:
                return None
            claiming = list(dict.fromkeys(home[0] for home in self._claims[name]))
            error = UsageError(
                f"{name}: {' and '.join(claiming)} each contain a sensor with this name; choose"
                f" one of these distributions in {user_settings_path()}, below [owners]: {name} ="
                f' "{claiming[0]}"'
            )
            raise suggest(error, "lidarspec plugins")
        for entry in self._offered.get(home, []):
            if entry.name == name:
                self._load(entry)
        return next(
            (one for one in self._sensors.get(home, {}).values() if name in (one.id, *one.aliases)),
            None,
        )

    def _list_loaded_sensors(self) -> dict[str, Sensor]:
        """Return the loaded sensors by id, without ids that belong to another plugin."""
        return {
            name: sensor
            for home, own in self._sensors.items()
            for name, sensor in own.items()
            if self._find_owner(name) == home
        }

    def names(self) -> list[str]:
        """Return every id and alias, sorted, without loading entry points."""
        return sorted(self._claims)

    def __contains__(self, name: str) -> bool:
        """Return whether there is a sensor with this id or alias."""
        if self.find(name) is not None:
            return True
        self._load_all()
        return self.find(name) is not None

    def find(self, name: str) -> Sensor | None:
        """Return the sensor with an id or alias; None if there is none."""
        if self._find_owner(name) is None or self._find(name) is None:
            return None
        return self.sensor(name)

    def sensors(self) -> dict[str, Sensor]:
        """Return every sensor by id, sorted, with its hooks applied.

        Sensors are omitted if several distributions claim their id and none owns it.
        """
        self._load_all()
        return {name: self.sensor(name) for name in sorted(self._list_loaded_sensors())}

    @property
    def failures(self) -> list[Plugin]:
        """The plugins that have an error, among the plugins that were loaded so far."""
        offered = [
            self._load_module([entry for entry in entries if entry in self._tried])
            for entries in self._offered.values()
            if any(entry in self._tried for entry in entries)
        ]
        return [
            plugin
            for plugin in map(self._drop_lost_names, (*self._modules, *offered))
            if plugin.error
        ]

    def list_sensors(self) -> list[KnownSensor]:
        """Return a `KnownSensor` for each installed sensor, sorted by id."""
        described = select_known_sensors(itertools.chain.from_iterable(self._offered.values()))
        names = {(row.distribution, name) for row in described for name in row.names}
        for entries in self._offered.values():
            for entry in entries:
                if (entry.distribution, entry.name) not in names:
                    self._load(entry)
        rows = {row.id: row for row in described if self._has_name(row.distribution, row.id)}
        for name, sensor in self._list_loaded_sensors().items():
            home = self._find_owner(name)
            if name not in rows and home is not None:
                rows[name] = make_row(sensor, home[0], self._find_version(home[0]))
        return [rows[name] for name in sorted(rows)]

    def _has_name(self, distribution: str, name: str) -> bool:
        home = self._find_owner(name)
        return home is not None and home[0] == distribution

    def _find_version(self, distribution: str) -> str:
        versions = (
            entry.version
            for entries in self._offered.values()
            for entry in entries
            if entry.distribution == distribution
        )
        loaded = (plugin.version for plugin in self._modules if plugin.distribution == distribution)
        return next(versions, None) or next(loaded, "")

    def sensor(self, name: str) -> Sensor:
        """Return a sensor by id or alias, with its hooks applied.

        Upper and lower case, and the separators in the name, make no difference.

        Raises:
            UnknownSensor: if no sensor has this name; the message suggests names or packages.
            UsageError: if several distributions claim the name, and none owns it.
        """
        if name in self._ready:
            return self._ready[name]
        plugin_sensor = self._find(name)
        if plugin_sensor is None:
            self._load_all()
            name = next(
                (known for known in self._claims if _keep_letters(known) == _keep_letters(name)),
                name,
            )
            plugin_sensor = self._find(name)
        if plugin_sensor is not None and plugin_sensor.id != name:
            own = plugin_sensor
            name = plugin_sensor.id  # the owner of an id also owns the aliases
            plugin_sensor = self._find(name)
            if plugin_sensor is None or plugin_sensor.id != own.id:
                plugin_sensor = None
        if plugin_sensor is None:
            loaded = self._list_loaded_sensors()
            aliases = {alias: other.id for other in loaded.values() for alias in other.aliases}
            raise self._load_error(name) or unknown_sensor_error(
                name, loaded, aliases, self._list_failed_modules()
            )
        if name not in self._ready:
            # another thread may have stored it first
            self._ready.setdefault(name, self.apply_hooks(plugin_sensor))
        return self._ready[name]

    def _load_error(self, name: str) -> UnknownSensor | None:
        """Return the error for a sensor whose entry point failed to load; otherwise None."""
        for entry, plugin in self._tried.items():
            if entry.name == name and plugin.error:
                error = UnknownSensor(name, distribution=plugin.distribution, failure=plugin.error)
                return suggest(error, "lidarspec plugins")
        return None

    def _list_failed_modules(self) -> dict[str, str]:
        """Return the modules with hooks that failed to load: distribution -> error."""
        return {
            plugin.distribution: plugin.error
            for plugin in self._modules
            if plugin.error and not plugin.sensors
        }

    def apply_hooks(self, sensor: Sensor) -> Sensor:
        """Return a sensor with the checksum and points hooks of all plugins applied."""
        frames = {
            name: self._apply_checksum_hooks(sensor, frame) for name, frame in sensor.frames.items()
        }
        points = self._manager.hook.lidarspec_points
        if not points.get_hookimpls():
            return replace(sensor, frames=frames, hooked=self.apply_hooks)

        def add_hooks(function: Any) -> Any:
            if isinstance(function, Mapping):
                return {path: add_hooks(own) for path, own in function.items()}
            if function is None or isinstance(function, HookedPoints):
                return function
            return HookedPoints(sensor, function, points)

        frames = {
            name: replace(frame, points=add_hooks(frame.points)) for name, frame in frames.items()
        }
        return replace(
            sensor, frames=frames, points=add_hooks(sensor.points), hooked=self.apply_hooks
        )

    def call(self, hook: str, **arguments: Any) -> Any:
        """Call the hook with this name in all plugins, and return its result."""
        return getattr(self._manager.hook, hook)(**arguments)

    def _apply_checksum_hooks(self, sensor: Sensor, frame: Frame) -> Frame:
        """Return a frame with the checksum of the first hook that provides a checksum."""
        arguments = {"sensor": sensor, "frame": frame}
        for hook in reversed(self._manager.hook.lidarspec_checksum.get_hookimpls()):
            try:
                algorithm = hook.function(**{name: arguments[name] for name in hook.argnames})
                if algorithm is not None:
                    return _replace_checksum(frame, algorithm)
            except Exception as error:
                self._record_checksum_failure(
                    hook.plugin_name,
                    f"lidarspec_checksum for {sensor.id}: {type(error).__name__}: {error}",
                )
        return frame

    def _record_checksum_failure(self, name: str, reason: str) -> None:
        for index, plugin in enumerate(self._modules):
            if ":".join(plugin.home) == name and not plugin.error:
                self._modules[index] = replace(
                    plugin, error=reason, rule="LS010", traceback=traceback.format_exc()
                )

    def _check(self, sensor: Any, own: list[Any]) -> None:
        if not isinstance(sensor, Sensor):
            raise SpecError(
                f"lidarspec_sensors must return sensors, got {type(sensor).__name__}", rule="LS006"
            )
        for name in (sensor.id, *sensor.aliases):
            if sum(name in (s.id, *s.aliases) for s in own) > 1:
                raise SpecError(
                    "another sensor of the same plugin has this id",
                    sensor=name,
                    rule="LS005",
                )


def require_sensor(entry: EntryPoint, value: Any) -> None:
    """Check that an entry point of `lidarspec.sensors` names a sensor.

    Args:
        value: the object that the entry point names.

    Raises:
        SpecError: if the object is not a `Sensor`.
    """
    if not isinstance(value, Sensor):
        raise SpecError(
            f"an entry point of {SENSORS} must name a Sensor, but {entry.value} has the"
            f" type {type(value).__name__}",
            rule="LS007",
        )


def make_row(sensor: Sensor, distribution: str, version: str) -> KnownSensor:
    """Return a row of the table of known sensors for a sensor, without signatures."""
    return KnownSensor(
        sensor.id,
        sensor.vendor,
        sensor.model,
        sensor.status,
        distribution,
        version,
        sensor.aliases,
        summarize_links(sensor),
    )


def summarize_links(sensor: Sensor) -> dict[str, KnownLink]:
    """Return the links of a sensor by name, each with its kind and its bauds or ports."""
    return {name: _summarize_link(link) for name, link in sensor.links.items()}


def _summarize_link(link: Link) -> KnownLink:
    kind = type(link).__name__.lower()
    if isinstance(link, Serial):
        return KnownLink(kind, link.bauds)
    if isinstance(link, Udp):
        return KnownLink(kind, link.ports or _list_port(link.broadcast))
    if isinstance(link, Tcp | Http):
        return KnownLink(kind, _list_port(link.port))
    return KnownLink(kind)


def _list_port(port: int) -> tuple[int, ...]:
    """Return a tuple with the port; an empty tuple for port 0, which means any port."""
    return (port,) if port else ()


def _is_vendor(distribution: str, names: Iterable[str]) -> bool:
    """Return whether a distribution is `lidarspec-VENDOR` for the vendor of a name."""
    prefix, _, vendor = normalise_name(distribution).partition("-")
    return (
        prefix == NAMESPACE
        and bool(vendor)
        and any(name.startswith(f"{vendor}-") for name in names)
    )


def named_owners() -> dict[str, str]:
    """Return the owners that the user's settings name: id -> distribution.

    Invalid settings cause a Python warning.
    """
    file = user_settings_path()
    try:
        if file.is_file():
            named = read_document(file).get("owners", {})
        else:
            named = {}
        if not isinstance(named, dict) or not all(
            isinstance(value, str) for value in named.values()
        ):
            raise UsageError(
                f"{file}: [owners]: expected the id of a sensor and the name of a distribution,"
                ' such as acme-x1 = "acme-lidars"'
            )
    except LidarSpecError as error:
        warnings.warn(f"{error}; the table [owners] of this file is ignored", stacklevel=2)
        return {}
    return named


def _import_in_time(entry: EntryPoint) -> Any:
    """Import an entry point, and return its module or object.

    Raises:
        SpecError: if the import hangs.
        BaseException: any exception of the import.
    """
    if entry.module in _hanging:
        raise SpecError(_hanging[entry.module])
    if entry.module in sys.modules:
        return entry.load()
    outcome: list[tuple[Any, BaseException | None]] = []

    def load() -> None:
        try:
            outcome.append((entry.load(), None))
        except BaseException as error:
            outcome.append((None, error))

    thread = threading.Thread(target=load, name=f"import of {entry.module}", daemon=True)
    thread.start()
    thread.join(LOAD_WARNING_S)
    if thread.is_alive():
        warnings.warn(
            f"{entry.distribution}: {entry.module} has been loading for {LOAD_WARNING_S:g} s; if it"
            " hangs, run `lidarspec plugins` to see where",
            stacklevel=2,
        )
        thread.join(max(LOAD_TIMEOUT_S - LOAD_WARNING_S, 0))
    if not outcome:
        _hanging[entry.module] = (
            f"the plugin hangs: loading took more than {LOAD_TIMEOUT_S:g} s"
            f"{_describe_location(thread)}"
        )
        warnings.warn(
            f"{entry.distribution}: {_hanging[entry.module]}; the plugin is ignored",
            stacklevel=2,
        )
        raise SpecError(_hanging[entry.module])
    loaded, failure = outcome[0]
    if failure is not None:
        raise failure
    return loaded


def _describe_location(thread: threading.Thread) -> str:
    """Return where a thread imports a module: " at FILE, line NUMBER"; "" if unknown."""
    stack = traceback.extract_stack(sys._current_frames().get(thread.ident or 0))
    module_frames = [frame for frame in stack if frame.name == "<module>"]
    if not module_frames:
        return ""
    return f" at {module_frames[-1].filename}, line {module_frames[-1].lineno}"


def _load_entry(entry: EntryPoint, names: str, add: Callable[[Any], list[str]]) -> Plugin:
    """Load and register an entry point; return the plugin, with its error if any."""
    plugin = Plugin(entry.distribution, entry.version, f"{names} = {entry.value}")
    try:
        return replace(plugin, sensors=tuple(add(_import_in_time(entry))))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        if isinstance(error, LidarSpecError):
            reason = str(error)
        else:
            reason = f"{type(error).__name__}: {error}"
        failed = replace(plugin, error=reason, traceback=traceback.format_exc())
        if isinstance(error, SpecError):
            return replace(failed, rule=error.rule, failed_sensor=error.sensor)
        return failed


def _keep_letters(name: str) -> str:
    return re.sub(r"[\W_]", "", name).lower()


def _replace_checksum(frame: Frame, algorithm: Any) -> Frame:
    if not isinstance(algorithm, Checksum):
        raise SpecError(f"the hook must return a Checksum or None, got {type(algorithm).__name__}")
    struct = prepare(frame.struct)
    checksum = next(iter_checksummed(struct), None)
    if checksum is None:
        raise SpecError("the hook returns a checksum for a frame type that declares no checksum")
    checksum.algorithm = algorithm
    return replace(frame, struct=struct)


def _is_hook(function: Any) -> bool:
    return inspect.isroutine(function) and getattr(function, f"{NAMESPACE}_impl", None) is not None


def _check_hooks(plugin: Any, name: str) -> None:
    """Raise SpecError for a misspelt hook, which pluggy ignores silently."""
    for attribute in dir(plugin):
        function = getattr(plugin, attribute, None)
        if not _is_hook(function) and not (
            attribute.startswith("lidarspec_") and inspect.isfunction(function)
        ):
            continue
        if attribute not in HOOKS:
            raise SpecError(
                f"unknown hook {attribute!r}: expected one of {', '.join(HOOKS)}",
                path=name,
                rule="LS002",
            )
        if not _is_hook(function):
            raise SpecError(f"{attribute} lacks @hookimpl", path=name, rule="LS003")


#: The registry of this environment, if it has been used, and the registries that replace it.
_registries: list[Registry] = []


def registry() -> Registry:
    """Return the registry of this environment."""
    if not _registries:
        _registries.append(Registry(entry_points(GROUP), entry_points(SENSORS), named_owners))
    return _registries[-1]


def try_plugins() -> list[Plugin]:
    """Load all plugins in another process, and then in this process; return them.

    Plugins that hang or end the other process are not loaded in this process.
    """
    if len(_registries) > 1:  # a substitute is active
        return registry().plugins
    groups = [_list_hook_modules(), entry_points(SENSORS)]
    entries = {(entry.distribution, entry.module): entry for group in groups for entry in group}
    trials = _try_loading_all(list(entries))
    lost = [
        Plugin(
            entry.distribution,
            entry.version,
            f"{entry.name} = {entry.value}",
            error=trials[home][0],
        )
        for home, entry in entries.items()
        if trials[home][0]
    ]
    modules, offered = (
        [entry for entry in group if not trials[entry.distribution, entry.module][0]]
        for group in groups
    )
    return [
        replace(plugin, remark=trials[plugin.home][1])
        for plugin in Registry(modules, offered, named_owners).plugins
    ] + lost


def _list_hook_modules() -> list[EntryPoint]:
    """Return the first entry point of each module with hooks."""
    entries: dict[Home, EntryPoint] = {}
    for entry in entry_points(GROUP) + entry_points(VERBS) + entry_points(PAGE):
        entries.setdefault((entry.distribution, entry.module), entry)
    return list(entries.values())


def _try_loading_all(homes: list[Home]) -> dict[Home, tuple[str, str]]:
    """Return the result of `_try_loading` for each plugin."""
    from concurrent.futures import ThreadPoolExecutor

    nothing_wrong = ("", "")
    if _try_loading(*homes) == nothing_wrong:
        return dict.fromkeys(homes, nothing_wrong)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return dict(zip(homes, pool.map(_try_loading, homes), strict=True))


def _try_loading(*homes: Home) -> tuple[str, str]:
    """Load plugins in another process; return (error, side effects), each "" if none."""
    import subprocess

    mark = f"{os.urandom(8).hex()}:"
    code = "from lidarspec.plugins import load_alone; load_alone()"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    names = [name for home in homes for name in home]
    command = [sys.executable, "-P", "-c", code, *names, mark, str(LOAD_TIMEOUT_S)]
    hangs = f"the plugin hangs: loading took more than {LOAD_TIMEOUT_S:g} s"
    pipe = subprocess.PIPE
    try:
        done = subprocess.run(
            command,
            env=environment,
            timeout=9 * LOAD_TIMEOUT_S,
            stdin=pipe,
            stdout=pipe,
            stderr=pipe,
            check=False,
        )
    except subprocess.TimeoutExpired:  # a process that it started keeps its output open
        return hangs, ""
    output, complaints = (stream.decode(errors="replace") for stream in (done.stdout, done.stderr))
    printed, ended, threads = output.partition(mark)
    if not ended:
        if "Timeout (" in complaints:  # of `faulthandler.dump_traceback_later`
            return hangs, ""
        return f"loading the plugin ends the process with the exit status {done.returncode}", ""
    text = " ".join((printed + complaints).split())
    effects = list[str]()
    if text:
        effects.append(f"the plugin prints {shown(text)}")
    if threads:
        effects.append(f"the plugin starts a thread that keeps running: {threads}")
    return "", "; ".join(effects)


def load_alone() -> None:
    """Load the plugins in `sys.argv`, print the threads that keep running, and exit."""
    import faulthandler

    *names, mark, limit = sys.argv[1:]
    homes = set(zip(names[::2], names[1::2], strict=True))
    faulthandler.dump_traceback_later(float(limit), exit=True)
    groups = (_list_hook_modules(), entry_points(SENSORS))
    modules, offered = (
        [entry for entry in group if (entry.distribution, entry.module) in homes]
        for group in groups
    )
    before = set(threading.enumerate())
    Registry(modules, offered)._load_all()
    left = [thread.name for thread in threading.enumerate() if thread not in before]
    print(mark, ", ".join(left), sep="", end="", flush=True)
    os._exit(0)  # also ends remaining threads


def load_hooks(entry: EntryPoint) -> Registry:
    """Return a registry with the hooks of one entry point.

    Raises:
        SpecError: if the plugin cannot be loaded.
    """
    hooks = Registry()
    plugin_name = f"{entry.distribution}:{entry.module}"
    loaded = _load_entry(entry, entry.name, functools.partial(hooks.add, name=plugin_name))
    if loaded.error:
        raise SpecError(loaded.error, path=entry.distribution)
    return hooks


def load_verb(entry: EntryPoint) -> click.Command:
    """Return the verb that an entry point names, from the hook of its module.

    Raises:
        SpecError: if the plugin cannot be loaded, or has no such verb.
    """
    for commands in load_hooks(entry).call("lidarspec_verbs"):
        for command in commands:
            if command.name == entry.name:
                return command  # type: ignore[no-any-return]
    raise SpecError(
        f"the hook lidarspec_verbs returns no verb {entry.name!r}", path=entry.distribution
    )


@contextlib.contextmanager
def use_registry(other: Registry) -> Iterator[Registry]:
    """Use `other` as the registry of this environment within the context."""
    registry()
    _registries.append(other)
    try:
        yield other
    finally:
        _registries.remove(other)


def sensors() -> dict[str, Sensor]:
    """Return every installed sensor by id."""
    return registry().sensors()


def sensor(name: str | Path | Sensor) -> Sensor:
    """Return a sensor, by id or alias, or from a file.

    A file is given as "./mysensor.py", or as "./mysensor.py:id" if it has several sensors. A
    `Sensor` is returned unchanged.

    Raises:
        UnknownSensor: if no sensor has this name; the message suggests similar names.
        SourceError, SpecError: for a file that cannot be read, or describes no sensor.
    """
    if isinstance(name, Sensor):
        return name
    text = str(name)
    if is_file_name(text):
        return _load_file(text)
    return registry().sensor(text)


def is_file_name(text: str) -> bool:
    """Return whether a sensor's name is the name of a Python file, not an id."""
    return "/" in text or "\\" in text or text.endswith(".py")


def split_file_and_id(text: str) -> tuple[Path, str]:
    """Split "FILE" or "FILE.py:id" into the file and the id; "" without an id."""
    from pathlib import Path

    path, colon, wanted = text.partition(".py:")
    return Path(f"{path}.py" if colon else text), wanted


def no_sensors_error(path: str = "") -> SpecError:
    """Return the error for a file without a hook that returns sensors.

    Args:
        path: the file; "" for a message without the file.
    """
    return SpecError(
        "the file declares no sensors: add a function lidarspec_sensors, decorated with"
        " @hookimpl, that returns a list such as [SENSOR]",
        path=path,
        rule="LS006",
    )


def _load_file(text: str) -> Sensor:
    file, wanted = split_file_and_id(text)
    module = import_file(file)
    local = Registry()
    with _convert_errors(file):
        ids = local.add(module, name=str(file))
    if not ids:
        raise no_sensors_error(str(file))
    if len(ids) > 1 and not wanted:
        raise UsageError(
            f"{file} describes several sensors: choose one of"
            f" {', '.join(f'{file}:{name}' for name in ids)}"
        )
    if wanted and wanted not in ids:
        raise UnknownSensor(wanted, ids, place=str(file))
    chosen = local.sensor(wanted or ids[0])
    return registry().apply_hooks(chosen)


def import_file(file: Path) -> ModuleType:
    """Import a file as a module with a unique name.

    Raises:
        SourceError: if the file is missing.
        SpecError: if it cannot be imported.
    """
    if not file.is_file():
        raise SourceError(f"{file}: no such file")
    module_spec = importlib.util.spec_from_file_location(
        f"lidarspec_file_{file.stem}_{crc32(bytes(file.resolve())):08x}", file
    )
    if module_spec is None or module_spec.loader is None:
        raise SourceError(f"{file} is not a Python file: its name does not end in .py")
    module = importlib.util.module_from_spec(module_spec)
    sys.modules[module.__name__] = module
    try:
        with _convert_errors(file):
            module_spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[module.__name__]
        raise
    return module


@contextlib.contextmanager
def _convert_errors(file: Path) -> Iterator[None]:
    """Convert exceptions of the code in a file to `SpecError` with the file's name."""
    try:
        yield
    except LidarSpecError:
        raise
    except (Exception, SystemExit) as error:
        raise SpecError(f"{type(error).__name__}: {error}", path=str(file)) from error


def rebuild_sensor(sensor_id: str, options: Mapping[str, Any]) -> Sensor:
    """Return an installed sensor with options; pickle calls this to unpickle a sensor."""
    installed = sensor(sensor_id)
    return installed.configure(**options) if options else installed


def _reduce_sensor(value: Sensor) -> tuple[Callable[..., Sensor], tuple[str, dict[str, Any]]]:
    return rebuild_sensor, (value.id, dict(value.options))


copyreg.pickle(Sensor, _reduce_sensor)
