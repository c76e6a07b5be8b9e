"""Plugins with one mistake each, and a sound one; `tests/test_broken.py` says which rule names which."""
