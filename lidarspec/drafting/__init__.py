"""Draft the spec of an unknown format: frames, fields and checksum.

In: bytes of one sensor. Out: checksums that match, and the source of a new plugin. Modules in
reading order:

* `samples`: frames of an unknown format, and possible places and spans of a checksum.
* `checksum_search`: find the checksum of the frames, simple ones by trial.
* `crc_search`: find a CRC without trying every polynomial.
* `periods`: frames, lengths, and fields that change steadily.
* `draft`: write the distribution of a new sensor.
"""
