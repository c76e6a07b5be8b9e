"""Scans drawn, in a terminal or as SVG.

In: a device, or points. Out: pictures. Modules in reading order:

* `live`: the window that shows a sensor at work: keys in, pictures out.
* `feed`: what the device delivers, taken in and counted between two pictures.
* `polar`, `panel`: points as seen from above and from the side; the figures around them.
* `canvas`: pictures in character cells, and their inks.
* `screen`: the terminal: cells that changed, single keys.
* `recording`: recording that is switched on and off.
* `svg`: one scan as a file.
"""
