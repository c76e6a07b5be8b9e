"""Frames for people: what every byte says, what is wrong with it, what differs from another frame.

In: the bytes of a frame, whole or damaged, and a sensor. Out: an `Explanation`, and its lines. Modules in reading order:

* `explanation`: `explain`: from bytes to rows, verdict and points; the flipped bit that explains a damage.
* `wording`: the words for values, bits, rows, points and differences.
* `listing`: rows and differences as lines, with roles for colours.
"""
