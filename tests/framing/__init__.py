"""Tests of finding frames."""
