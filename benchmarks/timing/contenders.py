"""The contenders by name: (samples, horizon, seed) -> `step(z, target) -> u`, built in
a process of their own.
"""

from functools import partial

from benchmarks.timing import jax_peers, other_peers, ours, own_model, problem

BUILDERS = (
    ours.sfkd_jax,
    ours.sfkd_jax_ess,
    ours.sfkd_jax_sharded,
    jax_peers.plain_jax,
    jax_peers.jax_mppi,
    jax_peers.evosax_cma_es,
    other_peers.pytorch_mppi,
    other_peers.pytorch_mppi_one_thread,
    other_peers.torchrl_mppi,
    other_peers.tau_ctrl,
)
OWN = (own_model.own_model, own_model.own_model_ess, own_model.own_model_sharded)
CONTENDERS = {build.__name__: build for build in (*BUILDERS, *OWN)}


def same_place(name, samples, horizon):
    """A step of no arguments: always from the same state to the same target."""
    return partial(CONTENDERS[name](samples, horizon), problem.start(), problem.TARGET)


def environment(name):
    """Environment variables that a contender wants to have set before its process
    starts.
    """
    return getattr(CONTENDERS[name], "environment", {})
