"""Scans drawn. In: a device, or points. Out: pictures in a terminal, or as SVG.

`feed` takes what a device delivers and counts it; `polar` and `panel` draw points and figures on a `canvas` of character cells; `screen`
is the terminal; `live` the window with its keys, and `recording` the switch that records what is seen. `svg` writes one scan as a file.
"""
