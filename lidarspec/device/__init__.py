"""Devices: a sensor on a source, as `open` returns it.

In: a SOURCE and a sensor. Out: packets and scans as they arrive, replies to commands,
counters, warnings. Modules in reading order:

* `device`: `Device`, the public class.
* `packet_reader`: makes packets of one type, and scans, from arriving frames.
* `device_input`: the interface of an input, and the input of a file.
* `first_frames`: frames of a file that apply from its start: its first state, and the first
  reference of its clock.
* `file_scans`: the scans of a file, resumable in other processes.
* `sender_filter`: selects the sender of datagrams that is read.
* `live_input`: frames as they arrive, decoded every few milliseconds.
* `link_state`: data, silence, bytes without frames, or a lost device; and what to do next.
* `capture_thread`: the thread that reads, records and queues.
* `session`: commands and their replies, sans-IO.
* `async_device`: `Device` for asyncio.
* `settings`: devices by name, from `lidarspec.toml`.
* `source_recording`: records a source to a file.
* `demo`: a session with a simulated sensor.
"""
