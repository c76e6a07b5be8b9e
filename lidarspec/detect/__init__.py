"""Identify the sensor of a source, and diagnose a source without valid data.

In: a SOURCE, or bytes. Out: the sensors that may have sent the data, and findings with the command
that fixes each. Modules in reading order:

* `sample_bytes`: the bytes of one sender, from which its sensor is identified.
* `listen`: reads sample bytes from any source.
* `identification`: identifies the installed sensor that sent some bytes.
* `unknown_codes`: finds codes that the spec of a sensor does not name.
* `uninstalled_sensors`: recognizes bytes of sensors that are not installed.
* `doctor`: diagnoses a source without bytes or without valid frames.
"""
