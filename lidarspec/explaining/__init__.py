"""Frames explained byte by byte, for people: rows and words, bits, flipped bits, differences."""
