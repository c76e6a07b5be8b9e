"""A sensor that is not there, made from its spec. In: the facts of a sensor, a scene, commands. Out: the bytes that it would send, in time.

`scenes` says what a beam meets, `frame_maker` fills frames with values, `measuring` writes ranges into them, and `simulator` gives the
packets and when they are sent. `device` is all of that as something to talk to: `replies` answers commands, and `faults` does what goes
wrong on the way. No I/O, no clock, no thread.
"""
