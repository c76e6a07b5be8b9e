"""Frames of one type, in order, in time."""
