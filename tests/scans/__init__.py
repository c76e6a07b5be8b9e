"""Tests of cutting points into scans."""
