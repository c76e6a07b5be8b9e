"""A sensor that is not there, made from its spec.

In: a sensor, a scene, commands. Out: the bytes that it would send, and when. No port, clock or thread in here. Modules in reading order:

* `scenes`: what a beam meets, and how far away.
* `frame_maker`: frames out of physical values; examples.
* `measuring`: ranges measured in a scene, written into the fields that they come from.
* `simulator`: `simulate`: packets after packets, and when each is sent.
* `replies`: what the sensor makes of the bytes that it is sent, and what it answers.
* `device`: all of that as something to talk to.
* `faults`: what goes wrong on the way to the reader.
"""
