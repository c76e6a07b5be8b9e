"""Packets: the frames of one type as columns, with their times and losses.

These modules turn the `Frames` of a decoder into `Packets`. Each packet gets a time from the
sensor's clock and an index from its counter. Modules in reading order:

* `packets`: the columns of n frames, raw and physical.
* `clocks`: reads and unwraps the sensor's clock, in integer nanoseconds.
* `pace`: the declared time between consecutive packets.
* `returns`: finds the returns of the same firings in consecutive packets.
* `counter_order`: finds lost, duplicate and late packets by their counter.
* `clock_order`: finds lost, duplicate and late datagrams by their clock, without a counter.
* `arrival_order`: counts losses among packets that have no counter and always arrive in order.
* `masked_sector`: finds sectors in which a rotating sensor sends nothing on purpose.
* `reorder`: sorts packets and drops duplicates.
* `imu`: the samples of an IMU.
* `packet_type`: the clock and the loss detection of one frame type.
* `stream`: makes packets from frames, batch by batch.
* `clock_status`: the state of the sensor's clock at each packet.
* `clock_estimate`: the offset and the drift between the clocks of sensor and host.
* `clock_findings`: the kinds of clock faults, each with a code, a text and advice.
* `clock_monitor`: finds the epoch, offset, drift and faults of a clock.
* `utc_times`: the times of packets in UTC.
"""
