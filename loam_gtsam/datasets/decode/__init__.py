"""Decoders of messages, tables and point formats into arrays."""
