"""Bytes in words."""
