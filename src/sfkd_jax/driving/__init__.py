"""Driving: vehicles along paths, built on the ground floor."""
