"""Packets: frames of one type in order and in time.

In: `Frames` out of a decoder. Out: `Packets`, the frames of one type as columns, with the times,
indices and breaks that follow from the sensor's clock and counter, and with the last frames of
other types. Modules in reading order:

* `packets`: the columns of n frames, raw and physical.
* `clocks`: the sensor's own time as integer nanoseconds that run on.
* `pace`: the time that a packet takes by the clock, as declared.
* `counter_order`: lost, duplicate and late packets by their counter.
* `clock_order`: the same by the clock, for datagrams without a counter.
* `arrival_order`: lost packets of streams without a counter, which arrive in order.
* `masked_sector`: sectors in which a rotating sensor sends nothing, which are no loss.
* `reorder`: packets put back in order, duplicates left out.
* `imu`: the samples of an IMU.
* `packet_type`: the clock and the loss detection of one frame type.
* `stream`: from frames to packets, batch by batch.
* `clock_status`: the state of the sensor's clock at each packet.
"""
