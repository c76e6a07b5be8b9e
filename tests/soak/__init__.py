"""Measure every promise, and write the table of the current figures: `make soak`.

`figures` measures each promise that has a figure. `promises` lists each promise with its tests and
measurements. `python -m tests.soak` runs both and writes the table into
docs/explanation/reliability.md.
"""
