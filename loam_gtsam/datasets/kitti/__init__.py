"""Loaders of KITTI folders."""
