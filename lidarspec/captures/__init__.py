"""Read and write captures: pcap and pcapng files.

A capture is read from a file or a pipe. The readers return UDP datagrams with times and addresses,
or the chunks of a captured byte stream. Modules in reading order:

* `source`: a buffered reader of a file or pipe; callers can use its buffers without a copy.
* `records`: reads and writes the records of both file formats, and describes the layout by which
  `bulk` recognizes similar records.
* `ip`: the payload of a captured frame: link layers, IP, fragments.
* `pcap`: reads the datagrams of a capture with `records` and `ip`, and makes records to write.
* `containers`: detects the kind of a file by its first bytes, decompresses files, and refuses
  unsupported kinds.
* `bulk`: reads the datagrams of a capture in batches, as arrays of offsets.
"""
