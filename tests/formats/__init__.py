"""Tests of files of points."""
