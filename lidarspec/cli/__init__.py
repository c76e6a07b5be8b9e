"""The command line: a verb calls one public function with its arguments.

In: the arguments of a command. Out: text or JSON and an exit code; on failure one message with
the next command. Modules in reading order:

* `root`: the verbs, each imported when it is used; `main`, the entry point.
* `completion`: completion of arguments in the shell.
* `options`, `inputs`: shared options and types of values; the input of commands.
* `terminal`, `output`, `failures`: standard output and error; results as text, tables or JSON;
  failures as one message and an exit code.
* `listing`: the lines of an explanation, in colours.
* `sensors`, `frames`, `build`: the installed sensors, the fields of a frame, a frame from values.
* `read`, `view`: a live sensor as rows, statistics or a picture.
* `recordings`: record a source into a file, and replay it.
* `convert`, `info`, `plot`: convert files, describe their contents, draw them.
* `sim`: a simulated sensor on a port or in a file.
* `finding`: identify a sensor, diagnose missing data, find a checksum.
* `authors`: create, check and export a sensor.
"""

from lidarspec.cli.root import main

__all__ = ["main"]
