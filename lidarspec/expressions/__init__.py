"""What a plugin's functions are given: the fields of a batch of packets as columns that line up by
themselves.

In: tables of frames (`frames.frame_table`). Out: what `points`, `plausible` and clock functions
make of their columns, or the graph of what
they do. Modules in reading order:

* `columns`: `Batch`, `Fields` and `Column`: the plain evaluation, ordinary NumPy on arrays with
  named axes.
* `graph`: a function traced once; one way to go through what it does, and one to evaluate it.
"""
