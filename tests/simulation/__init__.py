"""Tests of simulated sensors."""
