"""Plugins with one mistake each, and a sound one; `tests/testing/test_broken.py` says which rule
names which.
"""
