"""What is not known yet. In: a SOURCE, or bytes. Out: which sensor it is, why nothing comes, which checksum it is, the draft of a spec.

`listen` hears a source, `detect` says whose bytes they are, `identify` the same of single frames, `doctor` what is wrong with a port.
Of frames that nobody knows, `periods` finds their structure and `checksum_search` their seal, over `samples` and with `crc_search`;
`draft` writes the distribution of a new sensor from all of that.
"""
