"""Several parts in one step: which sets leave together, who carries them, and the moves."""
