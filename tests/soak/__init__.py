"""Every promise measured, and the table of today's figures: `make soak`.

`figures` measures what has a figure; `promises` says of each promise what is promised, which tests
hold it and what is measured; `python -m tests.soak` runs both and writes the table into
docs/explanation/reliability.md.
"""
