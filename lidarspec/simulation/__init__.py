"""Simulated sensors, sans-IO: scenes, what is measured in them, frames, answers, faults, the pace of it all."""
