"""What is proved of the engine, on the shapes."""
