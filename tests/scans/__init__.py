"""Points cut into turns."""
