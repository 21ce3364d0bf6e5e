"""Learned dynamics with a stability certificate for sampling-based control, in JAX."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sfkd_jax.experiment.systems import certify_system as certify_system
    from sfkd_jax.export import warm_up as warm_up
    from sfkd_jax.geometry import relative as relative
    from sfkd_jax.info import Reason as Reason
    from sfkd_jax.latency import Latency as Latency
    from sfkd_jax.policy import Policy as Policy
    from sfkd_jax.policy import load as load
    from sfkd_jax.policy import policies as policies
    from sfkd_jax.store import ArtefactError as ArtefactError
    from sfkd_jax.systems import System as System
    from sfkd_jax.systems import integrated as integrated
    from sfkd_jax.systems import regulation as regulation
    from sfkd_jax.systems import simulated as simulated
    from sfkd_jax.systems import tracking as tracking

__version__ = "1.0.0"

_LAZY = {
    "load": "policy",
    "policies": "policy",
    "Policy": "policy",
    "relative": "geometry",
    "warm_up": "export",
    "ArtefactError": "store",
    "Reason": "info",
    "Latency": "latency",
    "System": "systems",
    "integrated": "systems",
    "simulated": "systems",
    "tracking": "systems",
    "regulation": "systems",
    "certify_system": "experiment.systems",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that `import sfkd_jax` stays quick."""
    if name not in _LAZY:
        raise AttributeError(f"module 'sfkd_jax' has no attribute {name!r}")
    return getattr(import_module(f"sfkd_jax.{_LAZY[name]}"), name)
