"""The command line. In: the words of a command. Out: text or JSON, an exit code, and one message with the next command where it fails.

`root` has the verbs and loads the module of one when it is asked for; `main` is the entry point. What a verb can do is a public function
of a package: the modules here turn words into its arguments (`options`, `inputs`) and what it gives into text (`output`, `failures`).
"""

from lidarspec.cli.root import main

__all__ = ["main"]
