"""One module for each way in which a plugin can be broken; see `tests/plugins/test_plugins.py`."""
