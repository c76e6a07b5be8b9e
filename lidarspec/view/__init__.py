"""Scans drawn: in a terminal, as pictures in files, in notebooks and in Rerun's viewer.

In: a device, or points. Out: pictures. The page in a browser is drawn by the distribution
`lidarspec-web`. Modules in reading order:

* `window`: shows a sensor at work in the terminal: keys in, pictures and figures out.
* `window_parts`: title, figures, colours and keys around the picture.
* `feed`: the scans of a device, counted, and played if they are of a file.
* `meter`: speed, rates, losses and jitter of a sensor at work.
* `polar`: points as seen from above and from the side.
* `canvas`: pictures in character cells, and their inks.
* `screen`: the terminal: cells that changed, single keys.
* `svg`: one scan as a file.
* `figures`: a scan, intensities, ranges and rates over time, for reports.
* `rerun`: the scans in Rerun's viewer.
* `notebook`: what notebooks show of scans, packets, explained frames and sensors.
* `page_server`: which plugin serves the page of `view --web`, and how its server is called.
"""
