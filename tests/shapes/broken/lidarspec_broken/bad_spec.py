"""Declares a frame that loses bits; the declaration raises."""

from construct import Flag, Int8ul, Padding, Struct

from lidarspec.spec import Frame

FRAME = Frame(Struct("kind" / Int8ul, "is_on" / Flag, Padding(2)), max_length=4)
