"""Columns: the fields of a batch of packets, aligned by the arrays that contain them.

In: tables of frames (`frames.frame_table`). Out: the results of `points`, `plausible` and clock
functions for their columns, or the graph of their steps. Modules in reading order:

* `columns`: `Batch`, `Fields` and `Column`: the reference evaluator, ordinary NumPy on arrays with
  named axes.
* `graph`: record the steps of a function by calling it once; iterate over them, evaluate them.
"""
