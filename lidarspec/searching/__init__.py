"""The search for the checksum of sample frames: where it stands, what it covers, how it is computed."""
