"""Where in a plugin's text a part of its spec stands: fields, frames, functions, commands and sensors, by file and line."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from lidarspec.spec import Sensor
from lidarspec.testing.findings import Finding

Spot = tuple[str, int]


class Places:
    """The text of some modules, to be asked where things stand in it."""

    def __init__(self, files: Iterable[Path]) -> None:
        self._fields: list[tuple[tuple[str, ...], Spot]] = []
        self._keys: dict[str, Spot] = {}
        self._frames: dict[str, Spot] = {}
        self._sensors: dict[str, Spot] = {}
        for file in files:
            tree = ast.parse(file.read_text(encoding="utf-8"), str(file))
            self._fields += [(chain, (str(file), line)) for chain, line in _fields(tree, ())]
            self._read(tree, str(file))

    def placed(self, finding: Finding, sensor: Sensor | None = None) -> Finding:
        """The finding with the file and line of what it is about, where they can be told."""
        if finding.file:
            return finding
        spot = self._spot(finding.path, sensor) or (self._sensors.get(sensor.id) if sensor else None)
        return replace(finding, file=spot[0], line=spot[1]) if spot else finding

    def _spot(self, path: str, sensor: Sensor | None) -> Spot | None:
        path = re.sub(r"\[\d*\]", "", path.rpartition(" ")[2])
        frame, _, below = path.partition(".")
        if frame == "commands":
            return self._keys.get(below.partition(".")[0])
        function = self._function(frame, below, sensor) if below in ("points", "plausible", "sweep") else None
        return function or (self._field(tuple(below.split("."))) if below else None) or self._frames.get(frame)

    def _function(self, frame: str, name: str, sensor: Sensor | None) -> Spot | None:
        if sensor is None or frame not in sensor.frames:
            return None
        function = getattr(sensor.frames[frame], name, None) or getattr(sensor, name, None)
        code = getattr(function, "__code__", None)
        return (code.co_filename, code.co_firstlineno) if code is not None else None

    def _field(self, parts: tuple[str, ...]) -> Spot | None:
        """The field whose names in the text are the longest end of the path."""
        fitting = [(len(chain), spot) for chain, spot in self._fields if parts[-len(chain) :] == chain]
        return max(fitting, key=lambda found: found[0])[1] if fitting else None

    def _read(self, tree: ast.Module, file: str) -> None:
        for node in ast.walk(tree):
            match node:
                case ast.Dict(keys=keys, values=values):
                    for key, value in zip(keys, values, strict=True):
                        if isinstance(key, ast.Constant) and isinstance(key.value, str):
                            self._keys.setdefault(key.value, (file, key.lineno))
                            if isinstance(value, ast.Call) and ast.unparse(value.func).endswith(("Frame", "replace")):
                                self._frames.setdefault(key.value, (file, key.lineno))
                case ast.Call(args=[ast.Constant(value=str(name)), *_]):
                    self._sensors.setdefault(name, (file, node.lineno))
                case ast.keyword(arg="id", value=ast.Constant(value=str(name))):
                    self._sensors.setdefault(name, (file, node.value.lineno))


def _fields(node: ast.AST, chain: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], int]]:
    """Every ``"name" / construct`` with the names that it stands within."""
    match node:
        case ast.BinOp(op=ast.Div(), left=ast.Constant(value=str(name)), right=right):
            yield (*chain, name), node.lineno
            yield from _fields(right, (*chain, name))
        case _:
            for child in ast.iter_child_nodes(node):
                yield from _fields(child, chain)
