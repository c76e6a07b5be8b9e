"""Mistakes that only the manual's own frames show: vectors.json has them."""
