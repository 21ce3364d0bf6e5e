"""What only the paper needs: the Koopman baseline and its controller."""

from sfkd_jax.paper._koopman import koopman as koopman
from sfkd_jax.paper._koopman_mpc import koopman_mpc as koopman_mpc

MODELS = {"koopman_mpc": koopman}
"""Models by name; see `models.FACTORIES`."""
