"""What is not known yet: which sensor, what is wrong, which checksum, which format.

In: a SOURCE, or bytes. Out: a verdict, findings with the command that mends them, checksums that fit, the draft of a spec. Modules in
reading order:

* `heard`: the bytes of one source.
* `listen`: some bytes out of any source.
* `detect`: which installed sensor sent them, and whose single frames are.
* `uninstalled`: which sensors that are not installed may have sent them.
* `doctor`: why nothing comes, or nothing that can be used.
* `samples`: frames of an unknown format, and where a checksum could stand and what it could cover.
* `checksum_search`: which checksum seals them, plain ones by trial.
* `crc_search`: CRCs, without trial.
* `periods`: what unknown bytes are made of: frames, lengths, fields that change steadily.
* `draft`: the distribution of a new sensor, written from all of that.
"""
