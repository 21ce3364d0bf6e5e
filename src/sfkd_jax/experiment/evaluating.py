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

from sfkd_jax import assembly, policy, store
from sfkd_jax.assembly import ScenarioSettings, System
from sfkd_jax.driving import simulation
from sfkd_jax.driving.plants import FRICTION, roles_of
from sfkd_jax.driving.scenarios import COURSES, Scenario
from sfkd_jax.driving.simulation.metrics import Row
from sfkd_jax.experiment import run_directory
from sfkd_jax.experiment.run import Run
from sfkd_jax.progress import Progress
from sfkd_jax.rollout import fold, on_host, unfold
from sfkd_jax.settings import arguments, choose
from sfkd_jax.types import Controller, Key, Params


class EpisodeSet(NamedTuple):
    """Paired episodes of a scenario that every system is evaluated on.

    Attributes:
        name: of the scenario.
        scenarios: roads and environments, with one entry per episode.
        keys: of sensors and samplers, one per episode.
    """

    name: str
    scenarios: Scenario
    keys: Key


class SystemResult(NamedTuple):
    """What the evaluation of a system on a set of episodes gives.

    Attributes:
        row: its row of results.json, not yet compared with others.
        arrays: the recorded episodes, by name.
    """

    row: Row
    arrays: dict[str, np.ndarray]


def make_episodes(run: Run) -> EpisodeSet:
    """Draw the episodes of the scenario of a run."""
    settings = run.settings
    plant = run.plant
    protocol = settings.evaluation
    run.source.check_plant()
    family = assembly.build_scenario(
        settings.scenario, plant, duration=protocol.episode_s, **run.source.box
    )
    sensor = arguments(settings.environment.sensor, simulation.observed_environment)

    @jax.jit
    def draw(keys: Array, sensor_keys: Array) -> Scenario:
        scenarios = jax.vmap(family)(keys)
        observe = partial(simulation.observed_environment, dt=plant.dt, **sensor)
        observed = jax.vmap(observe)(scenarios.envs, sensor_keys)
        return scenarios._replace(observed_envs=observed)

    # Two streams: other settings of the sensors leave the roads as they are.
    streams = jax.random.split(jax.random.key(protocol.seed))
    per_episode = partial(jax.random.split, num=protocol.episodes)
    road_keys, sensor_keys = jax.vmap(per_episode)(streams)
    scenarios = draw(road_keys, sensor_keys)
    return EpisodeSet(settings.scenario.name, scenarios, sensor_keys)


def _over_episodes(
    run: Callable[[Params, Scenario, Key], simulation.Episode],
) -> Callable[[Params, Scenario, Key], simulation.Episode]:
    """Compile the simulation of one episode for a batch of them.

    Accelerators run all at once. A core runs one after the other, so that the samples
    of a plan stay in its caches.
    """
    # Weights are arguments: of constants every training would be compiled anew.
    if jax.default_backend() != "cpu":
        return jax.jit(jax.vmap(run, in_axes=(None, 0, 0)))
    compiled = jax.jit(run)
    cores = available_cores()

    def run_all(params: Params, scenarios: Scenario, keys: Array) -> simulation.Episode:
        count = len(keys)
        inputs = [
            (params, *jax.tree.map(lambda leaf, i=i: leaf[i], (scenarios, keys)))
            for i in range(count)
        ]
        # Ahead of the threads, which would compile the same program side by side.
        program = compiled.lower(*inputs[0]).compile()

        def run_one(inputs_of_one: tuple[Any, ...]) -> simulation.Episode:
            return jax.block_until_ready(program(*inputs_of_one))

        pool = ThreadPoolExecutor(min(count, cores))
        episodes = []
        try:
            with Progress("episodes", count) as progress:
                for episode in pool.map(run_one, inputs):
                    episodes.append(episode)
                    progress.advance()
        finally:
            # Nobody waits for the episodes of an interrupted command.
            pool.shutdown(wait=False, cancel_futures=True)
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *episodes)

    return run_all


def available_cores() -> int:
    """Return how many cores this process may use."""
    # A process may be kept to some cores, as each of a comparison is.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def load_systems(run: Run) -> dict[str, System]:
    """Return the systems of `evaluation.systems` by name.

    "self" is the policy of the run, which is trained if it is missing; "law_nominal" is
    "law" with the law that is derived from the nominal model, and so on. With
    `environment.source=estimated` every system that reads e estimates it.
    """
    settings = run.settings
    references = assembly.reference_systems(run.plant, run.law)
    systems = {}
    for name in settings.evaluation.systems:
        if name == "oracle" and run.source.has_simulator:
            store.print_message("no oracle: it would plan with copies of the simulator")
            continue
        if name == "oracle" and run.plant.hidden:
            store.print_message("no oracle: the vehicle has states that nobody sees")
            continue
        if name == "self":
            systems[settings.model.system] = _policy_system(run)
            continue
        if run.source.along_path and name in assembly.LAWS_ALONE:
            source = run.source.with_law_of(assembly.LAWS_ALONE[name])
            alone = assembly.reference_systems(run.plant, source.law)
            references[name] = alone["law"]
        system = choose(references, name, "evaluation.systems entry")
        if settings.environment.source == "estimated" and system.env_source != "none":
            system = system._replace(env_source="estimated")
        systems[name] = system
    return systems


def _policy_system(run: Run) -> System:
    """Return the policy of the run as a system, with a certificate if it has one."""
    trained = run.policy
    certificate, reason = policy.read_certificate(run.directory, trained)
    if certificate is None:
        store.print_message(f"nothing is certified: {reason}")
    # A policy that reads no e is given no estimate of it either.
    reads_env = trained.settings["model"]["environment"]
    env_source = run.settings.environment.source if reads_env else "none"
    return System(trained.model, trained.params, env_source, certificate, trained.law)


class SystemEvaluation:
    """One system, compiled once for all sets of episodes of one length."""

    def __init__(self, run: Run, name: str, system: System) -> None:
        """Build the controller."""
        settings = run.settings
        plant = run.plant
        self._side_forces = settings.evaluation.side_forces
        self._plant = plant
        box: Any = run.source.box
        if run.source.logs:
            # The settings of logs state no box of e: it is measured.
            dataset = run.source.dataset
            box = {"env_low": dataset.env_low, "env_high": dataset.env_high}
        self.controller = assembly.build_controller(
            settings.controller,
            system.model,
            plant,
            **box,
            certificate=system.certificate,
            env_source=system.env_source,
            law=system.law,
            latency=run.latency,
        )
        if has_course(settings.scenario):
            self.controller = _in_lane(run, name, system, self.controller)
        # Folded once here; otherwise every control step would fold again.
        self.params = fold(system.model, system.params, on_host)
        self._columns = _columns(run, name, system)
        simulate = partial(
            simulation.simulate,
            plant.step,
            self.controller,
            horizon=_preview(run),
            dt=plant.dt,
            observation_noise=run.sensors,
            latency=run.latency,
            size=plant.size,
            hidden=plant.hidden,
        )
        self._simulate = _over_episodes(simulate)

    def __call__(self, episodes: EpisodeSet) -> SystemResult:
        """Simulate and score one set of episodes, without and with side forces."""
        episode, scores = self._scored(episodes, 0.0)
        row = simulation.row(scores, {**self._columns, "scenario": episodes.name})
        if self._side_forces:
            row["disturbed"] = []
        for force in self._side_forces:
            # Without a force the episodes are those above, and not simulated again.
            if force:
                _, scores = self._scored(episodes, force)
            row["disturbed"].append(simulation.disturbed(force, scores))
        arrays = {
            "lateral": episode.lateral,
            "states": episode.states,
            "controls": episode.controls,
            # With the roads: a page draws them without the settings.
            "envs": episodes.scenarios.envs,
            "path": episodes.scenarios.path.points,
            "dt": self._plant.dt,
        }
        return SystemResult(row, jax.tree.map(np.asarray, arrays))

    def _scored(
        self, episodes: EpisodeSet, force: float
    ) -> tuple[simulation.Episode, simulation.Scores]:
        """Simulate episodes under unmeasured side forces, and score them.

        Args:
            episodes: to simulate.
            force: largest side force [N]; 0 for none.
        """
        scenarios = episodes.scenarios
        if force:
            disturb = partial(
                simulation.disturbed_environment, self._plant, largest=force
            )
            envs = jax.jit(jax.vmap(disturb))(scenarios.envs, episodes.keys)
            scenarios = scenarios._replace(envs=envs)
        episode = self._simulate(self.params, scenarios, episodes.keys)
        scores = simulation.score(episode, dt=self._plant.dt, size=self._plant.size)
        return episode, scores


def _preview(run: Run) -> int:
    """Return how many points of the reference a controller of the run reads."""
    delay = run.latency.loop(run.plant.dt)
    return assembly.controller_horizon(run.settings.controller, delay)


def has_course(scenario: ScenarioSettings) -> bool:
    """Return whether there are obstacles on the road, and scenes, not references."""
    return scenario.name in COURSES


def _in_lane(run: Run, name: str, system: System, inner: Controller) -> Controller:
    """Return a controller of scenes around one of references."""
    certificate = system.certificate
    if system.law is None or certificate is None or certificate.corridor is None:
        raise ValueError(
            f"scenario={run.settings.scenario.name} needs systems with a certified "
            f"corridor, and {name} has none: evaluation.systems=[self]"
        )
    roles = roles_of(_environment_names(run), run.settings.environment.roles)
    return assembly.build_in_lane(
        inner,
        run.plant,
        system.law,
        certificate,
        horizon=_preview(run),
        car=run.plant.size,
        planner="mppi",
        friction=roles.index(FRICTION) if FRICTION in roles else None,
    )


def _environment_names(run: Run) -> list[str]:
    """Return the names of the entries of e, with units."""
    names = run.settings.environment.names
    return list(names) or [entry.label for entry in run.plant.environment]


def _columns(run: Run, name: str, system: System) -> Row:
    """Return the columns of a row that do not depend on episodes."""
    settings = run.settings
    protocol = settings.evaluation
    certificate = system.certificate
    leaves = jax.tree.leaves(unfold(system.params))
    return {
        "system": name,
        "model": settings.model.name if system.params else name,
        "controller": settings.controller.name,
        "planner": settings.controller.planner,
        "sampling": settings.controller.sampling,
        "env": system.env_source,
        "env_names": _environment_names(run),
        "vehicle": settings.vehicle.name,
        "inner_loop": settings.vehicle.inner_loop,
        "latency": None if run.latency.is_none else str(run.latency),
        "seeds": [settings.seed],
        "episodes": protocol.episodes,
        "episode_s": protocol.episode_s,
        "params": sum(leaf.size for leaf in leaves) or None,
        "alpha": certificate.proof.alpha if certificate else None,
    }


def evaluate_run(run: Run, *, command: str | None = None) -> tuple[Path, list[Row]]:
    """Evaluate every system of `evaluation.systems` and add its rows to the results.

    Rows of other scenarios and controllers in the same run stay.

    Args:
        run: whose systems they are.
        command: the command as it was typed, which is stored with the results.

    Returns:
        The path of results.json, and the rows of these systems.
    """
    began = time.perf_counter()
    # Vehicle and earlier results are checked before anything is trained.
    episodes = make_episodes(run)
    run_directory.read_results(run.directory)
    systems = load_systems(run)
    config = store.plain(run.settings)
    if command:
        config["command"] = command

    def keep(results: list[SystemResult]) -> Path:
        seconds = time.perf_counter() - began
        return run_directory.write_results(run.directory, config, results, seconds)

    results = drive(run, systems, episodes, keep)
    return keep(results), [result.row for result in results]


def _keep_nothing(results: list[SystemResult]) -> None:
    """Keep no result before all systems are done."""


def drive(
    run: Run,
    systems: Mapping[str, System],
    episodes: EpisodeSet,
    keep: Callable[[list[SystemResult]], Any] = _keep_nothing,
) -> list[SystemResult]:
    """Simulate, score and compare systems on the same episodes, with messages.

    Args:
        run: whose systems they are.
        systems: by name.
        episodes: that all of them drive.
        keep: receives the result of each system when it is done, so that a command that
            is stopped loses the results of no other system.
    """
    protocol = run.settings.evaluation
    length = f"{protocol.episodes} episodes of {protocol.episode_s:.0f} s"
    if has_course(run.settings.scenario):
        # Only a corridor keeps a car clear of what it passes: the others are left out.
        certified = {
            name: system for name, system in systems.items() if system.certificate
        }
        systems = certified or systems
    results: list[SystemResult] = []
    for name, system in systems.items():
        store.print_message(f"driving {length}: {name} on {episodes.name}")
        result = SystemEvaluation(run, name, system)(episodes)
        results.append(result)
        keep([result])
        error = result.row["rmse_m"]["mean"]
        worst = result.row["max_deviation_m"]
        store.print_message(f"  rmse {error:.4f} m, worst {worst:.3f} m")
    simulation.compare([result.row for result in results])
    return results
