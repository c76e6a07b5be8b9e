"""The exceptions of lidarspec: one class for each party that may be at fault.

``SpecError`` reports a mistake of a plugin's author. Its subclass ``PluginError`` reports that a
function of a plugin has failed. ``UsageError`` reports a mistake of the caller, and ``WireError``
reports bytes that are not the expected frame. ``SourceError`` reports a failure of the system, and
``CommandError`` reports a failure of the device. Noise in a stream is not an error: decoders count
it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, TypeVar


class LidarSpecError(Exception):
    """The base class of all exceptions of lidarspec.

    If lidarspec raises any other exception, that is a bug.
    """


class SpecError(LidarSpecError):
    """A sensor's description is wrong: the fault of the plugin's author.

    Attributes:
        path: the field path, or the name of another item of the spec; "" if the error concerns the
            whole spec.
        reason: the fault.
        sensor: the id; "" if unknown.
        rule: the code of the rule of `lidarspec check` that explains the error; "" if there is
            none.
    """

    def __init__(self, reason: str, *, path: str = "", sensor: str = "", rule: str = "") -> None:
        self.reason = reason
        self.path = path
        self.sensor = sensor
        self.rule = rule
        super().__init__(": ".join(part for part in (sensor, path, reason) if part))


#: Packages that plugins and their tests call. The line at fault is never there.
_CALLED_PACKAGES = ("construct", "numpy", "pluggy", "hypothesis", "_pytest")


def struct_error(error: Exception, *, path: str, sensor: str = "") -> SpecError:
    """Return a `SpecError` for an exception in an expression or checksum of a struct."""
    reason = f"an expression of the struct raised {type(error).__name__}: {error}"
    return SpecError(reason, path=path, sensor=sensor, rule="LS115")


class PluginError(SpecError):
    """A function of a plugin raised an exception, or returned an unusable value.

    In streams, such errors are counted instead of raised.

    Attributes:
        file, line: the location in the plugin; "" and 0 if unknown.
        traceback: the traceback as text.
    """

    def __init__(
        self,
        reason: str,
        *,
        path: str = "",
        sensor: str = "",
        rule: str = "",
        file: str = "",
        line: int = 0,
        traceback: str = "",
    ) -> None:
        self.file = file
        self.line = line
        self.traceback = traceback
        super().__init__(reason, path=path, sensor=sensor, rule=rule)

    @classmethod
    def of(
        cls,
        error: Exception,
        what: str,
        *,
        sensor: str = "",
        function: Callable[..., Any] | None = None,
    ) -> PluginError:
        """Return the error for an exception of a plugin's function.

        Args:
            what: the text that names the function in the message, such as "points of data".
            function: the function, whose first line is the location if no code of the plugin was
                running.
        """
        from traceback import format_exception  # only needed after a failure

        if isinstance(error, PluginError):
            return error
        file, line = find_plugin_line(error)
        plain_function = getattr(function, "func", function)  # of a functools.partial
        code = getattr(plain_function, "__code__", None)
        if not file and code is not None:
            file = code.co_filename
            line = code.co_firstlineno
        location = f" ({format_path(file)}:{line})" if file else ""
        if type(error) is SpecError:
            kind = ""
        else:
            kind = f"{type(error).__name__}: "
        reason = f"{kind}{' '.join(str(error).split())}{location}"
        text = "".join(format_exception(error))
        return cls(
            reason,
            path=what,
            sensor=sensor,
            rule=getattr(error, "rule", ""),
            file=file,
            line=line,
            traceback=text,
        )


def escape_controls(text: str) -> str:
    """Return text with escaped control characters such as `\\x1b`.

    Line ends and tabs are kept.
    """
    if text.isascii() and text.replace("\n", "").isprintable():
        return text
    from unicodedata import category

    # control, format and surrogate characters; separators of lines and paragraphs
    controls = {
        character for character in text if category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp")
    } - {"\n", "\t"}
    return text.translate(
        {
            ord(character): character.encode("unicode_escape").decode("ascii")
            for character in controls
        }
    )


def format_path(file: str) -> str:
    """Return a path as text; it is relative if it is below the working directory."""
    if os.path.abspath(file).startswith(os.path.join(os.getcwd(), "")):
        return os.path.relpath(file)
    return file


def find_plugin_line(error: BaseException) -> tuple[str, int]:
    """Return file and line of the plugin's code that raised an exception, or "" and 0."""
    from traceback import extract_tb

    ours = os.path.join(os.path.dirname(__file__), "")
    for entry in reversed(extract_tb(error.__traceback__)):
        file = entry.filename
        if (
            os.path.isfile(file)
            and not file.startswith(ours)
            and not set(file.split(os.sep)) & set(_CALLED_PACKAGES)
        ):
            return file, entry.lineno or 0
    return "", 0


@contextmanager
def plugin_errors(
    what: str, sensor: str, function: Callable[..., Any] | None = None
) -> Iterator[None]:
    """Convert exceptions in the body of a with statement to `PluginError`.

    Args:
        what: the text that names the plugin's function in the message, such as "points of data".
        sensor: the id of the sensor.
        function: the function, whose first line is the location if no code of the plugin was
            running.
    """
    try:
        yield
    except Exception as error:
        raise PluginError.of(error, what, sensor=sensor, function=function) from error


class WireError(LidarSpecError):
    """Bytes that are not the expected frame.

    Attributes:
        sensor, frame: the id of the sensor and the name of the frame type; "" if unknown.
        kind: the kind of fault, such as "checksum" or "trailing bytes"; "" for other kinds.
        offset: byte offset of the fault in the data.
        path: field path with array indices; "" if the fault concerns the whole frame.
        expected, got: the expected and the actual value.
        data: the bytes.
    """

    def __init__(
        self,
        reason: str,
        *,
        sensor: str = "",
        frame: str = "",
        kind: str = "",
        offset: int = 0,
        path: str = "",
        expected: object = None,
        got: object = None,
        data: bytes = b"",
    ) -> None:
        self.reason = reason
        self.kind = kind
        self.sensor = sensor
        self.frame = frame
        self.offset = offset
        self.path = path
        self.expected = expected
        self.got = got
        self.data = data
        subject = " ".join(name for name in (sensor, frame) if name)
        super().__init__(": ".join(part for part in (subject, reason) if part))


class UsageError(LidarSpecError):
    """The caller has made a mistake, such as an invalid argument."""


class LibraryError(UsageError):
    """An optional library is missing, too old, or fails when it is imported.

    Attributes:
        distribution: name of the library on the package index.
        extra: the extra of lidarspec that installs it.
        least_version: the oldest version that can be used; "" if any version can be used.
        installed_version: the installed version; "" if the library is missing.

    Args:
        cause: why the import failed; "" if it did not.
    """

    def __init__(
        self,
        distribution: str,
        extra: str,
        *,
        least_version: str = "",
        installed_version: str = "",
        cause: str = "",
    ) -> None:
        self.distribution = distribution
        self.extra = extra
        self.least_version = least_version
        self.installed_version = installed_version
        if least_version:
            needed = f"{distribution} {least_version} or later"
        else:
            needed = distribution
        if installed_version:
            found = f"but version {installed_version} is installed"
        else:
            found = "but it is not installed"
        super().__init__(f"{needed} is required, {found}" + (f" ({cause})" if cause else ""))
        suggest(self, f"pip install 'lidarspec[{extra}]'")


#: Maximum number of suggested names that contain the typed name.
MAX_SUGGESTED_NAMES = 6


def did_you_mean(
    name: str,
    known: Iterable[str],
    *,
    min_similarity: float = 0.5,
    aliases: Mapping[str, str] = MappingProxyType({}),
    max_containing: int = MAX_SUGGESTED_NAMES,
) -> str:
    """Return a clause such as ``; did you mean 'speed'?``; "" if no name is similar.

    Args:
        name: the unknown name.
        known: the valid names.
        min_similarity: minimum similarity of a suggested name to the unknown name, from 0 to 1.
        aliases: alias -> the name to suggest instead of it.
        max_containing: the maximum number of suggested names that contain `name`.
    """
    import difflib  # imported here because suggestions are rare

    by_lower_case = {other.lower(): aliases.get(other, other) for other in (*known, *aliases)}
    containing = dict[str, None]()  # an ordered set, because several aliases may mean one name
    if len(name) > 1:
        containing = dict.fromkeys(
            meant for other, meant in by_lower_case.items() if name.lower() in other
        )
    if 0 < len(containing) <= max_containing:
        suggested = list(containing)
    else:
        close = difflib.get_close_matches(name.lower(), by_lower_case, n=1, cutoff=min_similarity)
        suggested = [by_lower_case[other] for other in close]
    if suggested:
        return f"; did you mean {format_names(suggested)}?"
    return ""


def format_names(names: Sequence[str]) -> str:
    """Return names as a text such as "'a', 'b' or 'c'"."""
    *others, last = map(repr, names)
    if others:
        return f"{', '.join(others)} or {last}"
    return last


_NEXT = "next: "
_Failure = TypeVar("_Failure", bound=BaseException)


def suggest(error: _Failure, command: str) -> _Failure:
    """Add a note to an error with the command to type next, unless it has such a note."""
    if not suggestion(error):
        error.add_note(_NEXT + command)
    return error


def suggestion(error: BaseException) -> str:
    """Return the command that an error suggests to type next; "" if there is none."""
    notes: Sequence[str] = getattr(error, "__notes__", ())
    return next((note.removeprefix(_NEXT) for note in notes if note.startswith(_NEXT)), "")


def refuse_text(data: object) -> None:
    """Raise UsageError if the argument is a text or a path instead of bytes."""
    if isinstance(data, str | os.PathLike):
        raise UsageError(
            f"expected bytes, got {type(data).__name__}: use bytes.fromhex(...) for"
            " hexadecimal text, lidarspec.open(...) for a file"
        )


class UnknownName(UsageError):
    """An unknown name; the message suggests similar names, or lists all names.

    Args:
        name: the unknown name.
        known: the valid names.
        place: the subject of the message, such as the id of the sensor; "" for none.
        hint: the end of the message, which begins with its separator, such as "; ...".
        aliases: alias -> the name to suggest instead of it.

    Attributes:
        what: the kind of name, for the message.
        min_similarity: minimum similarity of suggested names, from 0 to 1.
        max_containing: maximum number of suggested names that contain the unknown name.
        max_listed: maximum number of names that are listed if no name is suggested.
    """

    what = "name"
    min_similarity = 0.5
    max_containing = MAX_SUGGESTED_NAMES
    max_listed: float = 12

    def __init__(
        self,
        name: str,
        known: Iterable[str] = (),
        *,
        place: str = "",
        hint: str = "",
        aliases: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self.name = name
        self.known = tuple(sorted(known))
        self.place = place
        similar = did_you_mean(
            name,
            self.known,
            min_similarity=self.min_similarity,
            aliases=aliases,
            max_containing=self.max_containing,
        )
        is_listed = 0 < len(self.known) <= self.max_listed and not similar
        if is_listed:
            names = f" (known: {', '.join(self.known)})"
        else:
            names = ""
        where = f"{place}: " if place else ""
        super().__init__(f"{where}unknown {self.what} {name!r}{similar}{names}{hint}")


class UnknownSensor(UnknownName):
    """No installed sensor has this id or alias.

    Attributes:
        distribution: the distribution that has the sensor, but is not installed or failed to load;
            "" if unknown.
        failure: the reason why the distribution failed to load; "" if it is not installed.
    """

    what = "sensor"
    max_containing = 30  # a vendor's name suggests all of its sensors

    def __init__(
        self,
        name: str,
        known: Iterable[str] = (),
        *,
        place: str = "",
        hint: str = "",
        aliases: Mapping[str, str] = MappingProxyType({}),
        distribution: str = "",
        failure: str = "",
    ) -> None:
        self.distribution = distribution
        self.failure = failure
        if failure:
            hint = f": the distribution {distribution} provides it, but failed to load: {failure}"
        elif distribution:
            hint = f": the distribution {distribution} provides it, but is not installed"
        super().__init__(name, known, place=place, hint=hint, aliases=aliases)


class UnknownFrame(UnknownName, KeyError):
    """The sensor has no frame type with this name."""

    what = "frame"
    min_similarity = 0.7
    max_listed = math.inf
    __str__ = Exception.__str__  # KeyError shows the repr of the message


class UnknownField(UnknownName, AttributeError):  # type: ignore[misc]  # AttributeError.name is the same thing
    """The frame has no field with this path."""

    what = "field"


class UnknownCommand(UnknownName):
    """The sensor has no command with this name."""

    what = "command"
    min_similarity = 0.8  # a wrong guess can stop a motor
    max_listed = math.inf


class UnknownOption(UnknownName):
    """The sensor has no option with this name."""

    what = "option"


class UnknownFormat(UnknownName):
    """There is no file format with this suffix."""

    what = "format"
    min_similarity = 0.6  # suffixes are short, so half of their letters are often equal by chance


class MissingField(UsageError):
    """A value is missing that the caller must supply to build a frame."""

    def __init__(self, path: str, *, place: str = "") -> None:
        self.path = path
        super().__init__(f"{place + ': ' if place else ''}field {path!r} is missing")


class OutOfRange(UsageError):
    """A value outside the range of its field or of a command's argument."""

    def __init__(
        self,
        path: str,
        value: object,
        low: object,
        high: object,
        *,
        unit: str = "",
        place: str = "",
    ) -> None:
        self.path = path
        self.value = value
        self.low = low
        self.high = high
        end = f" {unit}" if unit else ""
        super().__init__(
            f"{place + ': ' if place else ''}{path} = {value} is outside {low} .. {high}{end}"
        )


class SourceError(LidarSpecError):
    """A port, socket or file cannot be opened, read or written."""


class SourceTimeout(SourceError, TimeoutError):
    """A source sent or accepted no data before a timeout."""


class WriteError(SourceError):
    """A recording could not be written, and has ended.

    Attributes:
        reason: the reason, without the path.
    """

    def __init__(self, path: str, reason: str, state: str) -> None:
        self.reason = reason
        super().__init__(f"{path}: {reason}; {state}")


class CommandError(LidarSpecError):
    """The device rejected a command, or sent a reply that does not match."""


class ReplyTimeout(CommandError, TimeoutError):
    """The device did not reply to a command before the timeout."""


@contextmanager
def system_errors(place: object) -> Iterator[None]:
    """Convert an OSError in the body of a with statement to a `SourceError`.

    Args:
        place: the place that the error names, such as a path.

    Raises:
        SourceError: for an OSError, and for an invalid path.
    """
    if "\0" in str(place):
        raise SourceError(f"{str(place)!r}: a path must not contain a zero byte")
    try:
        yield
    except LidarSpecError:  # such as a SourceTimeout, which is also an OSError
        raise
    except OSError as error:
        raise SourceError(f"{place}: {failure_reason(place, error)}") from None


def failure_reason(place: object, error: OSError) -> str:
    """Return the reason for an OSError at a path, such as a missing folder."""
    folder = os.path.dirname(str(place))
    if isinstance(error, FileNotFoundError) and folder and not os.path.isdir(folder):
        return f"folder {folder} does not exist"
    return error.strerror or str(error)
