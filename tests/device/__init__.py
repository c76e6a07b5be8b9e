"""A sensor on a source."""
