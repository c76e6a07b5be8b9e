"""Inputs and outputs: ports, sockets, files and simulated sensors.

In: a SOURCE as text. Out: an open `Transport`, which yields `Chunk`s and sends bytes.
Modules in reading order:

* `protocol`: the base classes of transports; plugins derive from them.
* `open_url`: opens the transport of a SOURCE.
* `addresses`: parses live SOURCEs and resolves hosts.
* `host_clock`: the clock of this computer for arrival times.
* `base`: functions that live transports share: reading a stream, waiting, system errors.
* `serial`, `udp`, `tcp`: live sources.
* `http`: requests to the web server of a sensor.
* `simulated`: a simulated sensor in this process (`sim:`).
* `robotics_logs`: reads packets from ROS bags and MCAP files.
* `hex_text`: reads bytes from hexadecimal text.
* `files`: recordings, captures, raw bytes, standard input.
* `ports`: the serial and UDP ports of this computer, and the programs that use them.
* `usb_adapters`: USB serial adapters without a driver.

These modules send data like a sensor:

* `outlets`: sends bytes and receives commands over pseudo-terminals, UDP and TCP.
* `http_server`: receives requests and sends replies over HTTP.
* `destinations`: makes the outlet of a destination.
* `serving`: runs a simulated sensor at an outlet, in real time.
* `simulated_files`: writes the bytes of a simulated sensor to a file.
* `replays`: sends a recording at its recorded times.
"""
