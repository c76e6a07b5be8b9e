"""Recordings: all data of a link, with arrival times.

In: chunks as they arrive. Out: a file that stays valid after a crash, and the records of a
file. Modules in reading order:

* `format`: reads and writes the bytes of .lsr files, also of damaged ones.
* `recorders`: `Recorder` and others, by the suffix of the file: all data, packets for Wireshark,
  raw bytes.
* `recorder_switch`: a recorder that is switched on and off while a source is read.
* `background_writer`: the thread that writes whole records, so that a slow disk delays nothing.
"""
