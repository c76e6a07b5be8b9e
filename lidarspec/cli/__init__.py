"""The command line: a verb is a public function of a package, called with what was typed.

In: the words of a command. Out: text or JSON, an exit code, and one message with the next command
where it fails. Modules in reading
order:

* `root`: the verbs, each loaded when it is asked for; `main`, the entry point.
* `completion`: what can stand at a place, for the shell.
* `options`, `inputs`: words as arguments: what verbs share, and where bytes come from.
* `terminal`, `output`, `failures`: what is printed, and where it is lost; results as text, tables
  or JSON; failures as one message and an exit code.
* `listing`: the lines of an explanation, in colours.
* `sensors`, `frames`, `build`: what is installed, what a frame says, a frame out of values.
* `read`, `view`: a sensor at work: rows and figures, a picture.
* `recordings`: record a source into a file, and replay it.
* `convert`, `info`, `plot`: from file to file, what is in a file, a picture of it.
* `sim`: a simulated sensor on a port or in a file.
* `finding`: which sensor, why nothing comes, which checksum.
* `authors`: for those who write a sensor: a new one, its check, its exports.
"""

from lidarspec.cli.root import main

__all__ = ["main"]
