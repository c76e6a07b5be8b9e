"""Simulate sensors from their specs.

The input is a sensor, a scene, and commands. The output is the bytes that the sensor would send,
and their times. This package uses no port, clock or thread. Modules in reading order:

* `scenes`: returns the range that a beam measures in a scene.
* `frame_maker`: makes frames from physical values.
* `raw_values`: writes raw values into frames.
* `clock_faults`: applies drift, jumps, lost lock and restarts to the readings of a clock.
* `clock_writer`: writes the readings and the status of a clock into frames.
* `simulator`: `simulate` measures ranges in a scene and makes packets with these ranges.
* `fragmenter`: splits messages into datagrams.
* `device`: a simulated device, which sends packets and replies to commands.
* `faults`: corrupts, drops and reorders the data of a simulated device.
"""
