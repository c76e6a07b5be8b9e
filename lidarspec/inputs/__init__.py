"""What comes in: from a file as fast as it is asked for, from a live source apart from decoding."""
