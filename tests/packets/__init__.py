"""Tests of packets: their order and times."""
