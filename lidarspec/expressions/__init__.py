"""Columns: the fields of a batch of packets, aligned by the arrays that they are in.

In: tables of frames (`frames.frame_table`). Out: the results of `points`, `plausible` and clock
functions for their columns, or the graph of their steps. Modules in reading order:

* `columns`: `Batch`, `Fields` and `Column`: the plain evaluation, ordinary NumPy on arrays with
  named axes.
* `graph`: a function traced once; one way to go through what it does, and one to evaluate it.
"""
