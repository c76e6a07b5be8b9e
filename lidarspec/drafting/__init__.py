"""Draft the spec of an unknown format: frames, fields and checksum.

The modules analyse the bytes of one sensor. They return checksums that match, and the source of a
new plugin. Modules in reading order:

* `samples`: sample frames, and the possible offsets and covered bytes of a checksum.
* `checksum_search`: finds the checksum of the frames by trying all simple checksums.
* `crc_search`: finds a CRC by polynomial division, without trying every polynomial.
* `periods`: finds frames, their lengths, and fields that rise from frame to frame.
* `draft`: analyses unknown frames, and returns a `Draft`.
* `draft_code`: writes the source of a sensor from a `Draft`.
* `distribution`: makes the files of a Python distribution with the new sensor.
"""
