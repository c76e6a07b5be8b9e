"""Plugins with one mistake each, and a correct one.

`tests/testing/test_broken.py` lists the rule that reports each mistake.
"""
