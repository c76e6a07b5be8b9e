"""Tests of a sensor on a source."""
