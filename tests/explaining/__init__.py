"""Tests of explanations of bytes."""
