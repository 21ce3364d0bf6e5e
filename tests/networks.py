"""Networks small enough to be certified by numpy alone, and what is proved of them."""

import numpy as np

from sfkd_jax.certification import _proofs
from sfkd_jax.types import Declared, Explicit, Hypernetwork, Polytope

BOX = [[-0.5, 0.0], [0.5, 0.2]]


def rotation(size, seed):
    return np.linalg.qr(np.random.default_rng(seed).standard_normal((size, size)))[0]


ROOT = np.diag([1.0, 2.0, 3.0])
FIRST, LAST = 0.3 * rotation(4, 3)[:, :3], 0.4 * rotation(4, 4)[:3]
POLYTOPE = Polytope(
    np.stack([0.3 * rotation(3, 1), 0.5 * rotation(3, 2), 0.4 * rotation(3, 5)])
)
NETWORK = Explicit(
    operators=POLYTOPE,
    residual=(FIRST, LAST),
    residual_multipliers=(np.full(4, 0.16),),
    decoder=(2 * FIRST, np.diag([1.0, 2.0, 0.3]) @ LAST),
    decoder_multipliers=(np.full(4, 0.5),),
    readout=np.asarray([[0.7, 0.1, 0.0]]),
    declared=Declared("tanh", "rotation", 2),
)
TURNED = Polytope(
    np.stack(
        [
            np.linalg.solve(ROOT, r * rotation(3, k) @ ROOT)
            for k, r in enumerate((0.3, 0.5))
        ]
    )
)
HYPERNETWORK = Hypernetwork(
    (0.5 * rotation(3, 6)[:, :2], 0.1 * rotation(9, 7)[:, :3]),
    (np.zeros(3), 0.3 * rotation(3, 8).ravel()),
)
KINDS = {
    "joint": (NETWORK, True, None),
    "separate": (NETWORK, False, None),
    "bare": (
        NETWORK._replace(
            residual=(), residual_multipliers=(), decoder=(), decoder_multipliers=()
        ),
        True,
        None,
    ),
    "linear": (
        NETWORK._replace(residual=(FIRST.T @ FIRST,), residual_multipliers=()),
        True,
        None,
    ),
    "silent": (NETWORK._replace(residual=(FIRST, 0 * LAST)), False, None),
    "metric": (
        NETWORK._replace(operators=TURNED, declared=Declared("tanh", "identity", 2)),
        False,
        ROOT @ ROOT,
    ),
    "hypernetwork": (NETWORK._replace(operators=HYPERNETWORK), True, None),
    "bare hypernetwork": (
        NETWORK._replace(operators=HYPERNETWORK, residual=(), residual_multipliers=()),
        True,
        None,
    ),
}


PROVED = {}


def proved_once(weights, box, *, joint, metric=None):
    """What the search finds, which takes most of the time."""
    key = id(weights), str(box), joint, metric is None or metric.tobytes()
    if key not in PROVED:
        PROVED[key] = (
            weights,
            _proofs.prove(weights, box, joint=joint, metric=metric),
        )  # so that no other has the id
    return PROVED[key][1]


def honest(kind):
    weights, joint, metric = KINDS[kind]
    return proved_once(weights, BOX, joint=joint, metric=metric)


def consistent(claims):
    """With everything that is computed from other constants computed again."""
    separate = claims.rho + claims.beta * claims.kappa**0.5
    alpha = min(
        [separate] + ([] if claims.alpha_joint is None else [claims.alpha_joint])
    )
    return claims._replace(alpha_separate=separate, alpha=alpha)
