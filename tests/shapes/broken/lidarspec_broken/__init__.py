"""Broken plugins, one mistake a module; see `tests/plugins/test_plugins.py`."""
