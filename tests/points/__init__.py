"""Points, by every way to compute them."""
