"""Read the parameters in ROS's part of the command line before the node exists.

rclpy passes parameters only to an existing node. Some parameters are needed earlier, because the
transports of the middleware are set when the first node is created. This module therefore reads the
same words and files as rclpy. It ignores everything that it cannot read, because rclpy reads it
again and reports invalid values.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml  # rclpy requires it

_PARAMETER_OPTIONS = ("-p", "--param")
_REMAP_OPTIONS = ("-r", "--remap")


def read_parameters(arguments: Sequence[str], node_name: str) -> dict[str, Any]:
    """Return the parameters that the command line and its files give to a node.

    Args:
        arguments: the words of the command line; only words after ``--ros-args`` count.
        node_name: the default name of the node, which the command line can change.
    """
    options = list(itertools.pairwise(_find_ros_words(arguments)))
    values_by_pattern: dict[str, dict[str, Any]] = {}
    for option, value in options:
        if option in _PARAMETER_OPTIONS:
            nodes = _read_assignment(value)
        elif option == "--params-file":
            nodes = list(_iter_nodes(_read_file(Path(value)), ""))
        else:
            continue
        for pattern, values in nodes:
            values_by_pattern.setdefault(pattern, {}).update(values)
    full_name = _find_full_name(options, node_name)
    parameters: dict[str, Any] = {}
    for pattern, values in values_by_pattern.items():
        if _is_name_of(pattern, full_name):
            parameters |= values
    return parameters


def _find_ros_words(arguments: Sequence[str]) -> list[str]:
    """Return the words between ``--ros-args`` and ``--``."""
    words = []
    is_ros = False
    for word in arguments:
        if word == "--ros-args":
            is_ros = True
        elif word == "--":
            is_ros = False
        elif is_ros:
            words.append(word)
    return words


def _find_full_name(options: Sequence[tuple[str, str]], node_name: str) -> str:
    """Return the name of the node with its namespace, after remapping."""
    namespace = ""
    for option, value in options:
        rule, _, name = value.partition(":=")
        if option not in _REMAP_OPTIONS:
            continue
        if rule.endswith("__node"):
            node_name = name
        elif rule.endswith("__ns"):
            namespace = name.rstrip("/")
    return f"{namespace}/{node_name}"


def _read_assignment(text: str) -> list[tuple[str, Mapping[str, Any]]]:
    """Return the node and the parameter of ``NAME:=VALUE`` or ``NODE:NAME:=VALUE``."""
    left, separator, value = text.partition(":=")
    node, _, name = left.rpartition(":")
    pattern = f"/{node.strip('/')}" if node else "/**"
    try:
        return [(pattern, {name: yaml.safe_load(value)})] if separator else []
    except yaml.YAMLError:
        return []


def _read_file(path: Path) -> Any:
    """Return the content of a file of parameters; None if it cannot be read."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return None


def _iter_nodes(tree: Any, name: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the names of nodes in a parameter file, with the parameters of each."""
    if not isinstance(tree, dict):
        return
    for key, value in tree.items():
        if key != "ros__parameters":
            yield from _iter_nodes(value, f"{name}/{str(key).strip('/')}")
        elif isinstance(value, dict):
            yield name, value


def _is_name_of(pattern: str, full_name: str) -> bool:
    """Return whether a pattern is the name of a node.

    ``*`` matches one part of a name, ``**`` any number of parts.
    """
    expression = re.escape(pattern).replace(r"/\*\*", r"(/[^/]+)*").replace(r"\*", r"[^/]+")
    return re.fullmatch(expression, full_name) is not None
