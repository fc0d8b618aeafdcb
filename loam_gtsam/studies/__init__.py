"""Evaluation against truth, other systems, comparisons and parameter studies."""
