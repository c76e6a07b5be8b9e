"""Captures of other tools: the contents of pcap and pcapng files.

In: a capture, as a file or a pipe. Out: UDP datagrams with times and addresses, one by one or
in batches; for a captured byte stream, its pieces. Packets without a datagram are counted. No
content after the first four bytes raises an exception. Modules in reading order:

* `source`: the bytes of a file or pipe, in buffers that callers share.
* `records`: the records of the two file formats, one by one and in patterns.
* `ip`: the payload of a captured frame: link layers, IP, fragments.
* `pcap`: combines both: a reader of datagrams, and a writer.
* `containers`: the kind of a file by its first bytes; decompresses files and refuses unsupported
  kinds.
* `bulk`: the datagrams of a capture as arrays of offsets.
"""
