"""Identify the sensor of a source, and diagnose a source without usable data.

In: a SOURCE, or bytes. Out: a verdict, and findings with the command that fixes them. Modules
in reading order:

* `sample_bytes`: the bytes of one source.
* `listen`: read some bytes from any source.
* `identification`: which installed sensor sent them.
* `uninstalled_sensors`: sensors that are not installed and may have sent them.
* `doctor`: why no bytes, or no valid frames, arrive.
"""
