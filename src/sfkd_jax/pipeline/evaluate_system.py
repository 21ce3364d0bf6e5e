"""Evaluate a system: simulate paired episodes, score them and count violations."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np

from sfkd_jax import build, evaluation
from sfkd_jax.data import Dataset
from sfkd_jax.pipeline import scoring
from sfkd_jax.plants import Vehicle, check_step
from sfkd_jax.rollout import fold, unfold
from sfkd_jax.scenarios import Scenario
from sfkd_jax.types import Controller, Key, Params

WARM_UP = 10
"""Control steps before timing starts."""


class EpisodeSet(NamedTuple):
    """Paired episodes that every system is evaluated on.

    Attributes:
        name: of the scenario.
        variation: of the protocol, or None.
        scenarios: one per episode, leading axis first.
        keys: one per episode, for sensors and samplers.
    """

    name: str
    variation: str | None
    scenarios: Scenario
    keys: Key


class SystemResult(NamedTuple):
    """A row of results.json before comparisons, and the arrays behind it."""

    row: dict[str, Any]
    arrays: dict[str, np.ndarray]


Evaluator: TypeAlias = Callable[[EpisodeSet], SystemResult]


class _Compiled(NamedTuple):
    """What the evaluation of one system needs.

    Attributes:
        plant: the truth.
        controller: of the system.
        params: of its model, folded.
        options: of `evaluation.simulate`.
        protocol: the settings under `evaluation`.
        columns: of the row that do not depend on episodes.
        simulate: (scenarios, keys) -> episodes.
        score: (episodes, scenarios) -> scores and violations.
        act_ms: empty, or the time of a control step once it was measured.
    """

    plant: Vehicle
    controller: Controller
    params: Params
    options: dict[str, Any]
    protocol: dict[str, Any]
    columns: dict[str, Any]
    simulate: Callable[[Scenario, Key], evaluation.Episode]
    score: scoring.Scorer
    act_ms: list[tuple[float, float] | None]


def make_episodes(settings: dict[str, Any], plant: Vehicle) -> EpisodeSet:
    """Draw the episodes of a scenario; several devices share them evenly.

    Raises:
        ValueError: a vehicle that cannot be simulated.
    """
    check_step(plant)
    protocol = settings["evaluation"]
    family = build.build_scenario(
        settings["scenario"], plant, duration=protocol["episode_s"]
    )
    scenario_key, drive_key = jax.random.split(jax.random.key(protocol["seed"]))
    keys = jax.random.split(scenario_key, protocol["episodes"])
    scenarios = jax.jit(jax.vmap(family))(keys)
    keys = jax.random.split(drive_key, protocol["episodes"])
    sensor = build.as_kwargs(protocol["env_sensor"])
    observe = partial(evaluation.observed_environment, dt=plant.dt, **sensor)
    observed = jax.jit(jax.vmap(observe))(scenarios.envs, keys)
    scenarios = scenarios._replace(observed_envs=observed)
    name, variation = settings["scenario"]["name"], protocol["variation"]
    return EpisodeSet(name, variation, *_shard((scenarios, keys)))


def compile_system(
    settings: dict[str, Any],
    plant: Vehicle,
    name: str,
    system: build.System,
    dataset: Dataset | None,
) -> Evaluator:
    """Compile a system once for all sets of episodes of one length.

    Args:
        settings: of the run.
        plant: the truth.
        name: of the system.
        system: to evaluate.
        dataset: its calibration part gives the conformal tube and its test part the
            open-loop error; without it there is neither.
    """
    protocol = settings["evaluation"]
    controller = _build_controller(settings, plant, system, dataset)
    options = {
        "horizon": build.controller_horizon(settings["controller"]),
        "dt": plant.dt,
        "observation_noise": tuple(protocol["observation_noise"]),
    }
    columns = _columns(settings, name, system)
    # Folded once here; otherwise every control step would fold again.
    system = system._replace(params=jax.jit(partial(fold, system.model))(system.params))

    def simulate(scenario: Scenario, key: Key) -> evaluation.Episode:
        return evaluation.simulate(
            plant.step, controller, system.params, scenario, key, **options
        )

    columns |= {"open_loop_rmse_m": scoring.open_loop(settings, system, dataset)}
    compiled = _Compiled(
        plant=plant,
        controller=controller,
        params=system.params,
        options=options,
        protocol=protocol,
        columns=columns,
        simulate=jax.jit(evaluation.over_episodes(simulate)),
        score=scoring.scorer(settings, system, dataset, plant.dt),
        act_ms=[],
    )
    return partial(_evaluate, compiled)


def _build_controller(
    settings: dict[str, Any],
    plant: Vehicle,
    system: build.System,
    dataset: Dataset | None,
) -> Controller:
    """The controller of a system, for the environments of its data set."""
    box: dict[str, Any] = {
        name: settings["dataset"][name] for name in ("env_low", "env_high")
    }
    if dataset is not None:
        box = {
            "env_low": dataset.env_low.tolist(),
            "env_high": dataset.env_high.tolist(),
        }
    return build.build_controller(
        settings["controller"],
        system.model,
        plant,
        **box,
        certificate=system.certificate,
        env_source=system.env_source,
        law=system.law,
    )


def _evaluate(compiled: _Compiled, episodes: EpisodeSet) -> SystemResult:
    """Simulate and score one set of episodes, without and with side forces."""
    driven, scores, violation = _simulate(compiled, episodes, 0.0)
    if not compiled.act_ms:
        compiled.act_ms.append(_act_ms(compiled, episodes))
    row = evaluation.row(
        scores,
        compiled.columns | {"scenario": episodes.name, "variation": episodes.variation},
        compiled.act_ms[0],
        violation,
    )
    if compiled.protocol["side_forces"]:
        row["disturbed"] = [
            evaluation.disturbed(
                force,
                *(
                    _simulate(compiled, episodes, force)[1:]
                    if force
                    else (scores, violation)
                ),
            )
            for force in compiled.protocol["side_forces"]
        ]
    parts = ("lateral", "states", "controls")
    return SystemResult(
        row, {part: np.asarray(getattr(driven, part)) for part in parts}
    )


def _simulate(
    compiled: _Compiled, episodes: EpisodeSet, force: float
) -> tuple[evaluation.Episode, evaluation.Scores, dict[str, Any]]:
    """Episodes under unmeasured side forces up to `force` [N], and their scores."""
    scenarios = episodes.scenarios
    if force:
        disturb = partial(
            evaluation.disturbed_environment, compiled.plant, largest=force
        )
        envs = jax.jit(jax.vmap(disturb))(scenarios.envs, episodes.keys)
        scenarios = scenarios._replace(envs=envs)
    driven = compiled.simulate(scenarios, episodes.keys)
    return driven, *compiled.score(driven, episodes.scenarios)


def _columns(
    settings: dict[str, Any], name: str, system: build.System
) -> dict[str, Any]:
    """The columns of a row that do not depend on episodes."""
    protocol, certificate = settings["evaluation"], system.certificate
    return {
        "system": name,
        "model": settings["model"]["name"] if system.params else name,
        "controller": settings["controller"]["name"],
        "planner": settings["controller"]["planner"],
        "sampling": settings["controller"]["sampling"],
        "env": system.env_source,
        "vehicle": settings["vehicle"]["name"],
        "inner_loop": settings["vehicle"]["inner_loop"],
        "seeds": [settings["seed"]],
        "episodes": protocol["episodes"],
        "episode_s": protocol["episode_s"],
        "params": sum(leaf.size for leaf in jax.tree.leaves(unfold(system.params)))
        or None,
        "alpha": certificate and certificate["alpha"],
    }


def _act_ms(compiled: _Compiled, episodes: EpisodeSet) -> tuple[float, float] | None:
    """Median and 99 % quantile of a compiled control step [ms]; None if not timed."""
    steps = compiled.protocol["timed_steps"]
    if not steps:
        return None
    scenario = jax.tree.map(lambda leaf: leaf[0], episodes.scenarios)
    options = compiled.options
    reference = evaluation.first_reference(
        scenario, horizon=options["horizon"], dt=options["dt"]
    )
    observed = (scenario.initial_state, scenario.envs[0], reference)
    act = jax.jit(compiled.controller.act)
    state, times = compiled.controller.init(episodes.keys[0]), []
    for _ in range(WARM_UP + steps):
        start = time.perf_counter()
        _, state, _ = jax.block_until_ready(act(compiled.params, state, *observed))
        times.append(1e3 * (time.perf_counter() - start))
    times = times[WARM_UP:]
    return float(np.median(times)), float(np.quantile(times, 0.99))


def _shard(batch: Any) -> Any:
    """Distribute episodes evenly over all devices, if their number allows it."""
    devices = jax.devices()
    if len(devices) == 1 or len(jax.tree.leaves(batch)[0]) % len(devices):
        return batch
    mesh = jax.sharding.Mesh(devices, ("episode",))
    return jax.device_put(
        batch, jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("episode"))
    )
