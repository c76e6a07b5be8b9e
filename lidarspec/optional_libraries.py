"""Import optional libraries, and check that their versions are new enough.

An extra is a set of libraries that `pip install lidarspec[EXTRA]` installs. `EXTRAS` has the
libraries of each extra with their oldest usable versions.
"""

from __future__ import annotations

import functools
import importlib
import re
from typing import Any, NamedTuple

from lidarspec.errors import LibraryError


class Requirement(NamedTuple):
    """A distribution, and the oldest version of it that lidarspec works with."""

    distribution: str
    least_version: str


#: Extra -> module -> requirement. pyproject.toml declares the same requirements, and a test
#: compares both.
EXTRAS: dict[str, dict[str, Requirement]] = {
    "arrow": {"pyarrow": Requirement("pyarrow", "14.0")},
    "dask": {"dask": Requirement("dask", "2024.8")},
    "e57": {"pye57": Requirement("pye57", "0.4.5")},
    "foxglove": {
        "foxglove_schemas_protobuf": Requirement("foxglove-schemas-protobuf", "0.3"),
        "mcap": Requirement("mcap", "1.1"),
        "mcap_protobuf": Requirement("mcap-protobuf-support", "0.5"),
    },
    "fsspec": {"fsspec": Requirement("fsspec", "2023.9")},
    "jit": {"numba": Requirement("numba", "0.61")},
    "las": {
        "laspy": Requirement("laspy", "2.5"),
        "lazrs": Requirement("lazrs", "0.5"),
    },
    "pandas": {"pandas": Requirement("pandas", "2.1")},
    "pcd": {"lzf": Requirement("python-neo-lzf", "0.3")},
    "plot": {"matplotlib": Requirement("matplotlib", "3.9")},
    "polars": {"polars": Requirement("polars", "1.0")},
    "rerun": {"rerun": Requirement("rerun-sdk", "0.41")},
    "ros": {
        "mcap": Requirement("mcap", "1.0"),
        "rosbags": Requirement("rosbags", "0.11"),
    },
    "testing": {
        "hypothesis": Requirement("hypothesis", "6.100"),
        "pytest": Requirement("pytest", "8.0"),
    },
    "zarr": {"zarr": Requirement("zarr", "3.0.8")},
    "zstd": {"backports.zstd": Requirement("backports.zstd", "1.0")},
}


def import_library(module: str, extra: str) -> Any:
    """Import and return a module of an optional library.

    Args:
        module: the full name, such as "rosbags.typesys".
        extra: the extra that installs the library, a key of `EXTRAS`.

    Raises:
        LibraryError: if the library is missing, too old or cannot be imported.
    """
    requirement = find_requirement(module, extra)
    if requirement is not None:
        check_version(requirement, extra)
    try:
        return importlib.import_module(module)
    except ImportError as error:
        if requirement:
            distribution = requirement.distribution
        else:
            distribution = module.partition(".")[0]
        installed = installed_version(distribution)
        raise LibraryError(
            distribution,
            extra,
            least_version=requirement.least_version if requirement else "",
            installed_version=installed,
            cause=str(error) if installed else "",
        ) from error


def find_requirement(module: str, extra: str) -> Requirement | None:
    """Return the requirement of a module's library; None if `EXTRAS` does not have it."""
    for name, requirement in EXTRAS[extra].items():
        if module == name or module.startswith(f"{name}."):
            return requirement
    return None


@functools.cache  # reading the version takes most of a millisecond
def check_version(requirement: Requirement, extra: str) -> None:
    """Raise an exception if the installed version of a library is too old.

    Raises:
        LibraryError: if the version is too old; the message has both versions.
    """
    installed = installed_version(requirement.distribution)
    if installed and release_numbers(installed) < release_numbers(requirement.least_version):
        raise LibraryError(
            requirement.distribution,
            extra,
            least_version=requirement.least_version,
            installed_version=installed,
        )


def installed_version(distribution: str) -> str:
    """Return the installed version of a distribution; "" if it is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(distribution) or ""
    except PackageNotFoundError:
        return ""


def release_numbers(version: str) -> tuple[int, ...]:
    """Return the numbers of a release, without zeros at the end: (3, 0, 8) of "3.0.8rc1"."""
    release = re.match(r"\d+(\.\d+)*", version)
    if release is None:
        return ()
    numbers = [int(part) for part in release[0].split(".")]
    while numbers and numbers[-1] == 0:
        numbers.pop()
    return tuple(numbers)
