"""Captures of other tools: what stands in pcap and pcapng files.

In: a capture, as a file or a pipe. Out: UDP datagrams with times and addresses, one by one or by
the hundred; of a captured byte stream,
its pieces. Whatever gives no datagram is counted, and no bytes raise past the first four. Modules
in reading order:

* `source`: the bytes of a file or pipe, in buffers that are lent out.
* `records`: the two file formats: their records, one by one and many alike.
* `ip`: from a captured frame to the payload of a datagram: link layers, IP, fragments.
* `pcap`: both joined: a reader that gives datagrams, and a writer.
* `containers`: what a file is by its first bytes: compressed, and read as what is in it; or of a
  kind that is refused by its name.
* `bulk`: the datagrams of a capture as arrays, where they stand in a buffer.
"""
