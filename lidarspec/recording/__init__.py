"""Recordings: everything that came over a link, with its time.

In: chunks as they arrive. Out: a file that survives a crash; and of a file, its records. Modules in
reading order:

* `format`: the bytes of an .lsr file, packed and found again; a recording read, up to its damage or
  past it.
* `recorders`: `Recorder` and others, by the suffix of the file: everything, packets for Wireshark,
  the bytes alone.
* `switch`: a recorder that is switched on and off while a source is read.
* `appending`: the thread that writes whole records, so that a slow disk holds nothing up.
"""
