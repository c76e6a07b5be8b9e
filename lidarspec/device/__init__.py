"""A sensor on a source. In: a SOURCE and a sensor. Out: packets and scans as they come, replies to commands, counters, warnings.

`device` is what users hold, `async_device` the same with waits that are awaited, `settings` the devices that have a name. A device reads
from a `file_input` or a `live_input`, which hand on `arrivals`; behind the latter a `capture_thread` fetches what comes, and a `session`
keeps commands and replies apart. `source_recording` brings a source into a file without decoding more than is counted, and `demo` runs
all of it against a simulated sensor.
"""
