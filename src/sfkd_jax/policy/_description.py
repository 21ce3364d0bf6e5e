"""What a policy says about itself: its inputs and outputs, and its printed text."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sfkd_jax import assembly
from sfkd_jax.driving.certificate import (
    Conditions,
    Corridor,
    DrivingCertificate,
    LawMargins,
)
from sfkd_jax.driving.plants import axes
from sfkd_jax.latency import Latency
from sfkd_jax.policy._trained import TrainedModel
from sfkd_jax.ranges import in_words
from sfkd_jax.systems import SystemCertificate, Tracked


def interface_of(
    trained: TrainedModel, certificate: DrivingCertificate | None, latency: Latency
) -> dict[str, Any]:
    """Return names, units and limits of controls, observation, e and reference."""
    vehicle = trained.vehicle
    environment = trained.settings["environment"]
    # An environment that was measured in logs has names of its own.
    names = certificate.measured.boxes.names if certificate else None
    columns = list(names.env) if names else None
    labels = [entry.label for entry in vehicle.environment]
    return {
        "sampling_period_s": vehicle.dt,
        "horizon": assembly.controller_horizon(
            trained.settings["controller"], latency.loop(vehicle.dt)
        ),
        "latency_s": {
            "sensors": dict(zip(vehicle.state_names, latency.sensors, strict=True)),
            "controls": {
                control.name: delay
                for control, delay in zip(
                    vehicle.controls, latency.controls, strict=True
                )
            },
        },
        "controls": [
            {"name": control.label, "low": control.low, "high": control.high}
            for control in vehicle.controls
        ],
        "observation": list(vehicle.state_names),
        "environment": {
            "names": columns or environment.get("names") or labels,
            "low": list(environment["low"]),
            "high": list(environment["high"]),
        },
        "reference": ["x [m]", "y [m]", "yaw [rad]", "speed [m/s]"],
    }


def describe(
    trained: TrainedModel,
    certificate: DrivingCertificate | None,
    signature: str,
    latency: Latency,
) -> str:
    """Return what a policy drives, where its certificate applies, what is proved.

    Args:
        trained: the policy.
        certificate: its verified certificate, or None.
        signature: who signed the certificate, in words.
        latency: that the controller compensates, for each state and control.
    """
    vehicle = trained.vehicle
    interface = interface_of(trained, certificate, latency)
    has_pose = trained.model.frame.has_pose
    frame = "in the world" if has_pose else "along a path"
    states = [state.label for state in vehicle.states]
    controls = in_words(
        [control["name"] for control in interface["controls"]],
        [control["low"] for control in interface["controls"]],
        [control["high"] for control in interface["controls"]],
    )
    source = trained.settings["environment"].get("source", "measured")
    box = interface["environment"]
    lines = [
        f"Policy of {vehicle.name} {frame}, a step of {vehicle.dt:g} s",
        f"states: {', '.join(states)}",
        f"controls: {controls}",
        f"environment, {source}: {in_words(box['names'], box['low'], box['high'])}",
    ]
    if not latency.is_none:
        lines.append(f"latency, compensated: {latency}")
    if certificate:
        lines.append(_certified_box(certificate, trained))
        lines.extend(_certified_facts(certificate, signature, box["names"]))
    else:
        lines.append("no certificate: nothing is proved, nothing measured")
    return "\n  ".join(lines)


def _certified_box(certificate: DrivingCertificate, trained: TrainedModel) -> str:
    """Return the line about the states for which the certificate is stated."""
    boxes = certificate.measured.boxes
    low, high = boxes.state
    has_pose = trained.model.frame.has_pose
    named = axes(trained.vehicle, along_path=not has_pose)
    if has_pose:
        return f"certified box: {in_words(named['state'], low, high)}"
    names = [*named["state"], *named["control"][2:]]
    # The first two inputs are ν, which is the planner's choice and has no condition.
    inputs_low, inputs_high = boxes.control
    limits_low = [*low, *inputs_low[2:]]
    limits_high = [*high, *inputs_high[2:]]
    return f"certified box: {in_words(names, limits_low, limits_high)}"


def _certified_facts(
    certificate: DrivingCertificate, signature: str, env_names: list[str]
) -> Iterator[str]:
    """Yield the lines about what is proved and what is only measured."""
    alpha = certificate.proof.alpha
    yield f"proved: alpha {alpha:.4f}, contraction of the model a step"
    d_bar = certificate.measured.d_bar.one_step["latent"]
    measured = f"measured, {signature}: d_bar {d_bar:.3g}"
    corridor = certificate.corridor
    if corridor is None:
        yield f"{measured}; no corridor"
        return
    width = f"{corridor.corridor_m:.3f} m to each side"
    coverage = corridor.coverage
    kept = f"{100 * coverage.share:.1f} % of {coverage.runs} runs"
    yield f"{measured}, corridor {width}, kept in {kept}"
    yield _corridor_conditions(corridor.conditions, env_names)
    if corridor.margins:
        yield _margins_in_words(corridor.margins)
    # Of a vehicle with runs of its own, none was later.
    if corridor.in_force().late_controls:
        yield _late_in_words(corridor)
    if recorded := corridor.recorded:
        number = recorded.conditions.runs
        width = f"{recorded.corridor_m:.3f} m"
        yield f"of {number} runs of the car: {width} at level {recorded.level:g}"
    elif not corridor.is_claimed:
        yield "of a model of logs, not of the car, about which nothing is claimed"


def _margins_in_words(margins: LawMargins) -> str:
    """Return the line about what the law tolerates."""
    delay = min(margins.delay_s)
    at = margins.speed[margins.delay_s.index(delay)]
    return (
        f"law, on a grid: stable up to {delay:.2f} s later (at {at:.3g} m/s), with "
        f"{max(margins.gain_low):.2g} to {min(margins.gain_high):.2g} times its gains"
    )


def _late_in_words(corridor: Corridor) -> str:
    """Return the line about the corridors of vehicles that are later."""
    parts = []
    kinds = {"sensors": corridor.late_sensors, "controls": corridor.late_controls}
    for late, rows in kinds.items():
        widths = [f"{row.later_s:g} s {row.corridor_m:.3f} m" for row in rows]
        parts.append(f"{late} {', '.join(widths)}")
    return f"corridor if later: {'; '.join(parts)}"


def _corridor_conditions(conditions: Conditions, env_names: list[str]) -> str:
    """Return the line about the runs on which the corridor was measured."""
    slowest, fastest = conditions.speed
    env_low, env_high = conditions.env_box
    box = in_words(
        ["speed [m/s]", *env_names], [slowest, *env_low], [fastest, *env_high]
    )
    dwell = _span(conditions.dwell_s)
    bend = conditions.peak_curvature
    return f"under: {box}, each for {dwell}; curvature [1/m] {-bend:g} to {bend:g}"


def describe_controlled(tracked: Tracked, certificate: SystemCertificate) -> str:
    """Return what is controlled in a system, what is certified, and where.

    Args:
        tracked: the system and what it follows.
        certificate: its verified certificate.
    """
    system = tracked.system
    tubes = certificate.tubes
    conditions = tubes.conditions
    env = in_words(system.environment, *conditions.env_box)
    inputs = in_words(tracked.frame.input_names, *conditions.input_box)
    lines = [
        f"SystemPolicy of {system.name}, {1.0 / system.dt:g} Hz",
        f"states: {', '.join(state.label for state in system.state_variables)}",
        f"controls: {', '.join(system.controls)}",
        f"reference: {', '.join(tracked.frame.followed)}",
        f"proved: contracts at {certificate.proof.alpha:.4f} a step",
        f"under: {env}, each for {_span(conditions.env_dwell_s)}; "
        f"{inputs}, each for {_span(conditions.reference_dwell_s)}",
    ]
    units = tracked.model_frame.units
    for name, bounds in tubes.outputs.items():
        lines.append(
            f"measured, {100 * tubes.level:g} % of runs of "
            f"{conditions.duration_s:g} s: |{name}| <= {bounds.total:.4g} "
            f"{units[name]} ({bounds.tube:.4g} tube, {bounds.nominal:.4g} nominal)"
        )
    return "\n  ".join(lines)


def _span(seconds: tuple[float, float]) -> str:
    """Return a range of times, as in "3 to 6 s"."""
    shortest, longest = seconds
    return f"{shortest:g} to {longest:g} s"
