"""Feedback laws along a path."""
