"""A sensor that is not there, made from its spec.

In: a sensor, a scene, commands. Out: the bytes that it would send, and when. No port, clock or
thread in here. Modules in reading order:

* `scenes`: what a beam meets, and how far away.
* `frame_maker`: frames out of physical values.
* `simulator`: `simulate`: ranges measured in a scene, packets out of them, and when each is sent.
* `device`: all of that as something to talk to, which answers commands.
* `faults`: what goes wrong on the way to the reader.
"""
