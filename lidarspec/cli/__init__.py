"""The command line; `main` is its entry point."""

from lidarspec.cli.root import main

__all__ = ["main"]
