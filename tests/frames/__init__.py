"""A frame and its bytes."""
