"""The reference as a plan: what is committed, how it is chosen, and its controller."""
