"""Columns: the fields of a batch of packets, aligned by the arrays that they are in.

In: tables of frames (`frames.frame_table`). Out: the results of `points`, `plausible` and clock
functions for their columns, or the graph of their steps. Modules in reading order:

* `columns`: `Batch`, `Fields` and `Column`: the plain evaluation, ordinary NumPy on arrays with
  named axes.
* `graph`: the steps of a traced function as a graph, and its evaluation.
"""
