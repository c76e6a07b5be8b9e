"""A sensor on a source: what `open` gives.

In: a SOURCE and a sensor. Out: packets and scans as they come, replies to commands, counters,
warnings. Modules in reading order:

* `device`: `Device`, the public class.
* `packet_reader`: packets of one type, and scans, out of the frames that arrive.
* `arrivals`: what an input is, live or not, and that of a file.
* `first_frames`: frames of a file that apply from its start: its first state, and the first
  reference of its clock.
* `file_scans`: the scans of a file, in pieces that other processes read.
* `senders`: the senders of datagrams, and which of them are read.
* `live_input`: frames as they arrive, decoded every few milliseconds.
* `link_state`: data, silence, bytes without frames, or a lost device; and what to do next.
* `capture_thread`: the thread behind it, which reads, records and queues.
* `session`: commands and their replies, sans-IO.
* `async_device`: `Device` for asyncio.
* `settings`: devices by name, from `lidarspec.toml`.
* `source_recording`: a source into a file, decoded no further than to be counted.
* `demo`: all of it against a simulated sensor.
"""
