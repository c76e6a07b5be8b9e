"""Specs drafted from bytes that nobody has described: what a capture tells, and the text made of it."""
