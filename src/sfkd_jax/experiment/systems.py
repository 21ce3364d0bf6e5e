"""From a system to a policy with a certificate: `certify_system`."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax import policy, store
from sfkd_jax.certificate import Provenance, Refusal, read, write
from sfkd_jax.certification import CertificationRefused, boxes_of, measure, prove
from sfkd_jax.data import Dataset, measure_space, random_windows, spread_windows
from sfkd_jax.experiment import run_directory
from sfkd_jax.experiment.fitting import fit_planning
from sfkd_jax.experiment.tube_settings import LOGGED, TubeSettings, check_settings
from sfkd_jax.policy import CERTIFICATE, SystemPolicy, TrainedSystem
from sfkd_jax.ranges import NonNegativeInt
from sfkd_jax.rollout import fold, on_host
from sfkd_jax.settings import parse
from sfkd_jax.systems import (
    ClosedLoop,
    System,
    SystemCertificate,
    Tracked,
    Tracking,
    best_law,
    derive_law,
    random_runs,
    spread_of,
    steady_states,
)
from sfkd_jax.training import fit, multi_step_loss
from sfkd_jax.tubes import measure_tubes
from sfkd_jax.types import BODY, Key, Trajectory

BATCH = 128
"""Windows in a batch of the training."""
WINDOW = 20
"""Steps of a window."""
TUBE = 0.5
"""Weight of the tube in the training loss."""
PART_SIZES = (6000, 400, 400, 400)
"""Number of segments of the parts of the data, at full size."""
SMALLEST_PART = 64
"""Smallest number of segments of a part."""
FIRST_PART = 10
"""Stream of the random keys of the first part."""
SEGMENT = 60
"""Steps of a segment."""
SPREAD_STEPS = 300
"""Steps of the runs that tell how far the loop moves."""
PROBES = 4
"""Number of places at which the step is recorded, so that another one is noticed."""
MODEL = {
    "lift": "state",
    "scheduled": True,
    "transport": False,
    "forcing_hidden": 64,
    "learn_alpha": True,
    "residual_hidden": [64, 64],
    "planning_residual": True,
}
"""Settings of `models.sfkd` for closed loops, besides those that follow from the law.
"""
BUDGET = 0.08
"""β of the model; ρ is what is left to `LARGEST_RATE`."""
LARGEST_RATE = 0.995
"""Largest contraction rate that a model may learn."""


@dataclass(frozen=True, eq=False)
class SystemRun:
    """A system in its run directory.

    Every property is computed, loaded or made when it is first asked for, and kept.

    Attributes:
        tracked: the system in the coordinates of its frame.
        settings: of the run.
        directory: of the run.
        seed: of everything that is drawn.
    """

    tracked: Tracked
    settings: TubeSettings
    directory: Path
    seed: int

    def key(self, stream: int) -> Key:
        """Return the random key of one use."""
        return jax.random.fold_in(jax.random.key(self.seed), stream)

    @cached_property
    def loop(self) -> ClosedLoop:
        """The system with its law."""
        settings = self.settings
        steady = steady_states(self.tracked, points=settings.points)
        if settings.rate is not None:
            law = derive_law(
                self.tracked,
                steady,
                rate=settings.rate,
                perturbation=settings.perturbation,
            )
            return ClosedLoop(self.tracked, law)
        law, rate = best_law(
            self.tracked,
            steady,
            self.key(0),
            dwell=settings.dwell,
            perturbation=settings.perturbation,
        )
        store.print_message(
            f"the law contracts at {rate:g} a step at the corners of its table"
        )
        return ClosedLoop(self.tracked, law)

    @cached_property
    def spread(self) -> Float[Array, " state"]:
        """Standard deviations of ξ under the law."""
        return spread_of(
            self.loop, self.key(1), steps=SPREAD_STEPS, dwell=self.settings.dwell
        )

    @cached_property
    def dataset(self) -> Dataset:
        """Simulated segments of the loop, without noise of the sensors."""
        draw = partial(
            random_runs,
            self.loop,
            steps=SEGMENT,
            dwell=self.settings.dwell,
            spread=self.spread,
            noisy=False,
        )
        parts: list[Trajectory] = []
        for stream, count in enumerate(PART_SIZES):
            size = max(SMALLEST_PART, round(count * self.settings.segments))
            parts.append(draw(self.key(FIRST_PART + stream), count=size))
        low, high = map(jnp.asarray, self.tracked.system.env_box)
        return Dataset(*parts, env_low=low, env_high=high)

    def identity(self) -> dict[str, Any]:
        """Return what determines the weights, as plain values."""
        probes = np.asarray(_probes(self.tracked, self.key(2)))
        return store.plain(
            {
                **policy.describe_system(self.tracked),
                "settings": vars(self.settings),
                "seed": self.seed,
                # Of a function nothing but its values can be compared.
                "step": [[float(f"{value:.4g}") for value in row] for row in probes],
            }
        )

    def trained(self) -> TrainedSystem:
        """Return the policy of the run; it is trained, or trained on, if missing."""
        file = policy.system_file(self.directory)
        run_directory.claim(self.directory, file, self.identity())
        if not file.is_file():
            self._train(file)
        return policy.restore_system(self.directory)

    def _train(self, file: Path) -> None:
        """Train and write the policy."""
        settings = self.settings
        dataset = self.dataset
        space = measure_space(dataset)
        model_settings = {**MODEL, "rho": LARGEST_RATE - BUDGET, "beta": BUDGET}
        model = policy.system_model(self.tracked, space, model_settings)
        rows = {row for rows in self.tracked.rows.values() for row in rows}
        weights = [TUBE if row in rows else 0.0 for row in range(max(rows) + 1)]
        loss = multi_step_loss(model, space, tube=tuple(weights))
        store.print_message(f"training {settings.steps} steps, in {self.directory}")
        params, _ = fit(
            model,
            loss,
            partial(random_windows, batch=BATCH, length=WINDOW),
            dataset.train,
            spread_windows(dataset.validation, length=WINDOW),
            self.key(3),
            self.directory,
            steps=settings.steps,
            log_every=LOGGED,
        )
        residual = fit_planning(
            model, params, space, dataset.train, self.key(4), steps=settings.steps
        )
        low, high = self.tracked.system.env_box
        policy.save_system(
            file,
            {**params, "planning": residual},
            self.loop.law,
            {
                **self.identity(),
                "model": model_settings,
                "space": space._asdict(),
                "environment": {"low": low, "high": high},
                "controller": self._controller(),
            },
        )

    def _controller(self) -> dict[str, Any]:
        """Return the settings of the planner."""
        states = np.asarray(self.dataset.train.states[..., BODY])
        scales = {
            name: float(np.sqrt(np.mean(states[..., list(rows)] ** 2)))
            for name, rows in self.tracked.rows.items()
        }
        return {
            "samples": self.settings.samples,
            "horizon": self.settings.horizon,
            "effective_samples": 0.1 * self.settings.samples,
            "noise": 0.3,
            "smoothness": 0.02,
            "scales": scales,
        }

    def certificate(self, trained: TrainedSystem) -> SystemCertificate | Refusal:
        """Certify the policy; write and return the certificate."""
        began = time.perf_counter()
        provenance = Provenance(
            policy_sha256=trained.sha256,
            weights_sha256=trained.weights_sha256,
            versions={**store.versions(), "scipy": version("scipy")},
            seconds=0.0,
            settings=store.plain(vars(self.settings)),
        )
        try:
            certificate = self._certify(trained, provenance, began)
        except CertificationRefused as reason:
            certificate = Refusal(reason=str(reason), provenance=provenance)
        write(self.directory / CERTIFICATE, certificate)
        return certificate

    def _certify(
        self, trained: TrainedSystem, provenance: Provenance, began: float
    ) -> SystemCertificate:
        """Prove, and measure on segments and on whole runs."""
        dataset = self.dataset
        boxes = boxes_of(dataset)
        proof = prove(
            trained.model, trained.params, boxes.env, validation=dataset.validation
        )
        if not proof.outputs:
            outputs = ", ".join(self.tracked.rows)
            raise CertificationRefused(
                f"no metric was found in which {outputs} contract: train longer "
                "(tubes.steps), or take a larger tubes.rate"
            )
        proved = time.perf_counter() - began
        measured = measure(
            trained.model,
            trained.params,
            proof,
            validation=dataset.validation,
            calibration=dataset.calibration,
            held_out={"test": dataset.test},
            boxes=boxes,
            level=self.settings.level,
        )
        store.print_message(f"alpha {proof.alpha:.4f}; measuring tubes")
        tubes = measure_tubes(
            # The law as it is stored, around the step of the system.
            ClosedLoop(self.tracked, trained.loop.law),
            trained.model,
            fold(trained.model, trained.params, on_host),
            {name: proof.outputs[name] for name in self.tracked.rows},
            self.key(5),
            spread=self.spread,
            runs=self.settings.runs,
            duration=self.settings.duration,
            dwell=self.settings.dwell,
            level=self.settings.level,
        )
        return SystemCertificate(
            proof=proof,
            measured=measured,
            tubes=tubes,
            provenance=replace(
                provenance,
                seconds=time.perf_counter() - began,
                seconds_proof=proved,
            ),
        )


def certify_system(
    system: System,
    frame: Tracking,
    *,
    root: str | Path,
    seed: NonNegativeInt = 0,
    **settings: Any,
) -> SystemPolicy:
    """Return a policy of a system with its certificate; everything is kept in `root`.

    A law is derived and simulated, a model of the closed loop is learned from the runs
    and proved to contract, and tubes of the outputs are calibrated on whole runs. The
    same call continues what was interrupted.

    Args:
        system: its step, which jax differentiates.
        frame: what it follows, see `tracking` and `regulation`.
        root: directory of the run.
        seed: of everything that is drawn.
        settings: fields of `TubeSettings`.

    Raises:
        ValueError: system, frame or settings do not fit; `systems.NoLaw` if there is no
            law.
        CertificationRefused: the model could not be certified.
        ArtefactError: the directory has a run of another system or other settings.
    """
    parsed = parse(TubeSettings, settings, "tubes.")
    check_settings(parsed, system.dt)
    tracked = Tracked(system, frame)
    system.check_step(tracked.state(jnp.zeros(len(tracked.names)), tracked.middle))
    tracked.check_invariance(jax.random.key(0))
    run = SystemRun(tracked, parsed, Path(root), seed)
    with store.locked(run.directory):
        trained = run.trained()
        path = run.directory / CERTIFICATE
        if path.is_file():
            certificate = read(path, SystemCertificate)
        else:
            certificate = run.certificate(trained)
        if isinstance(certificate, Refusal):
            raise CertificationRefused(certificate.reason)
    return policy.load_system(run.directory)


def _probes(tracked: Tracked, key: Key) -> Float[Array, "place state"]:
    """Return what the step does at a few places."""
    low, high = map(jnp.asarray, tracked.system.control_box)
    bottom, top = map(jnp.asarray, tracked.system.env_box)
    middle = tracked.state(jnp.zeros(len(tracked.names)), tracked.middle)

    def probe(key: Key) -> Array:
        state_key, control_key, env_key = jax.random.split(key, 3)
        state = middle + 0.3 * jax.random.normal(state_key, middle.shape)
        control = jax.random.uniform(control_key, low.shape, minval=low, maxval=high)
        env = jax.random.uniform(env_key, bottom.shape, minval=bottom, maxval=top)
        return tracked.system.step(state, control, env)

    return jax.vmap(probe)(jax.random.split(key, PROBES))
