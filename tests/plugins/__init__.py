"""Tests of plugins: entry points, hooks and distributions."""
