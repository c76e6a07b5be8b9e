"""Scans drawn: in a terminal, as pictures in files, in notebooks, or by a page in a browser.

In: a device, or points. Out: pictures, and what a page makes them of. Modules in reading order:

* `live`: the window that shows a sensor at work: keys in, pictures and figures out, a recording
  switched on and off.
* `feed`: what the device delivers, taken in and counted between two pictures.
* `polar`: points as seen from above and from the side.
* `canvas`: pictures in character cells, and their inks.
* `screen`: the terminal: cells that changed, single keys.
* `svg`: one scan as a file.
* `figures`: a scan, intensities, ranges and rates over time, for reports.
* `rerun`: the scans in Rerun's viewer.
* `notebook`: what notebooks show of scans, packets, explained frames and sensors.
* `scene`: one scan as the message that a page draws.
* `broadcast`: a source that is read once and shown to any number of pages; files played, moved
  through.
* `backlog`: the newest bytes of it, frame by frame, and what was damaged.
* `answers`: what a page is told, in JSON.
* `access`: who may reach the page: the token of its link, hosts and origins.
* `connections`: how many connections there may be, and how long one may be open without the token.
* `page_requests`: how many requests of a page are taken a second, and which are done one after
  another.
* `saving`: scans that are saved, a few at a time.
* `temporary`: the temporary folder of the server.
* `server`: the page's files, its socket, and what is done on a page's request.
* `widget`: a source in a cell of a notebook, drawn as by the page.
"""
