"""The test kit: what it names in an author's sensor, and what it says of a sound one."""
