"""Controllers from plain settings."""

from __future__ import annotations

from typing import Any

from sfkd_jax import control, plants
from sfkd_jax.build._choices import Settings, as_kwargs
from sfkd_jax.build._planners import PLANNERS, chosen_planner, controller_horizon
from sfkd_jax.geometry import LATERAL
from sfkd_jax.rollout import with_offset
from sfkd_jax.types import Controller, Model

ROAD_MARGIN = 0.05
"""Relative enlargement of the box of κ and v_ref, since the curvature of a reference is
computed from its points.
"""
ALLOWANCE = 3.0
"""Standard deviations of a measured position by which the tube is enlarged."""
ENV_SOURCES = ("measured", "estimated", "none")
"""Where a controller takes the environment from."""
_NAMES = frozenset(
    (
        *PLANNERS,
        *("name", "planner", "sampling", "ancillary", "feedback", "model_law"),
        *("task", "cost", "shield", "adaptive", "adaptation", "online_tube"),
    )
)
"""Settings of a controller."""


def build_controller(
    settings: Settings,
    model: Model,
    plant: plants.Vehicle,
    *,
    env_low: Any = None,
    env_high: Any = None,
    certificate: Settings | None = None,
    env_source: str = "measured",
    law: control.PathLaw | None = None,
    adaptive: bool = False,
) -> Controller:
    """Return the planner of the settings with its shield and adaptation.

    Args:
        settings: of the controller.
        model: the planner predicts with.
        plant: vehicle, whose limits the controls keep.
        env_low: lower ends of the environment box E.
        env_high: upper ends of E.
        certificate: with a corridor and `settings["shield"]`, of a shield.
        env_source: one of `ENV_SOURCES`; "estimated" needs path coordinates.
        law: that a model in path coordinates was learned around.
        adaptive: whether a controller along a path estimates unmeasured forces and
            errors of its inputs while driving, and slows down while its online tube
            does not fit the lane, even if the settings do not say so; with "estimated"
            it always does.

    Raises:
        ValueError: an unknown planner or setting, a vehicle without limits of its
            controls, a model and a planner in different coordinates, or an estimate or
            adaptation without path coordinates.
    """
    if not plant.control_low:
        raise ValueError(
            "a controller needs vehicle.control_low and vehicle.control_high, "
            "as in [-0.4,-3.0]"
        )
    # A setting that nothing reads could be one that somebody relies on.
    if unknown := sorted(settings.keys() - _NAMES):
        raise ValueError(f"unknown setting controller.{unknown[0]}")
    build = chosen_planner(settings).build
    if model.along_path:
        if settings["sampling"] != "law" or law is None:
            raise ValueError(
                "a model in path coordinates needs controller.sampling=law and its law"
            )
        adaptive |= settings.get("adaptive", False) or env_source == "estimated"
        planned = with_offset(model) if adaptive else model
        planner = build(settings, planned, plant, env_low, env_high, law)
        if certificate and certificate.get("corridor") and settings.get("shield"):
            planner = in_corridor(planner, planned, plant, law, certificate)
        if not adaptive:
            return planner
        box = env_low, env_high
        return _adaptive(planner, settings, model, plant, law, box, env_source)
    if env_source == "estimated":
        raise ValueError(
            "env_source=estimated needs a model in path coordinates: model.frame=path"
        )
    if adaptive or settings.get("adaptive"):
        raise ValueError("adaptation needs a model in path coordinates")
    return build(settings, model, plant, env_low, env_high)


def in_corridor(
    planner: Controller,
    model: Model,
    plant: plants.Vehicle,
    law: control.PathLaw,
    certificate: Settings,
) -> Controller:
    """Return the planner with a shield that keeps the corridor of a certificate.

    Outside the boxes of ξ, e, κ and v_ref the law acts alone. The box of e_y contains
    the corridor, since the claim holds there, whether or not the data reach that far.

    Args:
        planner: any controller that needs no other input than that of `Controller.act`.
        model: in path coordinates.
        plant: vehicle, whose limits the controls keep.
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


def _adaptive(
    planner: Controller,
    settings: Settings,
    model: Model,
    plant: plants.Vehicle,
    law: control.PathLaw,
    box: tuple[Any, Any],
    env_source: str,
) -> Controller:
    if box[0] is None or box[1] is None:
        raise ValueError("adaptation needs env_low and env_high")
    adaptive = control.adaptive(
        planner,
        model,
        law,
        coordinates=len(plant.state_names) - 1,
        control_low=plant.control_low,
        control_high=plant.control_high,
        env_low=tuple(box[0]),
        env_high=tuple(box[1]),
        estimate_env=env_source == "estimated",
        **as_kwargs(settings.get("adaptation", {})),
    )
    return control.online_tube(
        adaptive,
        horizon=controller_horizon(settings),
        **as_kwargs(settings.get("online_tube", {})),
    )
