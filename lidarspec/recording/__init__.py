"""Recordings: everything that came over a link, written so that a crash costs nothing, and played again."""
