"""The closed loop of a system and its law, which a model is learned of."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import without_pose
from sfkd_jax.systems._law import Law, SteadyState
from sfkd_jax.systems._tracking import Error, Inputs, Tracked
from sfkd_jax.types import BODY, Control, Environment, State


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A system with its law: ξ⁺ = f(ξ, clip(law(ξ; ρ, e) + ν), ρ, e).

    Attributes:
        tracked: the system in the coordinates of its frame.
        law: around which a model is learned.
    """

    tracked: Tracked
    law: Law

    @property
    def controls(self) -> int:
        """Number of entries of ν."""
        return len(self.tracked.system.controls)

    def split(self, control: Float[Array, " nu_and_inputs"]) -> tuple[Control, Inputs]:
        """Return ν and ρ of a control of the model."""
        return control[: self.controls], control[self.controls :]

    def limited(self, control: Control) -> Control:
        """Return a control of the system, clipped to its limits."""
        low, high = map(jnp.asarray, self.tracked.system.control_box)
        return jnp.clip(control, low, high)

    def applied(self, steady: SteadyState, measured: Error, nu: Control) -> Control:
        """Return the control that the system receives.

        Args:
            steady: of the law.
            measured: ξ as the law reads it.
            nu: ν.
        """
        return self.limited(steady.feedback(measured) + nu)

    def step(
        self,
        state: State,
        control: Float[Array, " nu_and_inputs"],
        env: Environment,
    ) -> State:
        """Return the state of a model one sampling period later; see `types.Step`."""
        error = state[BODY]
        nu, inputs = self.split(control)
        applied = self.applied(self.law.at(inputs, env), error, nu)
        return without_pose(self.tracked.step(error, applied, inputs, env))
