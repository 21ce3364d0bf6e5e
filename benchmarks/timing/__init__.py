"""Times of control steps, episodes and compilations."""
