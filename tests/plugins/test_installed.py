"""Tests of entry points and of loading a plugin only for its own ids."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import subprocess
import sys
import threading
import warnings
import zipfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from lidarspec import Sensor, UsageError
from lidarspec.entry_points import EntryPoint, entry_points
from lidarspec.errors import UnknownSensor
from lidarspec.plugins import HookedPoints, Registry, named_owners, try_plugins
from lidarspec.spec import hookimpl
from lidarspec.trusted_files import user_settings_path
from tests.shapes import SHAPES


def by_metadata(group: str) -> list[tuple[str, str, str, str]]:
    """Return the entry points as importlib.metadata finds them."""
    found = [
        (e.name, e.value, e.dist.name, e.dist.version)
        for e in importlib.metadata.entry_points(group=group)
        if e.dist
    ]
    return sorted(found, key=lambda entry: entry[:2])


def distribution(
    place: Path, name: str, version: str, entries: str, kind: str = "dist-info"
) -> None:
    """Write the metadata of a distribution as an installer does."""
    folder = place / f"{name}-{version}.{kind}"
    folder.mkdir(parents=True)
    (folder / "entry_points.txt").write_text(entries, encoding="utf-8")
    header = (
        f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n\n"
        "Name: a line of its description\n"
    )
    (folder / ("METADATA" if kind == "dist-info" else "PKG-INFO")).write_text(
        header, encoding="utf-8"
    )


@pytest.mark.parametrize("zipped", [False, True])
def test_odd_installations_are_read_as_importlib_metadata_reads_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zipped: bool
) -> None:
    first, second, other = tmp_path / "first", tmp_path / "second", tmp_path / "other.zip"
    distribution(
        first,
        "Some.Lidars",
        "2.0",
        "[else]\nx = no\n[odd.group]\n# y = no\n b = some.lidars:inner.part [extra]\n\na- = some\n",
    )
    distribution(second, "some_lidars", "1.0", "[odd.group]\nold = hidden\n")
    distribution(second, "eggs", "3", "[odd.group]\nc = eggs\n", "egg-info")
    (second / "bare-1.dist-info").mkdir()
    with zipfile.ZipFile(other, "w") as archive:
        archive.writestr("packed-4.dist-info/entry_points.txt", "[odd.group]\nd = packed\n")
        archive.writestr("packed-4.dist-info/METADATA", "Name: packed\nVersion: 4\n")
    places = [str(first), str(second), str(tmp_path / "missing"), *([str(other)] if zipped else [])]
    monkeypatch.setattr(sys, "path", [*places, *sys.path])
    found = entry_points("odd.group")
    assert found == by_metadata("odd.group")
    assert [entry.name for entry in found] == ["a-", "b", "c", *(["d"] if zipped else [])]
    assert found[0][2:] == ("Some.Lidars", "2.0")


def test_distributions_of_an_import_hook_are_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    distribution(tmp_path, "hooked", "1", "[odd.group]\nh = hooked\n")

    class Bare(importlib.metadata.PathDistribution):
        @property
        def metadata(self) -> Any:
            raise FileNotFoundError("No package metadata was found.")

    class Finder(importlib.metadata.DistributionFinder):
        def find_spec(self, *_: Any) -> None:
            return None

        def find_distributions(
            self, context: Any = None
        ) -> Iterable[importlib.metadata.Distribution]:
            return [
                Bare(tmp_path),
                importlib.metadata.PathDistribution(tmp_path / "hooked-1.dist-info"),
            ]

    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path, Finder()])
    assert [entry.name for entry in entry_points("odd.group")] == ["h"]


@pytest.mark.parametrize(
    "value",
    ["json", "json:decoder.JSONDecoder", " json : decoder.JSONDecoder ", "json:dumps [extra]"],
)
def test_an_entry_point_loads_as_its_reference_does(value: str) -> None:
    reference = importlib.metadata.EntryPoint("x", value.strip(), "g").load()
    assert EntryPoint("x", value, "d", "1").load() is reference


class Module(SimpleNamespace):
    """A module that records which of its sensors were requested by name."""

    def __getattr__(self, name: str) -> Sensor:
        known = self.__dict__.get("by_name", {})
        if name not in known:
            raise AttributeError(name)
        self.given.append(known[name].id)
        sensor: Sensor = known[name]
        return sensor


@pytest.fixture
def plugins(monkeypatch: pytest.MonkeyPatch) -> dict[str, SimpleNamespace]:
    """Return modules that can be loaded by name; each records requests for sensors."""
    found: dict[str, SimpleNamespace] = {}

    def made(name: str, *ids: str, aliases: tuple[str, ...] = (), **hooks: Any) -> SimpleNamespace:
        sensors = [
            replace(SHAPES["shape-count"], id=one, aliases=aliases, model=name) for one in ids
        ]
        module = Module(
            asked=0,
            given=[],
            **{hook: hookimpl(specname=None)(function) for hook, function in hooks.items()},
        )
        module.by_name = {sensor.id.replace("-", "_"): sensor for sensor in sensors}
        module.by_name |= {alias.replace("-", "_"): sensors[0] for alias in aliases}

        def lidarspec_sensors() -> list[Sensor]:
            module.asked += 1
            return sensors

        module.lidarspec_sensors = hookimpl(lidarspec_sensors)
        monkeypatch.setitem(sys.modules, name, module)
        found[name] = module
        return module

    made("acme", "acme-x1", "acme-x2", aliases=())
    made("beta", "beta-x1", aliases=("b-one",))
    made("plain", "plain-x1")
    made("again", "acme-x2", "acme-x3")
    made("liar", "liar-x1", "acme-x9")
    made("odd")
    made("meddler", "meddler-x1", lidarspec_points=lambda sensor, fields: None)
    return found


def registry(*entries: str, offered: str = "") -> Registry:
    """Return a registry of modules and of sensors, in the order of discovery.

    Each module is given as "name = value".

    Args:
        offered: "id = module" for each sensor, separated by blanks around a comma.
    """

    def found(texts: Iterable[str]) -> list[EntryPoint]:
        return [
            EntryPoint(name, value, "dist", "1")
            for name, _, value in sorted(text.partition(" = ") for text in texts)
        ]

    named = (text.partition(" = ") for text in offered.split(", ") if text)
    sensors = [f"{name} = {module}:{name.replace('-', '_')}" for name, _, module in named]
    return Registry(found(entries), found(sensors))


OFFERED = "acme-x1 = acme, acme-x2 = acme, beta-x1 = beta, b-one = beta"


def test_a_sensor_is_loaded_on_first_use(plugins: dict[str, SimpleNamespace]) -> None:
    found = registry("plain = plain", offered=OFFERED)
    assert (plugins["plain"].asked, plugins["acme"].asked, plugins["beta"].asked) == (1, 0, 0)
    assert found.sensor("acme-x2").id == "acme-x2"
    assert found.sensor("acme-x2") is found.sensor("acme-x2")
    assert (plugins["acme"].given, plugins["beta"].given) == (["acme-x2"], [])
    assert found.sensor("b-one") is found.sensor("beta-x1")
    assert sorted(found.sensors()) == ["acme-x1", "acme-x2", "beta-x1", "plain-x1"]
    assert plugins["again"].given == []
    assert [(plugin.entry_point, plugin.sensors) for plugin in found.plugins] == [
        ("plain = plain", ("plain-x1",)),
        ("lidarspec.sensors = acme", ("acme-x1", "acme-x2")),
        ("lidarspec.sensors = beta", ("beta-x1",)),
    ]


def test_an_alias_without_an_entry_of_its_own_is_known_once_all_are_loaded(
    plugins: dict[str, SimpleNamespace],
) -> None:
    assert registry(offered="acme-x1 = acme, beta-x1 = beta").sensor("b-one").id == "beta-x1"


def test_names_of_entry_points_are_aliases(plugins: dict[str, SimpleNamespace]) -> None:
    entries = [
        EntryPoint(name, "liar:liar_x1", "dist", "1") for name in ("liar-x1", "x1", "liar-x1b")
    ]
    found = Registry(offered=entries)
    assert found.sensor("x1").aliases == ("liar-x1b", "x1")
    assert found.sensor("liar-x1b") is found.sensor("liar-x1")


def test_an_unknown_id_gets_suggestions_from_all_plugins(
    plugins: dict[str, SimpleNamespace],
) -> None:
    with pytest.raises(UnknownSensor, match="did you mean 'beta-x1'"):
        registry(offered=OFFERED).sensor("bta-x1")


def test_sensor_of_a_broken_distribution_is_named_with_its_error(
    plugins: dict[str, SimpleNamespace],
) -> None:
    expected = (
        "unknown sensor 'acme-x7': the distribution dist provides it, but failed to load: "
        "ModuleNotFoundError: No module named 'a_module_that_nobody_has'"
    )
    for name in ("acme-x7", "ACME_X7"):
        with pytest.raises(UnknownSensor) as raised:
            registry(offered=f"{OFFERED}, acme-x7 = a_module_that_nobody_has").sensor(name)
        assert str(raised.value) == expected
        assert raised.value.__notes__ == ["next: lidarspec plugins"]


def test_unknown_sensor_names_plugins_of_unknown_content_that_failed(
    plugins: dict[str, SimpleNamespace],
) -> None:
    with pytest.raises(
        UnknownSensor,
        match=(
            r"^unknown sensor 'gamma-x1'.*; dist failed to load:"
            r" ModuleNotFoundError: .* 'a_module_that"
        ),
    ):
        registry("gamma = a_module_that_nobody_has", offered=OFFERED).sensor("gamma-x1")


@pytest.mark.parametrize("asked", [["acme-x1"], ["acme-x3"], ["other-x1"], ["acme-x2"], []])
def test_the_first_of_two_plugins_with_one_id_wins(
    plugins: dict[str, SimpleNamespace], asked: list[str]
) -> None:
    found = registry(offered="acme-x1 = acme, acme-x2 = acme, acme-x2 = again, acme-x3 = again")
    for name in asked:
        with contextlib.suppress(UnknownSensor):
            found.sensor(name)
    assert found.sensor("acme-x2").model == "acme"
    assert sorted(found.sensors()) == ["acme-x1", "acme-x2", "acme-x3"]
    assert [(plugin.error, plugin.sensors) for plugin in found.plugins] == [
        ("", ("acme-x1", "acme-x2")),
        ("acme-x2: this id is already used by dist:acme", ("acme-x3",)),
    ]


@pytest.mark.parametrize(
    ("offered", "error"),
    [
        (
            "liar-x2 = liar",
            "liar-x1: the name of an entry point must be the id or an alias of its sensor, not"
            " 'liar-x2' (liar:liar_x2)",
        ),
        (
            "odd-x1 = odd",
            "must name a Sensor, but odd:odd_x1 has the type int",
        ),
        ("gone-x1 = a_module_that_nobody_has", "ModuleNotFoundError"),
        ("acme-x7 = acme", "AttributeError"),
    ],
)
def test_an_entry_that_names_no_such_sensor_is_named_and_leaves_nothing(
    plugins: dict[str, SimpleNamespace], offered: str, error: str
) -> None:
    plugins["liar"].liar_x2 = plugins["liar"].liar_x1
    plugins["odd"].odd_x1 = 1
    found = registry("plain = plain", offered=offered)
    assert list(found.sensors()) == ["plain-x1"]
    (broken,) = [plugin for plugin in found.plugins if plugin.error]
    assert error in broken.error
    assert broken.traceback


def test_a_sensor_cannot_take_an_id_from_a_module_that_is_always_loaded(
    plugins: dict[str, SimpleNamespace],
) -> None:
    found = registry("zz = again", offered="acme-x2 = acme")
    assert found.sensor("acme-x2").model == "again"
    assert [plugin.error for plugin in found.plugins] == [
        "",
        "acme-x2: this id is already used by dist:again",
    ]


def test_threads_that_ask_at_once_get_the_same_sensor(plugins: dict[str, SimpleNamespace]) -> None:
    for _ in range(50):
        found = registry(offered=OFFERED)
        with ThreadPoolExecutor(8) as pool:
            sensors = list(pool.map(found.sensor, ["acme-x1", "b-one", "beta-x1", "acme-x1"] * 4))
        assert len({id(sensor) for sensor in sensors}) == 2
        assert not any(plugin.error for plugin in found.plugins)


def test_hooks_apply_to_sensors_of_entry_points(
    plugins: dict[str, SimpleNamespace],
) -> None:
    found = registry("meddler = meddler", offered="acme-x1 = acme")
    assert isinstance(found.sensor("acme-x1").points, HookedPoints)
    found.sensor("acme-x1")
    found.add(plugins["acme"], name="again")
    with pytest.raises(
        UsageError, match="acme-x1: dist and again each contain a sensor with this name"
    ):
        found.sensor("acme-x1")


def make_registry(*claims: str, owners: dict[str, str] | None = None) -> Registry:
    """Return a registry of sensors that distributions claim.

    Each claim is "distribution: name = module, ..."; an alias is given as "name = module:id".
    """
    offered = []
    for claim in claims:
        distribution, _, entries = claim.partition(": ")
        for entry in entries.split(", "):
            name, _, value = entry.partition(" = ")
            module, _, attribute = value.partition(":")
            offered.append(
                EntryPoint(
                    name, f"{module}:{(attribute or name).replace('-', '_')}", distribution, "1"
                )
            )
    return Registry([], offered, lambda: owners or {})


OWNED = "lidarspec-acme: acme-x1 = acme, acme-x2 = acme"


@pytest.mark.parametrize("asked", [[], ["acme-x3"], ["acme-x2"], ["acme-x1"]])
@pytest.mark.parametrize("stranger", ["a-stranger", "lidarspec-beta", "lidarspec", "lidarspec-acm"])
def test_the_owner_of_an_id_has_it_and_the_other_keeps_the_rest(
    plugins: dict[str, SimpleNamespace], asked: list[str], stranger: str
) -> None:
    found = make_registry(f"{stranger}: acme-x2 = again, acme-x3 = again", OWNED)
    for name in asked:
        found.sensor(name)
    assert {name: sensor.model for name, sensor in found.sensors().items()} == {
        "acme-x1": "acme",
        "acme-x2": "acme",
        "acme-x3": "again",
    }
    assert found.sensor("ACME X2").model == "acme"
    assert [(plugin.distribution, plugin.sensors, plugin.error) for plugin in found.plugins] == [
        (
            stranger,
            ("acme-x3",),
            "acme-x2: this id is already used by lidarspec-acme:acme",
        ),
        ("lidarspec-acme", ("acme-x1", "acme-x2"), ""),
    ]


def test_whom_the_user_names_comes_before_the_vendor(plugins: dict[str, SimpleNamespace]) -> None:
    found = make_registry(
        "my-fork: acme-x2 = again, acme-x3 = again", OWNED, owners={"acme-x2": "My_Fork"}
    )
    assert {name: sensor.model for name, sensor in found.sensors().items()} == {
        "acme-x1": "acme",
        "acme-x2": "again",
        "acme-x3": "again",
    }
    assert [plugin.error for plugin in found.plugins] == [
        "",
        "acme-x2: this id is already used by my-fork:again",
    ]


@pytest.mark.parametrize("text", ["[owners", "owners = 3", "[owners]\nacme-x1 = 3"])
def test_owners_that_cannot_be_read_are_warned_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    for name in ("XDG_CONFIG_HOME", "APPDATA"):
        monkeypatch.setenv(name, str(tmp_path))
    (file := user_settings_path()).parent.mkdir()
    file.write_text(text, encoding="utf-8")
    warning = rf"{file}: .*; the table \[owners\] of this file is ignored"
    with pytest.warns(UserWarning, match=warning):
        assert named_owners() == {}


def test_an_alias_without_entry_point_belongs_to_its_owner(
    plugins: dict[str, SimpleNamespace],
) -> None:
    plugins["liar"].by_name["liar_x1"] = replace(
        plugins["liar"].by_name["liar_x1"], aliases=("b-one", "acme-x1")
    )
    strangers = "a-stranger: liar-x1 = liar"
    found = make_registry(strangers, "lidarspec-beta: beta-x1 = beta, b-one = beta:beta-x1", OWNED)
    for _ in range(2):  # before the stranger's is loaded, and after
        assert (found.sensor("b-one").id, found.sensor("acme-x1").model) == ("beta-x1", "acme")
        assert found.sensor("liar-x1").id == "liar-x1"
    assert sorted(found.sensors()) == ["acme-x1", "acme-x2", "beta-x1", "liar-x1"]
    plugins["again"].by_name["b_one"] = replace(
        plugins["again"].by_name["acme_x3"], aliases=("b-one",)
    )
    found = make_registry(
        "a-stranger: b-one = again, acme-x3 = again",
        "lidarspec-beta: beta-x1 = beta, b-one = beta:beta-x1",
    )
    assert found.sensor("b-one").id == "beta-x1"
    assert sorted(found.sensors()) == ["acme-x3", "beta-x1"]


def test_an_id_without_owner_is_an_error_only_when_used(
    plugins: dict[str, SimpleNamespace],
) -> None:
    found = make_registry(
        "one-lidars: acme-x2 = again, acme-x3 = again", "two-lidars: acme-x1 = acme, acme-x2 = acme"
    )
    with pytest.raises(
        UsageError,
        match=r'one-lidars and two-lidars each contain .*\[owners\]: acme-x2 = "one-lidars"',
    ):
        found.sensor("acme-x2")
    assert sorted(found.sensors()) == ["acme-x1", "acme-x3"]
    assert [(plugin.sensors, plugin.error) for plugin in found.plugins] == [
        (("acme-x3",), "acme-x2: this id is already used by two-lidars:acme"),
        (("acme-x1",), "acme-x2: this id is already used by one-lidars:again"),
    ]
    assert "acme-x2" not in found
    assert "acme-x3" in found


def test_a_broken_owner_is_not_replaced(
    plugins: dict[str, SimpleNamespace],
) -> None:
    found = make_registry(
        "a-stranger: acme-x2 = again", "lidarspec-acme: acme-x2 = a_module_that_nobody_has"
    )
    with pytest.raises(UnknownSensor):
        found.sensor("acme-x2")


@pytest.mark.parametrize("zipped", [False, True])
def test_entry_points_that_are_not_text_are_named_and_keep_nothing_else_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zipped: bool
) -> None:
    distribution(tmp_path, "good", "1", "[odd.group]\na = json\n")
    distribution(tmp_path, "bad", "2", "")
    (tmp_path / "bad-2.dist-info" / "entry_points.txt").write_bytes(
        b"[odd.group]\nb = json\n[console_scripts]\nm\xfcller = bad:main\n"
    )
    distribution(tmp_path, "worse", "3", "[odd.group]\nc = json\n")
    (tmp_path / "worse-3.dist-info" / "METADATA").write_bytes(
        b"Name: worse\nVersion: 3\nAuthor: M\xfcller\n"
    )
    if zipped:
        with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
            archive.writestr("packed-4.dist-info/METADATA", "Name: packed\nVersion: 4\n")
    monkeypatch.setattr(
        sys, "path", [str(tmp_path), *([str(tmp_path / "other.zip")] * zipped), *sys.path]
    )
    assert {entry.distribution for entry in entry_points("odd.group")} >= {"good"}
    (named,) = [
        plugin
        for plugin in Registry(entry_points("lidarspec")).plugins
        if "bad" in plugin.distribution
    ]
    assert "entry_points.txt is not UTF-8" in named.error


def test_a_plugin_that_takes_long_is_named_while_it_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "slow_lidars.py").write_text(
        "import its_end\nits_end.come.wait(60)\n", encoding="utf-8"
    )
    end = threading.Event()
    monkeypatch.setitem(sys.modules, "its_end", SimpleNamespace(come=end))  # type: ignore[arg-type]
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("lidarspec.plugins.LOAD_WARNING_S", 0.01)
    told: list[str] = []

    def tell(message: Warning | str, *_: Any, **more: Any) -> None:
        told.append(str(message))
        end.set()

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        monkeypatch.setattr(warnings, "showwarning", tell)
        Registry([EntryPoint("slow", "slow_lidars", "slow-lidars", "1")])
    assert told == [
        "slow-lidars: slow_lidars has been loading for 0.01 s; if it hangs, run `lidarspec plugins`"
        " to see where"
    ]


def test_a_plugin_that_hangs_is_left_out_and_the_others_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "import its_end\n\nits_end.come.wait(60)\nits_end.gone.set()\n"
    (tmp_path / "hanging_lidars.py").write_text(code, encoding="utf-8")
    end, gone = threading.Event(), threading.Event()
    monkeypatch.setitem(sys.modules, "its_end", SimpleNamespace(come=end, gone=gone))  # type: ignore[arg-type]
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("lidarspec.plugins.LOAD_WARNING_S", 0.01)
    monkeypatch.setattr("lidarspec.plugins.LOAD_TIMEOUT_S", 0.02)
    monkeypatch.setattr("lidarspec.plugins._hanging", {})
    hanging = [
        EntryPoint("a", "hanging_lidars", "hanging-lidars", "1"),
        EntryPoint("acme-x1", "hanging_lidars:X1", "hanging-lidars", "1"),
    ]
    good = next(
        entry for entry in entry_points("lidarspec.sensors") if entry.name == "cspc-m1c1-mini"
    )
    good.load()  # so that it does not take long
    with pytest.warns(UserWarning, match="the plugin is ignored"):
        found = Registry(hanging[:1], [hanging[1], good])
    assert found.sensor("cspc-m1c1-mini").id == "cspc-m1c1-mini"
    reasons = [plugin.error for plugin in found.plugins if plugin.distribution == "hanging-lidars"]
    assert len(reasons) == 2
    assert all(
        reason.startswith("the plugin hangs: loading took more than 0.02 s") for reason in reasons
    )
    end.set()
    assert gone.wait(60)


@pytest.mark.slow
def test_a_verb_runs_beside_a_plugin_that_hangs(tmp_path: Path) -> None:
    distribution(tmp_path, "hanging", "1", "[lidarspec]\nhanging = hanging_lidars\n")
    (tmp_path / "hanging_lidars.py").write_text("import time\ntime.sleep(600)\n", encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-m", "lidarspec", "parse", "545a", "-s", "ldrobot-stl27l"]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    assert (
        "hanging: the plugin hangs: loading took more than 10 s at"
        f" {tmp_path / 'hanging_lidars.py'}, line 2" in done.stderr
    )
    assert done.returncode == 4


#: plugins that do odd things when they are loaded: code, error and remark.
ODD = {
    "ends": (
        "import os\nos._exit(7)",
        "loading the plugin ends the process with the exit status 7",
        "",
    ),
    "exits": ("import sys\nsys.exit('leaving')", "SystemExit: leaving", ""),
    "prints": (
        "import sys\nprint('hello')\nprint('\\x1b[2J', file=sys.stderr)",
        "",
        r"the plugin prints 'hello \x1b[2J'",
    ),
    "threads": (
        "import threading\nthreading.Thread(target=threading.Event().wait, name='mine').start()",
        "",
        "the plugin starts a thread that keeps running: mine",
    ),
}
HANGING = {
    "hangs": ("import time\ntime.sleep(600)", "the plugin hangs: loading took more than 0.5 s", "")
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plugins", "limit_s"), [(ODD, 600), (HANGING, 0.5)], ids=["odd", "hanging"]
)
def test_each_plugin_is_tried_in_a_process_of_its_own_if_anything_is_wrong(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    plugins: dict[str, tuple[str, str, str]],
    limit_s: float,
) -> None:
    for name, (code, _, _) in plugins.items():
        (tmp_path / f"odd_{name}.py").write_text(code, encoding="utf-8")
        distribution(tmp_path, f"odd_{name}", "1", f"[lidarspec]\n{name} = odd_{name}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("lidarspec.plugins.LOAD_TIMEOUT_S", limit_s)
    entries = entry_points("lidarspec")
    monkeypatch.setattr(
        "lidarspec.plugins.entry_points", lambda group: entries if group == "lidarspec" else []
    )
    monkeypatch.setattr(
        threading.Thread, "start", lambda thread: None if thread.name == "mine" else START(thread)
    )  # not here too
    found = {
        plugin.distribution.removeprefix("odd_"): (plugin.error, plugin.remark)
        for plugin in try_plugins()
    }
    assert found == {name: (error, remark) for name, (_, error, remark) in plugins.items()}


@pytest.mark.slow
def test_working_plugins_are_tried_in_one_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("one", "other"):
        (tmp_path / f"sound_{name}.py").write_text("", encoding="utf-8")
        distribution(tmp_path, f"sound_{name}", "1", f"[lidarspec]\n{name} = sound_{name}\n")
    monkeypatch.syspath_prepend(tmp_path)
    entries = [
        entry for entry in entry_points("lidarspec") if entry.distribution.startswith("sound")
    ]
    monkeypatch.setattr(
        "lidarspec.plugins.entry_points", lambda group: entries if group == "lidarspec" else []
    )
    run, started = subprocess.run, []
    monkeypatch.setattr(
        subprocess,
        "run",
        lambda command, **more: [started.append(command), run(command, **more)][1],
    )
    assert {plugin.distribution: (plugin.error, plugin.remark) for plugin in try_plugins()} == {
        "sound_one": ("", ""),
        "sound_other": ("", ""),
    }
    assert len(started) == 1


START = threading.Thread.start
