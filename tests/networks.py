"""Networks small enough to be certified by numpy alone, and what is proved of them."""

from dataclasses import replace
from functools import cache

import numpy as np

from sfkd_jax.certification._claims import readouts
from sfkd_jax.certification._metric_claims import size_of
from sfkd_jax.certification._metrics import accepted_metric
from sfkd_jax.certification._search import prove_claims
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.types import BODY_FRAME, Declared, Explicit, Polytope


def rotation(size, seed=0):
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
NOTHING = {"residual": (), "residual_multipliers": ()}
KINDS = {
    "network": NETWORK,
    "bare": NETWORK._replace(decoder=(), decoder_multipliers=(), **NOTHING),
    "linear": NETWORK._replace(residual=(FIRST.T @ FIRST,), residual_multipliers=()),
    "silent": NETWORK._replace(residual=(FIRST, 0 * LAST)),
}
TURNED = NETWORK._replace(
    operators=Polytope(
        np.stack(
            [
                np.linalg.solve(ROOT, rate * rotation(3, k) @ ROOT)
                for k, rate in enumerate((0.3, 0.5, 0.4))
            ]
        )
    ),
    decoder=(),
    decoder_multipliers=(),
    readout=rotation(3, 9) * np.asarray([[0.5], [2.0], [1.0]]),
    declared=Declared("tanh", "identity", 2),
)
"""Along a path, and contracting faster in the norm of P = ROOT² than in the 2-norm."""
UNIT = size_of(ROOT @ ROOT)
METRIC = ROOT @ ROOT / UNIT
JOINT = [[np.full(4, (1.2 + 0.1 * k) / UNIT)] for k in range(3)]
TURNED_METRICS = {
    name: accepted_metric(TURNED, readouts(TURNED, PATH_FRAME)[name], METRIC, JOINT)
    for name in ("position", "yaw")
}
"""What is proved of its outputs in that norm."""


@cache
def honest(kind="network"):
    """What the search finds, which takes most of the time."""
    return prove_claims(KINDS[kind], frame_of(KINDS[kind]))


def frame_of(weights):
    """With a pose if there is a decoder of it."""
    return BODY_FRAME if weights.decoder else PATH_FRAME


def consistent(claims):
    """With everything that is computed from other constants computed again."""
    separate = claims.rho + claims.beta
    alpha = min(separate, claims.alpha_joint)
    return replace(claims, alpha_separate=separate, alpha=alpha)
