"""Evaluate or trace the `points`, `plausible` and clock functions of a sensor.

Such a function is called with the fields of a batch of packets. Each field is a column, which is
read from a table of frames (`frames.frame_table`). Modules in reading order:

* `columns`: `Batch`, `Fields` and `Column`. With them, a function is evaluated by NumPy, on arrays
  with named axes.
* `graph`: records the steps of a function by calling it once, and evaluates them.
"""
