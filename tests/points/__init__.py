"""Tests of points, by every way to compute them."""
