"""One control problem for every contender: a latent model with residual and decoder networks, in any array library.

z⁺ = A z + B u + W_3 tanh(W_2 tanh(W_1 [z; u] + b_1) + b_2)
y = D_3 tanh(D_2 tanh(D_1 z)),  cost |y − y_ref|² + 0.01 |u|²
"""

import numpy as np

RANK, CONTROLS, OUTPUTS, WIDTH = 32, 2, 4, 64
NOISE, TEMPERATURE, EFFORT = 0.4, 1.0, 0.01
LOW, HIGH = -2.0, 2.0


def weights():
    """The same for all contenders."""
    random = np.random.default_rng(0)

    def layer(out, size, scale=1.0):
        return (scale * random.normal(size=(out, size)) / np.sqrt(size)).astype(
            np.float32
        )

    rotation, _ = np.linalg.qr(random.normal(size=(RANK, RANK)))
    return {
        "A": (0.97 * rotation).astype(np.float32),
        "B": layer(RANK, CONTROLS, 0.3),
        "W1": layer(WIDTH, RANK + CONTROLS),
        "b1": np.zeros(WIDTH, np.float32),
        "W2": layer(WIDTH, WIDTH),
        "b2": np.zeros(WIDTH, np.float32),
        "W3": layer(RANK, WIDTH, 0.05),
        "D1": layer(WIDTH, RANK),
        "D2": layer(WIDTH, WIDTH),
        "D3": layer(OUTPUTS, WIDTH),
    }


def advance(xp, w, z, u):
    """z⁺ of one sample, or of samples as rows; `xp` is numpy, jax.numpy or torch, and w
    its arrays.
    """
    hidden = xp.tanh(xp.concatenate((z, u), -1) @ w["W1"].T + w["b1"])
    return (
        z @ w["A"].T + u @ w["B"].T + xp.tanh(hidden @ w["W2"].T + w["b2"]) @ w["W3"].T
    )


def output(xp, w, z):
    """y, likewise."""
    return xp.tanh(xp.tanh(z @ w["D1"].T) @ w["D2"].T) @ w["D3"].T


def charge(xp, w, z, u, target):
    """The cost of arriving at z by u, likewise."""
    return xp.sum((output(xp, w, z) - target) ** 2, -1) + EFFORT * xp.sum(u**2, -1)


def start():
    """The latent state at the first step."""
    return np.random.default_rng(1).normal(size=RANK).astype(np.float32)


TARGET = np.zeros(OUTPUTS, np.float32)
