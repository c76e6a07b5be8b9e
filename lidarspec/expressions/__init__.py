"""Evaluate or trace the `points`, `plausible` and clock functions of a sensor.

The functions are called with the fields of a batch of packets as columns, which are read from
tables of frames (`frames.frame_table`). Modules in reading order:

* `columns`: `Batch`, `Fields` and `Column`, which evaluate a function with ordinary NumPy on arrays
  with named axes.
* `graph`: records the steps of a function by calling it once, and evaluates them.
"""
