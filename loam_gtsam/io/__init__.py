"""Files that a run writes and reads again: results, checkpoints, the state inside them."""
