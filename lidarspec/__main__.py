"""``python -m lidarspec``."""

from lidarspec.cli.root import main

if __name__ == "__main__":
    main()
