"""Inputs and outputs: ports, sockets, files and simulated sensors.

`open_transport` takes a SOURCE as text, and returns an open `Transport`, which yields `Chunk`s and
sends bytes. Modules in reading order:

* `protocol`: the base classes of transports; plugins derive from them.
* `open_url`: opens the transport of a SOURCE.
* `addresses`: parses live SOURCEs and resolves hosts.
* `host_clock`: the clock of this computer for arrival times.
* `base`: functions that live transports share: reading a stream, waiting, system errors.
* `serial`, `udp`, `tcp`: live sources.
* `http`: sends requests to the web server of a sensor.
* `simulated`: a simulated sensor in this process (`sim:`).
* `robotics_logs`: reads packets from ROS bags and MCAP files.
* `hex_text`: reads bytes from hexadecimal text.
* `files`: reads recordings, captures, raw bytes and standard input.
* `ports`: lists the serial and UDP ports of this computer, and the programs that use them.
* `usb_adapters`: finds USB serial adapters without a driver.

The following modules send data as a sensor does:

* `outlets`: sends bytes and receives commands over pseudo-terminals, UDP and TCP.
* `http_server`: receives requests and sends replies over HTTP.
* `destinations`: makes the outlet of a destination.
* `serving`: runs a simulated sensor at an outlet, in real time.
* `simulated_files`: writes the bytes of a simulated sensor to a file.
* `replays`: sends a recording at its recorded times.
"""
