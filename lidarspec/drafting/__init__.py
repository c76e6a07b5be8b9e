"""Draft the spec of an unknown format: frames, fields and checksum.

In: bytes of one sensor. Out: checksums that match, and the source of a new plugin. Modules in
reading order:

* `samples`: frames of an unknown format, and possible places and spans of a checksum.
* `checksum_search`: finds the checksum of the frames; tries all simple checksums.
* `crc_search`: finds a CRC without trying every polynomial.
* `periods`: finds frames, lengths, and fields that change steadily.
* `draft`: analyses unknown frames, and returns a `Draft`.
* `draft_code`: writes the source of a sensor from a `Draft`.
* `distribution`: makes the files of a new sensor's distribution.
"""
