"""Ways out of parts in several moves: straight lines, turns and screws."""
