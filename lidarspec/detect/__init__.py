"""Identify the sensor of a source, and diagnose a source without usable data.

In: a SOURCE, or bytes. Out: a verdict, and findings with the command that fixes them. Modules
in reading order:

* `sample_bytes`: the bytes of one source.
* `listen`: read some bytes from any source.
* `identification`: identify the installed sensor that sent some bytes.
* `uninstalled_sensors`: recognize bytes of sensors that are not installed.
* `doctor`: diagnose a source without bytes or without valid frames.
"""
