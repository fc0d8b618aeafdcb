"""Built-in simulated worlds, with exact truth."""
