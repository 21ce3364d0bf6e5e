"""Policies of systems: saved, restored, and loaded with their certificate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import certificate as certificates
from sfkd_jax import control, models, store
from sfkd_jax.certificate import Refusal
from sfkd_jax.policy._certificate import SavedHashes, save_certificate
from sfkd_jax.policy._description import describe_controlled
from sfkd_jax.policy._files import CERTIFICATE, SYSTEM_FILE
from sfkd_jax.policy._hub import Shareable
from sfkd_jax.policy._trained import (
    LAW,
    arrays_of,
    in_policy_numerics,
    params_from_arrays,
    policy_numerics,
)
from sfkd_jax.rollout import fold, on_host, unfold
from sfkd_jax.settings import Values
from sfkd_jax.systems import (
    ClosedLoop,
    Following,
    Law,
    OutputBound,
    Shield,
    System,
    SystemCertificate,
    Tracked,
    Tracking,
    tracking_task,
)
from sfkd_jax.types import Control, Controller, Environment, Model, Params, Space, State

SYSTEM_KIND = "system"
"""The kind of artefact that its manifest states."""


@dataclass(frozen=True, eq=False)
class TrainedSystem:
    """A model of a closed loop with its weights, as stored in a run directory.

    Attributes:
        model: the certified model.
        params: its weights.
        loop: the closed loop that it is a model of; the system has no step.
        settings: with which it was made, as JSON in its file.
        weights_sha256: hash of the weights.
        sha256: hash of weights and settings, to which certificates refer.
    """

    model: Model
    params: Params
    loop: ClosedLoop
    settings: Values
    weights_sha256: str
    sha256: str


@dataclass(frozen=True, eq=False)
class SystemPolicy(TrainedSystem, Shareable):
    """A controller of a system with its certificate, as `load` returns it.

    Attributes:
        controller: `Controller(init, act)`, pure; jit, vmap or scan it. Its reference
            has the states of `reference_names`, one row now and one at each of the next
            `horizon` sampling times.
        certificate: the verified certificate.
    """

    controller: Controller
    certificate: SystemCertificate

    @property
    def horizon(self) -> int:
        """Number of steps that a plan has."""
        return self.settings["controller"]["horizon"]

    @property
    def reference_names(self) -> tuple[str, ...]:
        """Names of the states that a reference has."""
        return self.loop.tracked.frame.followed

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs, in the order of `info.claim.bound`."""
        return tuple(self.loop.tracked.rows)

    @property
    def reference_shape(self) -> tuple[int, int]:
        """Shape of the reference that `act` takes: a row now and at the next steps."""
        return self.horizon + 1, len(self.reference_names)

    @property
    def weights(self) -> Params:
        """The learned parameters as they were saved, to train on or to save again."""
        return unfold(self.params)

    @property
    def interface(self) -> dict[str, Any]:
        """Names, units and limits of controls, observation, e, reference and outputs.

        "operating_point" has the reference in the middle of its ranges, and the state
        there.
        """
        tracked = self.loop.tracked
        system = tracked.system
        labels = [state.label for state in system.state_variables]
        low, high = system.env_box
        middle = np.asarray(tracked.middle)
        at_rest = tracked.state(jnp.zeros(len(labels)), tracked.middle)
        return {
            "sampling_period_s": system.dt,
            "horizon": self.horizon,
            "controls": [
                {"name": name, "low": ends[0], "high": ends[1]}
                for name, ends in system.controls.items()
            ],
            "observation": labels,
            "environment": {
                "names": list(system.environment),
                "low": list(low),
                "high": list(high),
            },
            "reference": [labels[index] for index in tracked.followed],
            "outputs": self.model.frame.units,
            "operating_point": {
                "observation": np.asarray(at_rest).tolist(),
                "reference": middle.tolist(),
            },
        }

    def save(self, folder: Path) -> SavedHashes:
        """Write the policy and its certificate, for `load`."""
        path = system_file(folder)
        law = self.loop.law
        manifest = save_system(path, self.weights, law, self.settings)
        return save_certificate(folder, manifest, self.certificate)

    def shield(self, planner: Controller) -> Controller:
        """Return any planner behind the shield of this policy, to be called like it.

        Args:
            planner: its `act` takes the params of the policy, ξ, e and ρ (horizon,
                inputs), and returns a control of the system.
        """
        return in_policy_numerics(shielded(self, self.certificate, planner))

    def __repr__(self) -> str:
        """Say what is controlled, what is certified, and where."""
        return describe_controlled(self.loop.tracked, self.certificate)


def describe_system(tracked: Tracked) -> dict[str, Any]:
    """Return a system and its frame as plain values, for `restore_system`."""
    system = tracked.system
    frame = tracked.frame
    return {
        "system": {
            "name": system.name,
            "dt": system.dt,
            "states": dict(system.states),
            "controls": {name: list(ends) for name, ends in system.controls.items()},
            "environment": {
                name: list(ends) for name, ends in system.environment.items()
            },
        },
        "frame": {
            "outputs": {name: list(states) for name, states in frame.outputs.items()},
            # JSON has no keys of several words.
            "reference": [
                [list(chain), list(ends)] for chain, ends in frame.reference.items()
            ],
            "ranges": {name: list(ends) for name, ends in frame.ranges.items()},
            "dwell": list(frame.dwell),
            "held": list(frame.held),
            "course": list(frame.course),
        },
    }


def system_model(tracked: Tracked, space: Space, settings: Values) -> Model:
    """Return the model of a closed loop from its settings, as JSON has them."""
    given: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in settings.items()
    }
    return models.sfkd(space, frame=tracked.model_frame, **given)


def system_file(path: str | Path) -> Path:
    """Return the file of the policy in the run directory of a system."""
    return Path(path) / SYSTEM_FILE


def is_system(path: str | Path) -> bool:
    """Return whether a path is the run directory of a system."""
    return system_file(path).is_file()


def save_system(
    path: Path, params: Params, law: Law, settings: Values
) -> dict[str, Any]:
    """Write the policy of a system, and return its manifest."""
    arrays = arrays_of({**params, LAW: law._asdict()})
    return store.write_arrays(path, arrays, kind=SYSTEM_KIND, config=settings)


@policy_numerics()
def restore_system(path: str | Path) -> TrainedSystem:
    """Return the model and weights in the run directory of a system.

    Raises:
        ArtefactError: the file is missing, damaged, foreign, was changed since it was
            written, or does not fit its settings.
    """
    file = system_file(path)
    arrays, manifest = store.read_arrays(file, kind=SYSTEM_KIND)
    settings = manifest["config"]
    with store.as_artefact_error(file, ValueError, TypeError, KeyError):
        tracked = _tracked_from(settings)
        space = Space(*(jnp.asarray(settings["space"][name]) for name in Space._fields))
        model = system_model(tracked, space, settings["model"])
        prefix = f"{LAW}/"
        tables = {
            name: jnp.asarray(arrays.pop(prefix + name), jnp.float32)
            for name in Law._fields
        }
        law = Law(**tables)
        _check_law(tracked, law)
        with jax.enable_x64(False):
            shapes = jax.eval_shape(model.init, jax.eval_shape(jax.random.key, 0))
    return TrainedSystem(
        model=model,
        params=params_from_arrays(file, arrays, shapes),
        loop=ClosedLoop(tracked, law),
        settings=settings,
        weights_sha256=manifest["sha256"],
        sha256=manifest["content_sha256"],
    )


@policy_numerics()
def load_system(path: str | Path) -> SystemPolicy:
    """Return the policy in the run directory of a system, its certificate verified.

    Raises:
        ArtefactError: see `restore_system`; or the certificate is missing, refused or
            does not hold.
    """
    from sfkd_jax import certification, tubes  # loaded only to verify

    trained = restore_system(path)
    trained = replace(trained, params=fold(trained.model, trained.params, on_host))
    file = Path(path) / CERTIFICATE
    certificate = certificates.read(file, SystemCertificate)
    if isinstance(certificate, Refusal):
        raise store.failure(file, f"was refused: {certificate.reason}")
    try:
        with store.as_artefact_error(file):
            tubes.verify_system(certificate, trained)
    except certification.CertificateStale as reason:
        raise store.failure(file, f"{reason}: certify again") from None
    except certification.CertificationRefused as reason:
        raise store.failure(file, reason) from None
    planner = planner_of(trained, trained.model.predicting)
    return SystemPolicy(
        **vars(trained),
        controller=in_policy_numerics(shielded(trained, certificate, planner)),
        certificate=certificate,
    )


def planner_of(trained: TrainedSystem, model: Model) -> Controller:
    """Return the planner of a policy around its law, with any model of the loop.

    Its `act` takes ξ and ρ in place of observation and reference.
    """
    settings = trained.settings["controller"]
    scales = settings["scales"]
    task = tracking_task(
        trained.loop, model, scales=scales, smoothness=settings["smoothness"]
    )
    noise = settings["noise"] * np.asarray(trained.loop.law.perturbation)
    return control.mppi(
        task,
        horizon=settings["horizon"],
        num_samples=settings["samples"],
        effective_samples=settings["effective_samples"],
        noise_std=tuple(noise.tolist()),
        shrinkage=True,
    )


def shielded(
    trained: TrainedSystem, certificate: SystemCertificate, planner: Controller
) -> Controller:
    """Return a planner behind the shield of a policy, in the states of the system."""
    bounds = {
        name: OutputBound(tube=bound.tube, nominal=bound.nominal)
        for name, bound in certificate.tubes.outputs.items()
    }
    tracked = trained.loop.tracked
    shield = Shield(
        inner=planner,
        loop=trained.loop,
        model=trained.model,
        bounds={name: bounds[name] for name in tracked.rows},
        box=certificate.measured.boxes.state,
    )
    return Following(inner=shield.controller(), tracked=tracked).controller()


def _tracked_from(settings: Values) -> Tracked:
    """Return the system and the frame of `describe_system`."""
    system = settings["system"]
    frame = settings["frame"]

    def ranges(entries: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
        return {
            name: (float(low), float(high)) for name, (low, high) in entries.items()
        }

    return Tracked(
        System(
            _no_step,
            dt=system["dt"],
            states=system["states"],
            controls=ranges(system["controls"]),
            environment=ranges(system["environment"]),
            name=system["name"],
        ),
        Tracking(
            {name: tuple(states) for name, states in frame["outputs"].items()},
            reference={
                tuple(chain): (float(low), float(high))
                for chain, (low, high) in frame["reference"]
            },
            ranges=ranges(frame["ranges"]),
            dwell=tuple(frame["dwell"]),
            held=tuple(frame["held"]),
            course=tuple(frame.get("course", ())),
        ),
    )


def _check_law(tracked: Tracked, law: Law) -> None:
    """Raise a ValueError if the tables of a law are not those of this system."""
    axes = len(tracked.frame.input_names) + len(tracked.system.environment)
    states = len(tracked.names)
    controls = len(tracked.system.controls)
    grid = law.control.shape[:-1]
    fits = (
        law.low.shape == law.high.shape == (axes,)
        and len(grid) == axes
        and law.perturbation.shape == (controls,)
        and law.state.shape == (*grid, states)
        and law.control.shape == (*grid, controls)
        and law.gain.shape == (*grid, controls, states)
        and all(bool(jnp.all(jnp.isfinite(table))) for table in law)
    )
    if not fits:
        raise ValueError("the tables of the law are not those of this system")


def _no_step(state: State, control: Control, env: Environment) -> State:
    """Refuse to simulate a system of which a file has the description alone."""
    raise ValueError("a loaded policy has no step of its system: pass your own")
