"""Identify the sensor of a source, and diagnose a source without usable data.

In: a SOURCE, or bytes. Out: a verdict, and findings with the command that fixes them. Modules
in reading order:

* `sample_bytes`: the examined bytes of one sender.
* `listen`: reads sample bytes from any source.
* `identification`: identifies the installed sensor that sent some bytes.
* `uninstalled_sensors`: recognizes bytes of sensors that are not installed.
* `doctor`: diagnoses a source without bytes or without valid frames.
"""
