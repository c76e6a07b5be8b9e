"""Devices: a sensor on a source, as returned by `open`.

In: a SOURCE and a sensor. Out: packets and scans as they arrive, replies to commands,
counters, warnings. Modules in reading order:

* `device`: `Device`, the public class.
* `packet_reader`: makes packets of one type, and scans, from arriving frames.
* `device_input`: the interface of an input, and the input of a file.
* `first_frames`: frames of a file that apply from its start: the first frame of each state type,
  and the first reference of the clock.
* `file_scans`: the scans of a file, resumable in other processes.
* `sender_filter`: selects the datagrams of one sender.
* `live_input`: the input of a live source, decoded every few milliseconds.
* `link_state`: reports silence, bytes without frames, or a lost device, with the next command.
* `capture_thread`: the thread that reads, records and queues.
* `session`: commands and their replies, sans-IO.
* `async_device`: `Device` for asyncio.
* `named_devices`: devices by name, from `lidarspec.toml`.
* `source_recording`: records a source to a file.
* `demo`: a session with a simulated sensor.
"""
