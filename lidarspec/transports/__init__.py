"""Where bytes come from, and go to.

In: a SOURCE as text. Out: an open `Transport`, which gives `Chunk`s and takes bytes to send.
Modules in reading order:

* `protocol`: what a transport is, live or not; plugins derive from it.
* `open_url`: from a SOURCE to the transport that opens it.
* `base`: what they share: addresses, the clock, failures with the next command.
* `serial`, `udp`, `tcp`: live sources.
* `http`: the web server of a sensor, and that of a simulated one.
* `simulated`: `sim:`, a sensor that is not there.
* `bags`: robotics logs, which hold packets as ROS's messages.
* `hexadecimal`: bytes as people print them.
* `files`: recordings, captures, raw bytes, standard input.
* `ports`: which serial and UDP ports this computer has, and who holds them.

The other way round, for what stands in the place of a sensor:

* `outlets`: a pseudo-terminal, datagrams, TCP connections, a file.
* `serving`: a simulated sensor, or a recording, sent through an outlet by the clock.
"""
