"""Where bytes come from, and go to. In: a SOURCE as text. Out: an open `Transport` that gives `Chunk`s and takes bytes to send.

`protocol` says what a transport is, live or not; `open_url` makes one of a SOURCE: `files` (recordings, captures, raw bytes, standard
input), `serial`, `udp`, `tcp`, and `simulated` for a sensor that is not there. They share `base`: addresses, the clock, failures with the
next command. `ports` lists what this computer has.

The other way round, `outlets` stand in the place of a sensor: a pseudo-terminal, UDP, TCP, a file; `serving` sends a simulated sensor or
a recording through one, by the clock.
"""
