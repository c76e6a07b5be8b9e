"""Broken plugins with one mistake in each module; see `tests/plugins/test_plugins.py`."""
