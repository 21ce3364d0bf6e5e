"""Scripts of experiments that need more than a command."""
