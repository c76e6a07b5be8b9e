"""Frames for people: what every byte says, what is wrong with it, what differs from another frame.

In: the bytes of a frame, whole or damaged, or of a stream, and a sensor. Out: an `Explanation` of
each frame, and its lines; of a file what is in it.
Modules in reading order:

* `explanation`: `explain`: from bytes to rows, verdict and points.
* `frame_rows`: one frame as rows of values.
* `damage`: the flipped bit, the lost or inserted byte that explains a damage.
* `pieces`: a stream in pieces: frames, and what was one before it was damaged.
* `wording`: the words for values, bits, rows, points and differences.
* `contents`: what is in a file.
* `assignments`: the other way round, from what people write to values.
* `listing`: rows and differences as lines, with roles for colours.
"""
