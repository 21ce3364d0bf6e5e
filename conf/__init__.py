"""Options of every group; a package only so that a wheel can carry them."""
