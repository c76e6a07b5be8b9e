"""Tests of the detection of sensors."""
