"""Devices: sensors that were opened with `lidarspec.open`.

A device reads a SOURCE. It returns packets, scans, replies to commands, counters and warnings.
Modules in reading order:

* `device`: `Device`, the public class.
* `packet_reader`: makes packets of one frame type, and scans, from arriving frames.
* `device_input`: the interface of an input, and the input of a file.
* `first_frames`: finds frames of a file that are needed to decode its first packets.
* `file_scans`: reads the scans of a file, also from the middle and in another process.
* `sender_filter`: selects the datagrams of one sender.
* `live_input`: the input of a live source, decoded every few milliseconds.
* `link_state`: warns of silence, bytes without frames or a lost device, and suggests a command to
  run.
* `capture_thread`: the thread that reads, records and queues.
* `session`: commands and their replies, without I/O.
* `async_device`: `Device` for asyncio.
* `named_devices`: devices by name, from `lidarspec.toml`.
* `source_recording`: records a source to a file.
* `demo`: runs a session with a simulated sensor.
"""
