"""How sensors come in: entry points, hooks, strangers' distributions."""
