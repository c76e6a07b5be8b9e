"""Each family of sensors against its manuals, test vectors and real captures."""
