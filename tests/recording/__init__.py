"""Recordings, written, read and replayed."""
