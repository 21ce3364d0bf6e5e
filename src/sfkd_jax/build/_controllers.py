"""Controllers out of plain settings."""

from __future__ import annotations

from functools import partial
from typing import Any

from sfkd_jax import control, vehicle
from sfkd_jax.build._choices import Settings, as_kwargs, choose, floats
from sfkd_jax.core.path_frame import LATERAL
from sfkd_jax.types import Controller, Model

ROAD_MARGIN = 0.05
"""Relative, of the box of κ and v_ref: a reference of points has a curvature that is a
little off.
"""
ALLOWANCE = 3.0
"""Standard deviations of a measured position that are not held against the tube."""
ENV_SOURCES = ("measured", "estimated", "none")
"""How a controller learns of the environment."""


def build_controller(
    settings: Settings,
    model: Model,
    plant: vehicle.Vehicle,
    *,
    env_low: Any = None,
    env_high: Any = None,
    certificate: Settings | None = None,
    env_source: str = "measured",
    law: control.PathLaw | None = None,
) -> Controller:
    """The planner of the settings, watched by a monitor if there is a certificate, told an estimate if `env_source` asks.

    Args:
        certificate: what watches the planner; with a corridor and `settings["shield"]`,
            what its shield keeps.
        law: of a model in path coordinates, the one that it was learned around.

    Raises:
        ValueError: an unknown planner, a vehicle without limits of its controls, or a
            model and a planner of different frames.
    """
    if not plant.control_low:
        raise ValueError(
            "a controller needs vehicle.control_low and vehicle.control_high, as in [-0.4,-3.0]"
        )
    build = choose(PLANNERS, settings.get("planner", "mppi"), "controller.planner")
    if model.along_path:
        if settings["sampling"] != "law" or env_source == "estimated" or law is None:
            raise ValueError(
                "a model in path coordinates needs controller.sampling=law, its law, and env_source=measured or none"
            )
        planner = build(settings, model, plant, env_low, env_high, law)
        if certificate and certificate.get("corridor") and settings.get("shield"):
            return in_corridor(planner, model, plant, law, certificate)
        return planner
    planner = build(settings, model, plant, env_low, env_high)
    watched = (
        planner
        if certificate is None
        else _monitored(planner, settings, model, certificate)
    )
    return (
        _estimated(watched, settings, model, plant, env_low, env_high)
        if env_source == "estimated"
        else watched
    )


def in_corridor(
    planner: Controller,
    model: Model,
    plant: vehicle.Vehicle,
    law: control.PathLaw,
    certificate: Settings,
) -> Controller:
    """The planner inside the corridor of a certificate; outside the boxes of ξ, e, κ and v_ref the law drives alone.

    The box of e_y is at least the corridor: whoever drives further out than the data
    did is still where it is claimed.

    Args:
        planner: any controller that needs no more than `Controller.act` is given.
        model: along a path.
        plant: whose limits of the controls hold.
        law: around which the model was learned.
        certificate: with a corridor.
    """
    corridor, boxes = certificate["corridor"], certificate["boxes"]
    bounds, sensors = corridor["bounds"], corridor["class"]["sensor_noise"]
    low = tuple(edge - ROAD_MARGIN * abs(edge) for edge in boxes["control"][0][2:])
    high = tuple(edge + ROAD_MARGIN * abs(edge) for edge in boxes["control"][1][2:])
    allowance = ALLOWANCE * max(sensors[:2], default=0.0)
    edge = corridor["corridor_m"] + allowance
    state_low, state_high = (list(side) for side in boxes["state"])
    state_low[LATERAL], state_high[LATERAL] = (
        min(state_low[LATERAL], -edge),
        max(state_high[LATERAL], edge),
    )
    return control.shielded(
        planner,
        model,
        law,
        width=bounds["nominal"],
        tube=bounds["followed_position"],
        horizon=corridor["shield_horizon"],
        noise_allowance=allowance,
        control_low=plant.control_low,
        control_high=plant.control_high,
        env_low=tuple(boxes["env"][0]),
        env_high=tuple(boxes["env"][1]),
        state_low=tuple(state_low),
        state_high=tuple(state_high),
        preview_low=low,
        preview_high=high,
    )


def _monitored(
    planner: Controller, settings: Settings, model: Model, certificate: Settings
) -> Controller:
    corners = {name: certificate["boxes"][name] for name in ("state", "control", "env")}
    boxes = {
        f"{name}_{side}": tuple(box[k])
        for name, box in corners.items()
        for k, side in enumerate(("low", "high"))
    }
    bounds = tuple(certificate["monitor"]["bounds"])
    return control.monitored(
        planner, model, bounds=bounds, **boxes, **as_kwargs(settings.get("monitor", {}))
    )


def _estimated(
    planner: Controller,
    settings: Settings,
    model: Model,
    plant: vehicle.Vehicle,
    env_low: Any,
    env_high: Any,
) -> Controller:
    box = {"env_low": floats(env_low), "env_high": floats(env_high)}
    sizes = {"states": len(plant.state_names), "controls": len(plant.control_low)}
    return control.estimated(
        planner, model, **box, **sizes, **as_kwargs(settings.get("estimator", {}))
    )


def _sampled(
    search: str,
    settings: Settings,
    model: Model,
    plant: vehicle.Vehicle,
    env_low: Any,
    env_high: Any,
    law: control.PathLaw | None = None,
) -> Controller:
    """A planner that searches around a law: the path-following one (`sampling: feedback`), the model's own, none.

    In path coordinates it is the law of the policy, and the model already holds it
    (`sampling: law`).
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
    return SEARCHES[search](task, **boxes, **as_kwargs(settings[search]))


def _feedback(settings: Settings, plant: vehicle.Vehicle) -> control.FeedbackLaw:
    gains = as_kwargs(settings["feedback"])
    return control.path_feedback(
        wheelbase=plant.wheelbase, speed_loop=plant.speed_loop, **gains
    )


def _model_law(settings: Settings, plant: vehicle.Vehicle) -> control.ModelLaw:
    return control.ModelLaw(dt=plant.dt, **as_kwargs(settings["model_law"]))


def _no_feedback(settings: Settings, plant: vehicle.Vehicle) -> control.FeedbackLaw:
    del settings
    return control.no_feedback(speed_loop=plant.speed_loop)


def _koopman_mpc(
    settings: Settings,
    model: Model,
    plant: vehicle.Vehicle,
    env_low: Any,
    env_high: Any,
) -> Controller:
    """A quadratic program over a linear predictor, under the cost that the samplers have."""
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


SEARCHES = {
    "mppi": control.mppi,
    "cem": control.cem,
    "gradient": control.gradient_planner,
}
PLANNERS = {search: partial(_sampled, search) for search in SEARCHES} | {
    "koopman_mpc": _koopman_mpc
}


def controller_horizon(settings: Settings) -> int:
    """How many steps of the reference a controller wants to see."""
    return settings[settings.get("planner", "mppi")]["horizon"]
