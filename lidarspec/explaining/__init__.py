"""Explain frames: the meaning of every byte, faults, and differences.

In: a sensor, and the bytes of a valid or damaged frame, or of a stream. Out: an `Explanation` of
each frame, and its lines; or the contents of a file. Modules in reading order:
* `explanation`: `explain`, and the explanation of a frame: rows, verdict, points.
* `frame_rows`: one frame as rows of values.
* `damage_search`: the flipped bit, or the lost or inserted byte, that explains damage.
* `input_segments`: splits a stream into valid frames, damaged frames, and other bytes.
* `formatting`: the texts for values, bits, rows, points and differences.
* `file_contents`: the contents of a file.
* `assignments`: parses values that users type.
* `listing`: rows and differences as lines, with roles for colours.
"""
