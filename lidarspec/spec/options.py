"""Read the accepted values of a sensor's options from annotations.

The `configure` function of a plugin declares its options as keyword parameters with annotations,
such as ``Literal["cm", "mm"]``, ``int | None`` or ``str | Path | Learned``.
"""

from __future__ import annotations

import base64
import inspect
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from numbers import Integral, Real
from os import PathLike
from reprlib import repr as shown
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, Literal, Optional, Union, get_args, get_origin, get_type_hints

from lidarspec.errors import SpecError, UsageError

#: The maximum size of learned content in bytes, after decompression.
MAX_LEARNED_BYTES = 1 << 20


class Learned(bytes):
    """The content of a file, received from a sensor, as the value of an option.

    The option usually takes the path of such a file. It also accepts this type if its annotation
    contains the type, as in ``calibration: str | Path | Learned``.
    """

    def __repr__(self) -> str:
        return f"Learned({len(self)} bytes)"

    def to_dict(self) -> dict[str, str]:
        """Return the content as JSON data, for example for the header of a recording."""
        return {"learned": base64.b64encode(zlib.compress(self)).decode()}

    @classmethod
    def of_dict(cls, data: Mapping[str, Any]) -> Learned:
        """Return the `Learned` from which `to_dict` made the data.

        Raises:
            UsageError: if the data is invalid, or has more than a megabyte of content.
        """
        reader = zlib.decompressobj()
        try:
            compressed = base64.b64decode(data["learned"], validate=True)
            content = reader.decompress(compressed, MAX_LEARNED_BYTES)
        except (KeyError, TypeError, ValueError, zlib.error):
            content = b""
        if not reader.eof or set(data) != {"learned"}:
            raise UsageError(f"expected data reported by the sensor, got {shown(data)}")
        return cls(content)

    @classmethod
    def content(cls, value: str | PathLike[str] | Learned) -> bytes:
        """Return the content of the file at a path, or the bytes of a `Learned`.

        Raises:
            UsageError: for a file that cannot be read.
        """
        if isinstance(value, cls):
            return bytes(value)
        try:
            with open(value, "rb") as file:
                return file.read()
        except (OSError, ValueError) as error:
            raise UsageError(f"{value!s}: {getattr(error, 'strerror', None) or error}") from None


#: The names that an annotation may use even if its module imports them for type checkers only.
_ANNOTATION_NAMES = {
    "Any": Any,
    "Learned": Learned,
    "Literal": Literal,
    "Optional": Optional,
    "Path": PathLike,  # importing pathlib takes longer than finding a sensor
    "Union": Union,
}


def _is_path(value: object) -> bool:
    return isinstance(value, str | PathLike)


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _is_whole_number(value: object) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _is_instance(kind: type, value: object) -> bool:
    return isinstance(value, kind)


#: For each type in an annotation, a function that tests a value. Values for other types are tested
#: only by the plugin.
_TESTS: dict[object, Callable[[object], bool]] = {
    PathLike: _is_path,
    Learned: partial(_is_instance, Learned),
    bool: partial(_is_instance, bool),
    float: _is_number,
    int: _is_whole_number,
    str: partial(_is_instance, str),
    NoneType: partial(_is_instance, NoneType),
}
#: The names of types in messages.
_WORDS: dict[object, str] = {
    PathLike: "a path",
    Learned: "data reported by the sensor",
    bool: "true or false",
    float: "a number",
    int: "a whole number",
    str: "a string",
}


@dataclass(frozen=True)
class OptionType:
    """The values that an option accepts.

    An option without types and choices accepts any value.

    Attributes:
        types: the types in the annotation.
        choices: the values of a `Literal` in the annotation.
    """

    types: tuple[object, ...] = ()
    choices: tuple[Any, ...] = ()

    @classmethod
    def from_annotation(cls, annotation: object) -> OptionType:
        """Return the type for the annotation of a parameter."""
        if annotation is inspect.Parameter.empty:
            return cls()
        if get_origin(annotation) in (Union, UnionType):
            members = get_args(annotation)
        else:
            members = (annotation,)
        types: list[object] = []
        choices: list[Any] = []
        for member in members:
            if get_origin(member) is Literal:
                choices.extend(get_args(member))
            elif isinstance(member, type) and issubclass(member, PathLike):
                types.append(PathLike)
            else:
                types.append(member)
        return cls(tuple(types), tuple(choices))

    @property
    def is_file(self) -> bool:
        """Whether a value can be the path of a file."""
        return PathLike in self.types

    def accepts(self, value: object) -> bool:
        """Return whether a value is one of the choices, or of one of the types."""
        if isinstance(value, Learned):
            return Learned in self.types
        if not self.types and not self.choices:
            return True
        if any(isinstance(value, type(choice)) and value == choice for choice in self.choices):
            return True
        return any(kind not in _TESTS or _TESTS[kind](value) for kind in self.types)

    def describe(self) -> str:
        """Return the accepted values for a message, for example "'cm' or 'mm'"."""
        words = [repr(choice) for choice in self.choices]
        for kind in self.types:
            is_part_of_path = kind is str and self.is_file
            if kind in _WORDS and not is_part_of_path:
                words.append(_WORDS[kind])
        return " or ".join(words) or "any other value"


def option_types(function: Callable[..., Any] | None) -> dict[str, OptionType]:
    """Return the types of the options of a `configure` function, by name.

    Raises:
        SpecError: for an annotation that cannot be evaluated.
    """
    if function is None:
        return {}
    plain: Any = function
    while isinstance(plain, partial):
        plain = plain.func
    names = {**_ANNOTATION_NAMES, **getattr(plain, "__globals__", {})}
    _, *parameters = inspect.signature(function).parameters.values()
    types = {}
    for parameter in parameters:
        annotation = parameter.annotation
        if isinstance(annotation, str):
            annotation = _evaluate(parameter.name, annotation, names)
        types[parameter.name] = OptionType.from_annotation(annotation)
    return types


def _evaluate(option: str, annotation: str, names: Mapping[str, Any]) -> object:
    """Return the type of an annotation that is written as text."""
    holder = SimpleNamespace(__annotations__={option: annotation})
    try:
        return get_type_hints(holder, globalns=dict(names))[option]
    except Exception as error:
        raise SpecError(
            f"the annotation {annotation!r} cannot be evaluated: {error}",
            path=f"configure.{option}",
        ) from None
