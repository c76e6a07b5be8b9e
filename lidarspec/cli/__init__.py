"""The command line. Each verb calls a public function of the package.

The input is the arguments of a command. The output is text or JSON, and an exit code. A failure
prints one message, which suggests the next command. Modules in reading order:

* `root`: the list of verbs, and the entry point `main`. A verb is imported when it is used.
* `completion`: completion of arguments in the shell.
* `options`: options that several verbs share.
* `inputs`: the input of verbs that read bytes.
* `terminal`: prints to standard output and standard error.
* `output`: formats results as text, tables or JSON.
* `failures`: reports a failure as one message and an exit code.
* `listing`: prints the lines of an explanation, in colours.
* `sensors`: list the installed sensors.
* `frames`: print or explain the fields of frames.
* `build`: build a frame, and send a command.
* `read`: print a live sensor's data as rows or statistics.
* `view`: draw a live sensor.
* `clock`: diagnose the clocks of sensors.
* `recordings`: record a source into a file, and replay it.
* `convert`: convert files to other formats.
* `info`: describe the contents of files.
* `plot`: draw a scan, or statistics over time.
* `sim`: simulate a sensor on a port or in a file.
* `finding`: identify a sensor, diagnose missing data, find a checksum.
* `authors`: create, check and export a sensor.
"""

from lidarspec.cli.root import main

__all__ = ["main"]
