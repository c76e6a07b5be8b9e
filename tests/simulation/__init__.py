"""Sensors that are not there."""
