"""Inputs and outputs: ports, sockets, files and simulated sensors.

In: a SOURCE as text. Out: an open `Transport`, which yields `Chunk`s and sends bytes.
Modules in reading order:

* `protocol`: the base classes of transports; plugins derive from them.
* `open_url`: opens the transport of a SOURCE.
* `addresses`: a live SOURCE as a value.
* `host_clock`: the arrival times.
* `base`: functions of all live transports: reading a stream, waiting, system errors.
* `serial`, `udp`, `tcp`: live sources.
* `http`: requests to the web server of a sensor.
* `simulated`: a simulated sensor in this process (`sim:`).
* `robotics_logs`: robotics logs with packets in ROS messages.
* `hex_text`: bytes as hexadecimal text.
* `files`: recordings, captures, raw bytes, standard input.
* `ports`: the serial and UDP ports of this computer, and the programs that use them.

In the opposite direction, to send like a sensor:

* `outlets`: pseudo-terminals, UDP and TCP in one loop.
* `http_server`: HTTP in the same loop.
* `destinations`: makes the outlet of a destination.
* `serving`: a simulated sensor at an outlet, in real time.
* `simulated_files`: a simulated sensor written to a file.
* `replays`: sends a recording at its recorded times.
"""
