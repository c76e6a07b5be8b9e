"""Bytes of unknown sensors."""
