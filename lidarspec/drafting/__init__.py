"""Describe an unknown format: its frames, its fields and its checksum, as the draft of a spec.

In: bytes of one sensor. Out: checksums that fit, and the source of a new plugin. Modules in reading
order:

* `samples`: frames of an unknown format, and the places where a checksum could stand and what it
  could cover.
* `checksum_search`: find the checksum that seals them, simple ones by trial.
* `crc_search`: find a CRC without trying every polynomial.
* `periods`: frames, lengths, and fields that change steadily.
* `draft`: write the distribution of a new sensor.
"""
