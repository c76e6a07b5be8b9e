"""Where frames are."""
