"""Tests of parsing and building frames."""
