"""Planners from plain settings: the registry, and how each planner is built."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from sfkd_jax import control, plants
from sfkd_jax.build._choices import Settings, as_kwargs, choose, floats
from sfkd_jax.types import Controller, Model


def _sampled(
    name: str,
    search: Callable[..., Controller],
    settings: Settings,
    model: Model,
    plant: plants.Vehicle,
    env_low: Any,
    env_high: Any,
    law: control.PathLaw | None = None,
) -> Controller:
    """Return a planner that searches around a feedback law.

    The law is the path-following one (`sampling: feedback`), that of the model
    (`sampling: model`) or none (`sampling: plain`). In path coordinates it is the law
    of the policy, which the model contains (`sampling: law`).
    """
    cost = control.tracking_cost(
        dt=plant.dt, speed_loop=plant.speed_loop, **as_kwargs(settings["cost"])
    )
    limits = {
        "dt": plant.dt,
        "control_low": plant.control_low,
        "control_high": plant.control_high,
    }
    if law is not None:
        task = control.following_law(
            model, cost, law, **limits, **as_kwargs(settings["task"], "latent_weight")
        )
    else:
        laws = {"feedback": _feedback, "model": _model_law, "plain": _no_feedback}
        around = choose(laws, settings["sampling"], "controller.sampling")(
            settings, plant
        )
        ancillary = _model_law(settings, plant) if settings["ancillary"] else None
        task = control.path_tracking(
            model,
            cost,
            around,
            **limits,
            ancillary=ancillary,
            **as_kwargs(settings["task"]),
        )
    boxes = {"env_low": floats(env_low), "env_high": floats(env_high)}
    return search(task, **boxes, **as_kwargs(settings[name]))


def _feedback(settings: Settings, plant: plants.Vehicle) -> control.FeedbackLaw:
    gains = as_kwargs(settings["feedback"])
    return control.path_feedback(
        wheelbase=plant.wheelbase, speed_loop=plant.speed_loop, **gains
    )


def _model_law(settings: Settings, plant: plants.Vehicle) -> control.ModelLaw:
    return control.ModelLaw(dt=plant.dt, **as_kwargs(settings["model_law"]))


def _no_feedback(settings: Settings, plant: plants.Vehicle) -> control.FeedbackLaw:
    del settings
    return control.no_feedback(speed_loop=plant.speed_loop)


def _koopman_mpc(
    settings: Settings,
    model: Model,
    plant: plants.Vehicle,
    env_low: Any,
    env_high: Any,
) -> Controller:
    """Return a quadratic program over a linear predictor, with the planners' cost."""
    return control.koopman_mpc(
        model,
        dt=plant.dt,
        control_low=plant.control_low,
        control_high=plant.control_high,
        speed_loop=plant.speed_loop,
        terminal_weight=settings["task"]["terminal_weight"],
        env_low=floats(env_low),
        env_high=floats(env_high),
        **as_kwargs(settings["cost"]),
        **as_kwargs(settings["koopman_mpc"]),
    )


class Planner(NamedTuple):
    """A planner: how it is built, and whose arguments are its settings.

    Attributes:
        build: (settings of the controller, model, plant, env_low, env_high) ->
            controller; one that samples takes the law of a model in path coordinates.
        factories: their keyword-only arguments are the settings `controller.NAME`.
        given: of these arguments, those that are decided elsewhere.
        samples: whether it searches around a law (`controller.sampling`).
    """

    build: Callable[..., Controller]
    factories: tuple[Callable[..., Any], ...]
    given: tuple[str, ...] = ()
    samples: bool = True


def _searching(name: str, search: Callable[..., Any], *given: str) -> Planner:
    """Return a planner that searches around a law."""
    build = partial(_sampled, name, search)
    return Planner(build, (search, control.planner), (*_IN_PROGRAMS, *given))


_IN_PROGRAMS = ("several", "info_level")
"""Of programs that build their own planner."""
_WEIGHTS = ("effective_samples", "temperature")
"""Of the weighted mean, which only MPPI takes."""
_COST = (
    "lateral",
    "course",
    "speed",
    "steering_rate",
    "effort",
    "terminal_weight",
)
"""Of the cost, which all planners share."""
PLANNERS = {
    "mppi": _searching("mppi", control.mppi),
    "cem": _searching("cem", control.cem, *_WEIGHTS),
    "gradient": _searching("gradient", control.gradient_planner, *_WEIGHTS),
    "koopman_mpc": Planner(
        _koopman_mpc, (control.koopman_mpc,), given=_COST, samples=False
    ),
}
"""Planners by the name under which a controller's settings hold their own."""


def chosen_planner(settings: Settings) -> Planner:
    """Return the planner that the settings name.

    Raises:
        ValueError: it does not exist, or its own settings are missing.
    """
    name = settings.get("planner", "mppi")
    planner = choose(PLANNERS, name, "controller.planner")
    if name not in settings:
        raise ValueError(
            f"controller.planner={name} needs the settings controller.{name}; "
            f"choose the option controller={name}"
        )
    return planner


def controller_horizon(settings: Settings) -> int:
    """Return how many steps of the reference a controller reads."""
    return settings[settings.get("planner", "mppi")]["horizon"]
