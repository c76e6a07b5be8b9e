"""Scans drawn: in a terminal, as pictures in files, in notebooks.

In: a device, or points. Out: pictures. Modules in reading order:

* `live`: the window that shows a sensor at work: keys in, pictures and figures out, a recording switched on and off.
* `feed`: what the device delivers, taken in and counted between two pictures.
* `polar`: points as seen from above and from the side.
* `canvas`: pictures in character cells, and their inks.
* `screen`: the terminal: cells that changed, single keys.
* `svg`: one scan as a file.
* `rerun`: the scans in Rerun's viewer.
* `notebook`: what notebooks show of scans, packets, explained frames and sensors.
"""
