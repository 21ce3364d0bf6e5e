"""The settings of controllers: one dataclass for each planner."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil
from typing import Any

from sfkd_jax import control, paper
from sfkd_jax.driving import path_following
from sfkd_jax.latency import ON_TIME, CommandDelay, Delay
from sfkd_jax.settings import Values, arguments, choose, parse, schema, takes
from sfkd_jax.types import Controller

ENV_SOURCES = ("measured", "estimated", "none")
"""Where a controller takes the environment from."""
PLANNERS: dict[str, Callable[..., Controller]] = {
    "mppi": control.mppi,
    "cem": control.cem,
    "gradient": control.gradient_planner,
    "koopman_mpc": paper.koopman_mpc,
}
"""Planners by name. The settings of a controller hold those of its planner, which are
its keyword-only arguments, under this name. A new planner is an entry here and a file
in `conf/controller`.
"""
QUADRATIC = ("koopman_mpc",)
"""Planners that solve a quadratic program: they search around no law."""
_NO_SETTINGS = (
    # Vehicle, environment and model decide these arguments of factories.
    "dt",
    "wheelbase",
    "speed_loop",
    "control_low",
    "control_high",
    "env_low",
    "env_high",
    "estimate_env",
    "inner",
    "model",
    "law",
    # These are for programs that build their own gate.
    "prediction",
    "reads_env",
    "tests",
    "delay",
)
"""Arguments of controllers that are no settings."""


@takes()
class ControllerSettings:
    """A planner under a cost.

    Attributes:
        name: the name of its rows in tables.
        planner: its name in `PLANNERS`; the settings of the planner itself are
            `controller.PLANNER`, as in `controller.mppi`.
        sampling: "feedback" around the path-following law, "plain" around nothing,
            "law" around that of the path coordinates.
        cost: of `path_following.tracking_cost`.
        task: of `path_following.path_tracking`.
    """

    name: str
    planner: str = "mppi"
    sampling: str | None = None
    cost: Any = None
    task: Any = None

    @classmethod
    def subclass_for(cls, values: Values) -> type[ControllerSettings]:
        """Return the dataclass of the planner of this name."""
        name = values.get("planner", "mppi")
        subclass = choose(CONTROLLER_SETTINGS, name, "controller.planner")
        # No defaults here: a run states the settings of the planner that it uses.
        if name not in values:
            raise ValueError(
                f"controller.planner={name} needs the settings controller.{name}; "
                f"choose the option controller={name}"
            )
        return subclass

    @property
    def planner_settings(self) -> Any:
        """The settings of the planner itself."""
        return getattr(self, self.planner)

    @property
    def horizon(self) -> int:
        """How many steps of the reference the controller reads."""
        return self.planner_settings.horizon


@takes()
class SearchSettings(ControllerSettings):
    """A planner that searches around a law, and what is built around it.

    Attributes:
        shield: whether plans are kept inside the corridor of a certificate.
        adaptive: whether unmeasured forces are estimated while driving.
        latency_tolerance: error of the stated latency up to which the true one is
            estimated while driving [s]; along a path, with a corridor.
        feedback: of `path_following.path_feedback`.
        gate: of `path_following.Gate`.
        adaptation: of `path_following.Adaptation`.
    """

    shield: bool = False
    adaptive: bool = False
    latency_tolerance: Delay = 0.2
    feedback: Any = None
    gate: Any = None
    adaptation: Any = None


def _controller_schema(planner: str) -> type[ControllerSettings]:
    """Return the dataclass of a planner, with the settings of what is around it."""
    factories: dict[str, Callable[..., Any]] = {
        "cost": path_following.tracking_cost,
        "task": path_following.path_tracking,
    }
    if planner in QUADRATIC:
        base = ControllerSettings
        # A quadratic program has no rate limits in its task.
        skip = (*_NO_SETTINGS, "control_rate")
    else:
        base = SearchSettings
        skip = _NO_SETTINGS
        factories["feedback"] = path_following.path_feedback
        factories["gate"] = path_following.Gate
        factories["adaptation"] = path_following.Adaptation
    parts: dict[str, Any] = {
        part: schema(part.title(), object, factory, skip=(*skip, "horizon"))
        for part, factory in factories.items()
    }
    # What cost and task state is not stated by the planner once more.
    stated = {
        *arguments(parts["cost"], path_following.tracking_cost),
        *arguments(parts["task"], path_following.path_tracking),
    }
    of_planner = schema(
        "Planner", object, PLANNERS[planner], skip=(*_NO_SETTINGS, *stated)
    )
    return schema("Controller", base, **{planner: of_planner}, **parts)


CONTROLLER_SETTINGS = {planner: _controller_schema(planner) for planner in PLANNERS}
"""The dataclass of the settings of a controller, by planner."""


def controller_horizon(
    settings: ControllerSettings | Values, delay: CommandDelay = ON_TIME
) -> int:
    """Return how many steps of the reference a controller reads."""
    horizon = parse(ControllerSettings, settings, "controller.").horizon
    # The road until the command acts is needed as well.
    return horizon + ceil(delay.first)
