"""Tests of the engine's promises, on the shapes."""
