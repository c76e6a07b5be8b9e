"""Simulate sensors from their specs.

In: a sensor, a scene, and commands. Out: the bytes that the sensor would send, and their times.
This package uses no port, clock or thread. Modules in reading order:

* `scenes`: returns the range that a beam measures in a scene.
* `frame_maker`: makes frames from physical values.
* `raw_values`: writes raw values into frames.
* `clock_faults`: drift, steps, lost lock and restarts of a clock.
* `clock_writer`: writes the readings and the status of a clock into frames.
* `simulator`: `simulate` measures ranges in a scene and makes packets with these ranges.
* `fragmenter`: splits messages into datagrams.
* `device`: a simulated device, which sends packets and replies to commands.
* `faults`: corrupts, drops and reorders the data of a simulated device.
"""
