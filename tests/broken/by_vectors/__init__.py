"""Mistakes that only the manual's own frames in vectors.json reveal."""
