"""Packets: frames of one type in order and in time.

In: `Frames` out of a decoder. Out: `Packets`, the frames of one type as columns, with the times,
indices and breaks that follow from the
sensor's clock and counter, and with what frames of other types said last. Modules in reading order:

* `packets`: the columns of n frames, raw and physical.
* `clocks`: the sensor's own time as integer nanoseconds that run on.
* `pace`: how long a packet takes by the clock.
* `continuity`: what was lost, came twice or late, by the counter, the clock and the bytes.
* `clock_order`: the same for datagrams that only their clock numbers.
* `masked_sector`: gaps where a rotating sensor is set to send nothing, which are no loss.
* `reorder`: packets put back in order, doubles left out.
* `imu`: what an IMU felt, beside the points.
* `stream`: what is remembered from batch to batch.
"""
