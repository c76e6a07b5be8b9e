"""``python -m lidarspec``."""

from lidarspec.cli import main

if __name__ == "__main__":
    main()
