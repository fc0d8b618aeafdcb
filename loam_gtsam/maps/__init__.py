"""Saved maps: written after a run, opened again, localised in."""
