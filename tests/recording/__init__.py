"""Tests of recordings: written, read and replayed."""
