"""Cut the points of a stream into scans.

A scan is one revolution or frame period, by the sensor's declared rule.

In: batches of packets. Out: `Scan`, and `LaserScan` with ROS's names. Modules in reading order:

* `scans`: `ScanStream`, which takes batches as they come and gives the scans that they complete.
* `planes`: planar scans of one sensor, all on one grid of angles.
* `masking`: the masked sector of a rotating sensor, in which scans are cut.
* `cutter`: before which points a scan ends, by a column that wraps, a field that changes, or time.
* `selection`: which scans are wanted, and what of each; which bytes, by their arrival.
"""
