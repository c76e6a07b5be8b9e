"""Draw scans: in a terminal, as pictures in files, in notebooks and in the Rerun viewer.

The input is a device or points. The output is pictures. The page in a browser belongs to the
distribution `lidarspec-web`. Modules in reading order:

* `terminal_window`: a window in the terminal that shows a running sensor and reads keys.
* `terminal_window_parts`: the title, statistics, colours and keys around the picture.
* `live_scans`: reads, counts and plays the scans of a device.
* `live_frames`: reads and counts the frames of a device that measures no points, such as an IMU.
* `rate_meter`: measures speed, rates, losses and jitter of a running sensor.
* `polar`: draws points in character cells, from above and from the side.
* `canvas`: pictures made of characters, and their colours.
* `terminal_screen`: writes changed cells to the terminal, and reads single keys.
* `svg`: draws a scan as SVG.
* `matplotlib_figures`: figures of a scan, of intensities, and of ranges and rates over time.
* `rerun`: shows scans in the Rerun viewer.
* `notebook`: shows scans, packets, explained frames and sensors in notebooks.
* `page_server`: the interface to the plugin that serves the page of `view --web`.
"""
