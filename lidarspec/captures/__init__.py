"""Captures of other tools. In: a pcap or pcapng file or pipe. Out: UDP datagrams, or frames of a byte stream, with times and addresses.

`records` knows the two file formats, `ip` what is in a captured frame; `pcap` joins the two and writes captures, and `bulk` gives
datagrams by the hundred, as arrays.
"""
