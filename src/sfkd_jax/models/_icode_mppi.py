"""Known dynamics with a learned residual that is affine in control and environment."""

from __future__ import annotations

from sfkd_jax.models._continuous import Conditioned, continuous
from sfkd_jax.models._icode import affine_rates, softplus
from sfkd_jax.types import Control, Model, Space, State, Step


def icode_mppi(
    space: Space,
    *,
    nominal: Step,
    dt: float = 0.1,
    hidden: tuple[int, ...] = (64, 64),
    environment: bool = True,
    affine_in: str = "both",
) -> Model:
    """Known dynamics plus a residual f(s) + G(s) [u; e], the sum solved by RK4 at dt.

        ẋ = f_nom(x, u) + f(s) + G(s) [u; e]

    The pose part of the residual is in the body frame. f and G are softplus networks
    that start near 0, so that training starts from the known dynamics. The residual of
    the original is f(x) + G(x) u; here e joins u.

    Args:
        space: measured scales; fixes all sizes.
        nominal: (x, u, e) -> dx/dt of the known dynamics in physical units, passed in
            by the caller (models never import the vehicle). A model that ignores e
            gives it the centre of the environment box.
        dt: sampling period [s], the solver's step in training and in use.
        hidden: widths of f and of G.
        environment: whether e is used; if not, e is 0.
        affine_in: "both" as above; "env" for f(s, u) + G(s, u) e, the extrinsic input
            of ICODE; "control" for f(s, e) + G(s, e) u, so that the gain of the
            steering may depend on friction.

    Raises:
        ValueError: another `affine_in`.

    Source: Song et al., arXiv 2605.03260, eqs. 10 and 11.
    """
    init, rates = affine_rates(
        space, hidden, (softplus,) * len(hidden), last=1e-3, affine_in=affine_in
    )

    def known(fiber: Conditioned, state: State, control: Control) -> State:
        return nominal(state, control, space.env_mean + space.env_scale * fiber.env)

    return continuous(
        space,
        dt=dt,
        init=init,
        fiber=Conditioned,
        rates=rates,
        environment=environment,
        known=known,
    )
