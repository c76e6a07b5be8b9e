"""Frames for people: what every byte says, what is wrong with it, what differs.

wording          the words for values, rows, points and differences
listing          rows and differences as lines, with roles for colours
explanation      one frame from bytes to its rows, verdict and points: `explain`
"""
