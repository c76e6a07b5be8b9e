"""Simulated sensors, made from their specs.

In: a sensor, a scene, commands. Out: the bytes that the sensor would send, and their times. This
package uses no port, clock or thread. Modules in reading order:

* `scenes`: the range of a beam in a scene.
* `frame_maker`: frames from physical values.
* `simulator`: `simulate`: ranges measured in a scene, packets with them, and their times.
* `device`: a simulated device, which also replies to commands.
* `faults`: faults on the links.
"""
