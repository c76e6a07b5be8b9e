"""How the points of a sensor are computed fast: expressions taken apart, and the calls or loops made of them."""
