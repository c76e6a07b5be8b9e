"""Tests of drafting a description of an unknown sensor."""
