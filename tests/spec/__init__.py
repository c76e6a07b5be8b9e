"""Tests of the description of a sensor."""
