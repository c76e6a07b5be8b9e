"""Evaluate or trace the `points`, `plausible` and clock functions of a sensor.

Modules in reading order:

* `columns`: `Batch`, `Fields` and `Column`. With them, a function is evaluated by NumPy, on arrays
  with named axes.
* `graph`: records the steps of a function by calling it once, and evaluates them.
"""
