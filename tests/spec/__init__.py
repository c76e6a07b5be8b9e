"""What a sensor is."""
