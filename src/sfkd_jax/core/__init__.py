"""Core types: planar poses, path coordinates and what any model predicts."""
