"""Cut the points of a stream into scans.

A scan is one revolution or frame period. Batches of packets are converted to `Scan` objects.
Modules in reading order:

* `scan`: `Scan`, the points of one revolution.
* `laserscan`: `LaserScan`, and the nearest return at each angle of a grid.
* `beams`: planar scans of one sensor, all on one grid of angles.
* `provenance`: the frame that a point of a scan came from.
* `stream`: `ScanStream`, which makes scans of batches of packets as they arrive.
* `cutter`: `ScanCutter`, which decides where a scan ends and whether it is complete.
* `scan_ends`: the ends of scans by the sensor's rule.
* `rotation`: the points or packets at which a rotating angle passes a given angle.
* `limits`: the maximum duration and size of a scan.
* `completeness`: the packets of a scan, and the packets missing in it.
* `masking`: the sector in which a rotating sensor sends no packets; scans end and begin in it.
* `selection`: selects scans of a source, parts of scans, and bytes by arrival time.
"""
