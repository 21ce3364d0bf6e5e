"""A mass that is pushed: the smallest system that follows a reference, in closed form.

x⁺ = x + v dt + a dt² / 2,   v⁺ = v + a dt,   a = (u + F) / m
"""

from functools import cache

import jax.numpy as jnp

from sfkd_jax import models
from sfkd_jax.systems import (
    ClosedLoop,
    System,
    Tracked,
    derive_law,
    steady_states,
    tracking,
)

DT = 0.1
LIMIT = 4.0
MASS = (0.8, 1.2)
WIND = (-0.5, 0.5)
FASTEST = 1.0
"""Largest acceleration of the reference."""
RATE = 0.86


def pushed(state, control, env):
    """The step of the mass."""
    x, v = state
    a = (control[0] + env[1]) / env[0]
    return jnp.stack([x + v * DT + 0.5 * a * DT**2, v + a * DT])


def mass(step=pushed, **changed):
    """The mass, or a system that differs in some arguments."""
    tables = {
        "dt": DT,
        "states": {"x [m]": 0.001, "v [m/s]": 0.002},
        "controls": {"force [N]": (-LIMIT, LIMIT)},
        "environment": {"mass [kg]": MASS, "wind [N]": WIND},
        "name": "mass",
    }
    return System(step, **{**tables, **changed})


def frame(**changed):
    """The mass follows positions with a bounded acceleration."""
    arguments = {"reference": {("x", "v"): (-FASTEST, FASTEST)}, **changed}
    return tracking(arguments.pop("outputs", {"position": ("x",)}), **arguments)


def tracked(**changed):
    """The mass in these coordinates."""
    return Tracked(mass(), frame(**changed))


@cache
def steady():
    """Its steady states."""
    return steady_states(tracked(), points=3)


@cache
def loop(rate=RATE):
    """The mass with its law."""
    return ClosedLoop(tracked(), derive_law(tracked(), steady(), rate=rate))


def exact_model(of):
    """The closed loop itself as a model, which has no error."""
    return models.physics(of.step, frame=of.tracked.model_frame)
