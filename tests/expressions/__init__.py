"""Tests of traced expressions."""
