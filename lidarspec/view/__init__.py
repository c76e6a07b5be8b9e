"""Draw scans: in a terminal, as pictures in files, in notebooks and in the Rerun viewer.

In: a device, or points. Out: pictures. The distribution `lidarspec-web` draws the page in a
browser. Modules in reading order:

* `terminal_window`: shows a running sensor in the terminal: keys in, pictures and figures out.
* `terminal_window_parts`: title, figures, colours and keys around the picture.
* `live_scans`: reads, counts and plays the scans of a device.
* `live_frames`: the same for the frames of a device without points.
* `rate_meter`: speed, rates, losses and jitter of a running sensor.
* `polar`: points from above and from the side.
* `canvas`: pictures in character cells, and their colours.
* `terminal_screen`: the terminal: writes changed cells, reads single keys.
* `svg`: one scan as a file.
* `matplotlib_figures`: a scan, intensities, ranges and rates over time, for reports.
* `rerun`: scans in the Rerun viewer.
* `notebook`: scans, packets, explained frames and sensors in notebooks.
* `page_server`: the interface of the server of `view --web`, a plugin.
"""
