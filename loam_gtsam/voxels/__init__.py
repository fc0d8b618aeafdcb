"""Cubes of voxels, their search trees and their archive."""
