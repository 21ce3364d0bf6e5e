"""Planar poses, path coordinates, folded parameters, and rollouts of any model."""
