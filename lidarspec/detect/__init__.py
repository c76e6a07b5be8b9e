"""Identify the sensor of a source, and diagnose a source without valid data.

The functions take a SOURCE, or bytes. They return the sensors that may have sent the data, or
findings with suggested commands. Modules in reading order:

* `sample_bytes`: the bytes of one sender, from which its sensor is identified.
* `listen`: reads sample bytes from any source.
* `identification`: identifies the installed sensor that sent some bytes.
* `unknown_codes`: finds values of enumerated fields for which the spec has no name.
* `uninstalled_sensors`: recognizes bytes of sensors that are not installed.
* `doctor`: diagnoses a source without bytes or without valid frames.
"""
