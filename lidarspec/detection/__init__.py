"""Whose bytes are these, and why are there none: sensors tried, unknown formats described, sources examined."""
