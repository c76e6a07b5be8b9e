"""Write and read recordings: all data of a source, with arrival times.

A recorder writes chunks as they arrive to a file that stays valid after a crash. A reader returns
the records of such a file. Modules in reading order:

* `format`: reads and writes the bytes of .lsr files; damaged files can be read as well.
* `recorders`: a recorder for each suffix: .lsr for all data, .pcap and .pcapng for Wireshark, .bin
  for raw bytes.
* `recorder_switch`: a recorder that can be switched on and off while a source is read.
* `background_writer`: writes complete records in a thread, so that a slow disk does not delay
  reading.
"""
