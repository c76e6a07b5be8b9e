"""Input and output, one module per kind of source; nothing else opens a file, port or socket."""
