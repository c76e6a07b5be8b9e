"""Simulated sensors, made from their specs.

In: a sensor, a scene, commands. Out: the bytes that the sensor would send, and their times. This
package uses no port, clock or thread. Modules in reading order:

* `scenes`: the range of a beam in a scene.
* `frame_maker`: frames from physical values.
* `raw_values`: raw values in the frames of a table.
* `clock_faults`: drift, steps, lost lock and restarts of a clock; `clock_writer`: its readings and
  its status in frames.
* `simulator`: `simulate`: ranges measured in a scene, packets with them, and their times.
* `device`: a simulated device, which also replies to commands.
* `faults`: faults on the links.
"""
