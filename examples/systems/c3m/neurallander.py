"""NEURALLANDER of C3M: a drone near the ground, told its acceleration.

    m v̇_x = m a_x + 12.1 - 12.4 v_x,   m v̇_y = m a_y + 1 - 5.6 v_y
    m v̇_z = m (a_z - g) + 2 + 19 e / (1 + exp((z - 0.182) / 0.096))

The source has a network in place of the forces on the right. This fit of it leaves
2.2, 0.8 and 0.8 N (r.m.s., z from 0.2 to 1.5 m, speeds up to 1 m/s) of 7.6, 3.3 and
1.8 N. e is the strength of the ground effect, and is 1 in the source.

Source: Sun, Jha and Fan, Learning Certified Control Using Contraction Metric (C3M),
CoRL 2020, and its code, github.com/sundw2014/C3M.
"""

import jax

from sfkd_jax.systems import System, integrated, tracking

DT = 0.05  # sampling period [s]; 0.03 in the source
MASS = 1.47  # [kg]
GRAVITY = 9.81  # [m/s²]
STARTS = dict.fromkeys(("x", "y", "vx", "vy", "vz"), (-1.0, 1.0))
STARTS |= {"z": (-0.4, 1.0)}
"""Errors at the start of the source's runs, whose length is `DURATION` [s]."""
DURATION = 3.0


def rates(state, control, env):
    """Derivatives of the states."""
    _, _, height, vx, vy, vz = state
    ground = 19.0 * env[0] * jax.nn.sigmoid((0.182 - height) / 0.096)
    return [
        vx,
        vy,
        vz,
        control[0] + (12.1 - 12.4 * vx) / MASS,
        control[1] + (1.0 - 5.6 * vy) / MASS,
        control[2] - GRAVITY + (2.0 + ground) / MASS,
    ]


def make():
    """Return the system, and what it follows: a position that accelerates."""
    # Standard deviations of the sensors.
    states = {f"{axis} [m]": 0.0005 for axis in ("x", "y", "z")}
    states |= {f"{speed} [m/s]": 0.005 for speed in ("vx", "vy", "vz")}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={f"push_{axis} [m/s²]": (-25.0, 25.0) for axis in ("x", "y", "z")},
        environment={"ground effect": (0.6, 1.4)},
        name="neurallander",
    )
    return system, tracking(
        {"position": ("x", "y", "z")},
        reference={(axis, f"v{axis}"): (-1.0, 1.0) for axis in ("x", "y", "z")},
        ranges={"vx": (-1.0, 1.0), "vy": (-1.0, 1.0), "z": (0.2, 1.5)},
    )
