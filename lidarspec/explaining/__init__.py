"""Explain frames: the meaning of every byte, faults, and differences.

`explain` returns the `Explanation` of a valid or damaged frame, which can be printed as lines. A
stream is first split into frames. `file_contents` describes the contents of a file. Modules in
reading order:

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
