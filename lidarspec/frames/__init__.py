"""One frame type as an engine: from its construct struct to a layout, and by that to columns, Containers and verdicts."""
