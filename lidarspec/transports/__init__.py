"""Where bytes come from, and go to.

In: a SOURCE as text. Out: an open `Transport`, which gives `Chunk`s and takes bytes to send.
Modules in reading order:

* `protocol`: what a transport is, live or not; plugins derive from it.
* `open_url`: from a SOURCE to the transport that opens it.
* `addresses`, `host_clock`: a live SOURCE as a value; the times of arrivals.
* `base`: what live transports share: reading a stream, waiting, errors of the system.
* `serial`, `udp`, `tcp`: live sources.
* `http`: requests to the web server of a sensor.
* `simulated`: `sim:`, a simulated sensor in this process.
* `bags`: robotics logs, which hold packets as ROS's messages.
* `hexadecimal`: bytes as people print them.
* `files`: recordings, captures, raw bytes, standard input.
* `ports`: which serial and UDP ports this computer has, and who holds them.

In the opposite direction, in the place of a sensor:

* `outlets`: pseudo-terminals, UDP and TCP in one loop.
* `http_line`: HTTP in the same loop.
* `destinations`: from a destination as text to its outlet.
* `serving`: a simulated sensor at an outlet, in real time.
* `simulated_files`: a simulated sensor written to a file.
* `replays`: a recording that is sent again at its recorded times.
"""
