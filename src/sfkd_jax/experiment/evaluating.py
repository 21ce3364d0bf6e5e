"""Evaluate systems: simulate paired episodes and score them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sfkd_jax import build, evaluation, policy, store
from sfkd_jax.build import System
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.experiment import data, runs, stages
from sfkd_jax.experiment.options import Settings
from sfkd_jax.plants import Vehicle, check_step
from sfkd_jax.rollout import fold, on_host, unfold
from sfkd_jax.scenarios import COURSES, Scenario
from sfkd_jax.settings import arguments, choose, replace
from sfkd_jax.types import Controller, Key, Params


class EpisodeSet(NamedTuple):
    """Paired episodes of a scenario that every system is evaluated on.

    Scenarios and keys, of sensors and samplers, have one entry per episode.
    """

    name: str
    scenarios: Scenario
    keys: Key


class SystemResult(NamedTuple):
    """A row of results.json before comparisons, and the arrays behind it."""

    row: Row
    arrays: dict[str, np.ndarray]


def make_episodes(settings: Settings) -> EpisodeSet:
    """Draw the episodes of a scenario."""
    plant, protocol = build.build_vehicle(settings.vehicle), settings.evaluation
    check_step(plant, len(settings.environment.low or (0, 0)))
    about: Any = {"duration": protocol.episode_s} | settings.environment.box
    family = build.build_scenario(settings.scenario, plant, **about)
    sensor = arguments(settings.environment.sensor, evaluation.observed_environment)

    @jax.jit
    def draw(keys: Array, sensor_keys: Array) -> Scenario:
        scenarios = jax.vmap(family)(keys)
        observe = partial(evaluation.observed_environment, dt=plant.dt, **sensor)
        observed = jax.vmap(observe)(scenarios.envs, sensor_keys)
        return scenarios._replace(observed_envs=observed)

    # Two streams: other settings of the sensors leave the roads as they are.
    keys = jax.vmap(partial(jax.random.split, num=protocol.episodes))(
        jax.random.split(jax.random.key(protocol.seed))
    )
    return EpisodeSet(settings.scenario.name, draw(keys[0], keys[1]), keys[1])


def _over_episodes(
    run: Callable[[Params, Scenario, Key], evaluation.Episode],
) -> Callable[[Params, Scenario, Key], evaluation.Episode]:
    """Compile the simulation of one episode for a batch of them.

    Accelerators run all at once. A core runs one after the other, so that the samples
    of a plan stay in its caches.
    """
    # Weights are arguments: of constants every training would be compiled anew.
    if jax.default_backend() != "cpu":
        return jax.jit(jax.vmap(run, in_axes=(None, 0, 0)))
    compiled, cores = jax.jit(run), os.cpu_count() or 1
    # A process may be kept to some cores, as each of a comparison is.
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))

    def run_all(params: Params, scenarios: Scenario, keys: Array) -> evaluation.Episode:
        count = len(keys)
        batch = [
            (params, *jax.tree.map(lambda leaf, i=i: leaf[i], (scenarios, keys)))
            for i in range(count)
        ]
        # Ahead of the threads, which would compile the same program side by side.
        program = compiled.lower(*batch[0]).compile()
        pool = ThreadPoolExecutor(min(count, cores))
        try:
            done = list(
                pool.map(lambda one: jax.block_until_ready(program(*one)), batch)
            )
        finally:
            # Nobody waits for the episodes of an interrupted command.
            pool.shutdown(wait=False, cancel_futures=True)
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *done)

    return run_all


def load_systems(settings: Settings) -> dict[str, System]:
    """Return the systems of `evaluation.systems` by name.

    "self" is the policy of the run, which is trained if it is missing; "law_nominal" is
    "law" with the law that is derived from the nominal model, and so on. With
    `environment.source=estimated` every system that reads e estimates it.
    """
    plant = build.build_vehicle(settings.vehicle)
    references = build.reference_systems(plant, data.ensure_law(settings))
    systems = {}
    for name in settings.evaluation.systems:
        if name == "oracle" and getattr(settings.vehicle, "env", None):
            store.print_message("no oracle: it would plan with copies of the simulator")
            continue
        if name == "self":
            systems[settings.model.system] = _policy_system(settings)
            continue
        if (along := settings.along_path) and (whose := build.LAWS_ALONE.get(name)):
            along = replace(along, law=replace(along.law, model=whose))
            law = data.ensure_law(replace(settings, dataset=along))
            references[name] = build.reference_systems(plant, law)["law"]
        system = choose(references, name, "evaluation.systems entry")
        if settings.environment.source == "estimated" and system.env_source != "none":
            system = system._replace(env_source="estimated")
        systems[name] = system
    return systems


def _policy_system(settings: Settings) -> System:
    """Return the policy of the run as a system, with a certificate if it has one."""
    trained = stages.ensure_policy(settings)
    certificate, reason = policy.read_certificate(settings.run_dir, trained)
    if certificate is None:
        store.print_message(f"nothing is certified: {reason}")
    # A policy that reads no e is given no estimate of it either.
    reads_env = trained.settings["model"]["environment"]
    env_source = settings.environment.source if reads_env else "none"
    return System(trained.model, trained.params, env_source, certificate, trained.law)


class SystemEvaluation:
    """One system, compiled once for all sets of episodes of one length."""

    def __init__(self, settings: Settings, name: str, system: System) -> None:
        """Build the controller."""
        self._settings = settings
        self._plant = plant = build.build_vehicle(settings.vehicle)
        box: Any = settings.environment.box
        if settings.logs:
            # Measured: their settings have none.
            dataset, _ = data.ensure_dataset(settings)
            box = dict(zip(box, (dataset.env_low, dataset.env_high), strict=True))
        self.controller = build.build_controller(
            settings.controller,
            system.model,
            plant,
            **box,
            certificate=system.certificate,
            env_source=system.env_source,
            law=system.law,
        )
        if has_course(settings):
            self.controller = _in_lane(name, system, plant, settings, self.controller)
        # Folded once here; otherwise every control step would fold again.
        self.params = fold(system.model, system.params, on_host)
        self._columns = _columns(settings, name, system)
        simulate = partial(
            evaluation.simulate,
            plant.step,
            self.controller,
            horizon=settings.controller.horizon,
            dt=plant.dt,
            observation_noise=settings.sensors(plant),
            size=plant.size,
        )
        self._simulate = _over_episodes(simulate)

    def __call__(self, episodes: EpisodeSet) -> SystemResult:
        """Simulate and score one set of episodes, without and with side forces."""
        episode, scores = self._scored(episodes, 0.0)
        row = evaluation.row(scores, self._columns | {"scenario": episodes.name})
        if forces := self._settings.evaluation.side_forces:
            row["disturbed"] = []
        for force in forces:
            # Without a force the episodes are those above, and not simulated again.
            if force:
                _, scores = self._scored(episodes, force)
            row["disturbed"].append(evaluation.disturbed(force, scores))
        parts = ("lateral", "states", "controls")
        arrays = {part: getattr(episode, part) for part in parts}
        # With the roads: a page draws them without the settings.
        known = episodes.scenarios
        arrays |= {"envs": known.envs, "path": known.path.points, "dt": self._plant.dt}
        return SystemResult(row, jax.tree.map(np.asarray, arrays))

    def _scored(
        self, episodes: EpisodeSet, force: float
    ) -> tuple[evaluation.Episode, evaluation.Scores]:
        """Episodes under unmeasured side forces up to `force` [N], and their scores."""
        known = driven = episodes.scenarios
        if force:
            disturb = partial(
                evaluation.disturbed_environment, self._plant, largest=force
            )
            envs = jax.jit(jax.vmap(disturb))(known.envs, episodes.keys)
            driven = known._replace(envs=envs)
        episode = self._simulate(self.params, driven, episodes.keys)
        return episode, evaluation.score(
            episode, dt=self._plant.dt, size=self._plant.size
        )


def has_course(settings: Settings) -> bool:
    """Whether there are obstacles on the road, and scenes in place of references."""
    return settings.scenario.name in COURSES


def _in_lane(
    name: str, system: System, plant: Vehicle, settings: Settings, inner: Controller
) -> Controller:
    """Return a controller of scenes around one of references."""
    if system.law is None or not (system.certificate or {}).get("corridor"):
        raise ValueError(
            f"scenario={settings.scenario.name} needs systems with a certified "
            f"corridor, and {name} has none: evaluation.systems=[self]"
        )
    return build.build_in_lane(
        inner,
        plant,
        system.law,
        system.certificate or {},
        horizon=settings.controller.horizon,
        car=plant.size,
        planner="mppi",
        friction=0,
    )


def _columns(settings: Settings, name: str, system: System) -> Row:
    """The columns of a row that do not depend on episodes."""
    protocol, certificate = settings.evaluation, system.certificate
    leaves = jax.tree.leaves(unfold(system.params))
    return {
        "system": name,
        "model": settings.model.name if system.params else name,
        "controller": settings.controller.name,
        "planner": settings.controller.planner,
        "sampling": settings.controller.sampling,
        "env": system.env_source,
        "vehicle": settings.vehicle.name,
        "inner_loop": settings.vehicle.inner_loop,
        "seeds": [settings.seed],
        "episodes": protocol.episodes,
        "episode_s": protocol.episode_s,
        "params": sum(leaf.size for leaf in leaves) or None,
        "alpha": certificate["alpha"] if certificate else None,
    }


def evaluate_run(settings: Settings, *, command: str | None = None) -> Path:
    """Evaluate every system of `evaluation.systems` and add its rows to the results.

    Rows of other scenarios and controllers in the same run stay. `command`, as it was
    typed, is stored with the results. Returns the path of results.json.
    """
    began = time.perf_counter()
    # Vehicle and earlier results are checked before anything is trained.
    episodes = make_episodes(settings)
    runs.read_results(settings.run_dir)
    compared = load_systems(settings)
    config = store.plain(settings) | ({"command": command} if command else {})

    def keep(found: list[SystemResult]) -> Path:
        seconds = time.perf_counter() - began
        return runs.write_results(settings.run_dir, config, found, seconds)

    return keep(drive(settings, compared, episodes, keep))


def drive(
    settings: Settings,
    systems: Mapping[str, System],
    episodes: EpisodeSet,
    keep: Callable[[list[SystemResult]], Any] = lambda found: None,
) -> list[SystemResult]:
    """Simulate, score and compare systems on the same episodes, with messages.

    `keep` receives each system as it is done: a command that is stopped loses no other.
    """
    protocol, found = settings.evaluation, list[SystemResult]()
    length = f"{protocol.episodes} episodes of {protocol.episode_s:.0f} s"
    if has_course(settings):
        # Only a corridor keeps a car clear of what it passes: the others stay at home.
        systems = {n: one for n, one in systems.items() if one.certificate} or systems
    for name, system in systems.items():
        store.print_message(f"driving {length}: {name} on {episodes.name}")
        result = SystemEvaluation(settings, name, system)(episodes)
        found.append(result)
        keep([result])
        error, worst = result.row["rmse_m"]["mean"], result.row["max_deviation_m"]
        store.print_message(f"  rmse {error:.4f} m, worst {worst:.3f} m")
    evaluation.compare([result.row for result in found])
    return found
