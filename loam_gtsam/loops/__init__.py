"""Keyframes, loop closures and the pose graph that ties them together."""
