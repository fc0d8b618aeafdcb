"""Inertial samples: buffer, rest, attitude, level and pre-integration."""
