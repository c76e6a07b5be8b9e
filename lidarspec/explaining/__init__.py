"""Explain frames: the meaning of every byte, faults, and differences.

In: a sensor and bytes, which are a valid frame, a damaged frame or a stream; or a file. Out: an
    `Explanation` of each frame, which can be printed as lines; or a description of the file's
    contents. Modules in reading order:
* `explanation`: `explain`, and the class `Explanation` with the rows and the first fault of a
frame.
* `frame_rows`: one frame as rows of values.
* `damage_search`: the flipped bit, or the lost or inserted byte, that explains damage.
* `input_segments`: splits a stream into valid frames, damaged frames, and other bytes.
* `clock_text`: a sensor's clock in words.
* `formatting`: the texts for values, bits, rows, points and differences.
* `file_contents`: the kind of a file, and its senders, sensors, times and losses.
* `assignments`: parses values that users type.
* `listing`: rows and differences as lines of text, for a terminal with colours.
"""
