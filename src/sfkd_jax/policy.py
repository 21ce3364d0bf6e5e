"""Load trained controllers, without Hydra, orbax, convex solvers or matplotlib."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache, partial, wraps
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import build, store
from sfkd_jax.control import PathLaw, behind, law_from_arrays, requesting
from sfkd_jax.geometry import relative, shifted
from sfkd_jax.plants import Vehicle
from sfkd_jax.ranges import in_words
from sfkd_jax.rollout import fold, on_host, unfold
from sfkd_jax.settings import Values
from sfkd_jax.types import Controller, Key, Model, Params

KIND, LAW = "policy", "law"
CERTIFICATE, RECORDED = "certificate.json", "certificate.runs.json"
"""Of a run; and with the corridor of recorded runs, which comes first."""
UNITS = {"p_x": "[m]", "p_y": "[m]", "v": "[m/s]", "v_y": "[m/s]"}
FRICTION_AND_WIND = ["friction [-]", "lateral wind [m/s]"]
UNITS |= {"yaw": "[rad]", "yaw_rate": "[rad/s]", "steering": "[rad]"}
"""Of the states of the vehicles of this package."""


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A model with its weights, as stored in a run directory.

    Attributes:
        model: the learned rollout model.
        params: its weights.
        vehicle: that it was trained for.
        law: that a model in path coordinates was learned around, or None.
        settings: that it was made with, the JSON in its file.
        weights_sha256: hash of the weights.
        sha256: hash of weights and settings, to which certificates refer.
    """

    model: Model
    params: Params
    vehicle: Vehicle
    law: PathLaw | None
    settings: Values
    weights_sha256: str
    sha256: str


@dataclass(frozen=True, eq=False)
class Policy(TrainedModel):
    """A trained controller, as `load` returns it; `params` are folded for it.

    Attributes:
        controller: `Controller(init, act)`, pure; jit, vmap or scan it.
        certificate: the verified document of certificate.json, or None if it is
            missing, refused or stale.
        around: (planner=another along a path) -> controller, see
            `build.build_controller`.
    """

    controller: Controller
    certificate: dict[str, Any] | None
    around: Callable[..., Controller]

    @property
    def interface(self) -> dict[str, Any]:
        """Names, units and limits of controls, observation, e and reference."""
        plant, box = self.vehicle, self.settings["environment"]
        # With a speed loop the second control is what the loop is given.
        second = "speed command [m/s]" if plant.speed_loop else "acceleration [m/s^2]"
        names = ("steering [rad]", second)
        # Those of logs have names of their own.
        boxes = (self.certificate or {}).get("boxes", {})
        columns = boxes.get("names", {}).get("env")
        limits = zip(names, plant.control_low, plant.control_high, strict=True)
        return {
            "sampling_period_s": plant.dt,
            "horizon": build.controller_horizon(self.settings["controller"]),
            "controls": [
                {"name": name, "low": low, "high": high} for name, low, high in limits
            ],
            "observation": list(plant.state_names),
            "environment": {
                "names": columns or box.get("names") or FRICTION_AND_WIND,
                "low": list(box["low"]),
                "high": list(box["high"]),
            },
            "reference": ["x [m]", "y [m]", "yaw [rad]", "speed [m/s]"],
        }

    def __repr__(self) -> str:
        """Say what it drives, where its certificate applies, and what is proved."""
        known, plant = self.interface, self.vehicle
        source = self.settings["environment"]["source"]
        controls = zip(*(one.values() for one in known["controls"]), strict=True)
        states = [f"{name} {UNITS.get(name, '')}".strip() for name in plant.state_names]
        frame = "along a path" if self.model.along_path else "in the world"
        lines = [
            f"Policy of {plant.name} {frame}, a step of {plant.dt:g} s",
            f"states: {', '.join(states)}",
            f"controls: {in_words(*controls)}",
            f"environment, {source}: {in_words(*known['environment'].values())}",
            *self._certified(states[3:], known["environment"]["names"]),
        ]
        return "\n  ".join(lines)

    def _certified(self, names: list[str], env_names: list[str]) -> Iterator[str]:
        """Lines about the certificate: where it applies, and what of it is proved."""
        if not (document := self.certificate):
            yield "no certificate: nothing is proved, nothing measured"
            return
        boxes, corridor = document["boxes"], document.get("corridor")
        low, high = ([*state] for state in boxes["state"])
        if self.model.along_path:
            names = ["e_y [m]", "e_psi [rad]", *names, "curvature [1/m]", "v_ref [m/s]"]
            # After ν, which is the planner's.
            for end, inputs in zip((low, high), boxes["control"], strict=True):
                end += inputs[2:]
        yield f"certified box: {in_words(names, low, high)}"
        yield f"proved: alpha {document['alpha']:.4f}, contraction of the model a step"
        d_bar = document.get("d_bar") or {"value": float("nan")}
        measured = f"measured, not signed: d_bar {d_bar['value']:.3g}"
        if not corridor:
            yield f"{measured}; no corridor"
            return
        share, runs = 100 * corridor["coverage"], corridor["coverage_runs"]
        width = f"{corridor['corridor_m']:.3f} m to each side"
        yield f"{measured}, corridor {width}, kept in {share:.1f} % of {runs} runs"
        under = corridor["conditions"]
        names, bend = ["speed [m/s]", *env_names], under["peak_curvature"]
        ends = zip(under["speed"], under["env_box"], strict=True)
        told = in_words(names, *([speed, *corner] for speed, corner in ends))
        dwell = "{:g} to {:g} s".format(*under["dwell_s"])
        yield f"under: {told}, each for {dwell}; curvature [1/m] {-bend:g} … {bend:g}"
        if made := document.get("recorded"):
            number, width = made["conditions"]["runs"], f"{made['corridor_m']:.3f} m"
            yield f"of {number} runs of the car: {width} at level {made['level']:g}"
        elif not build.is_claimed(document):
            yield "of a model of logs, not of the car, about which nothing is claimed"

    def _with_corridor(self) -> dict[str, Any]:
        """Return the certificate; a ValueError says that it has no corridor."""
        if not (self.certificate and self.certificate.get("corridor")):
            raise ValueError(
                "this policy has no certified corridor to keep a planner in: load one "
                "in path coordinates with its certificate, as pretrained/dynamic_path"
            )
        return self.certificate

    def guard(self, planner: Controller, *, along_path: bool = False) -> Controller:
        """Return any planner behind the shield of this policy, to be called like it.

        Args:
            planner: its `act` receives the params of the policy (bind others with
                `partial`), the observation, e and the reference, and returns a control
                of the vehicle. Entries of its `info` appear in that of the guard.
            along_path: whether it takes ξ and a preview instead of observation and
                reference, see `control.along_reference`.
        """
        self._with_corridor()
        # Its settings are numbers, also where a program is traced when it is built.
        with jax.ensure_compile_time_eval():
            if along_path:
                return _entrance(self.around(planner=planner), self)
            horizon = build.controller_horizon(self.settings["controller"])
            size = len(self.vehicle.state_names) - 1
            guard = self.around(planner=requesting(planner, horizon, size))
        return _entrance(behind(guard), self)

    def in_lane(
        self, *, car: tuple[float, float] = (4.5, 2.0), planner: str = "mppi"
    ) -> Controller:
        """Return a controller that drives in a lane, round obstacles, see `InLane`.

        Its `act` takes (`Lane`, `Obstacles`) in place of the reference.

        Args:
            car: length and width [m]; its middle is the observed position.
            planner: that searches for a reference, "mppi" or "cem".
        """
        certificate, law = self._with_corridor(), self.law
        # A corridor is about path coordinates, and these about a law.
        assert law is not None
        names = self.interface["environment"]["names"]
        friction = [i for i, name in enumerate(names) if name.startswith("friction")]
        with jax.ensure_compile_time_eval():
            controller = build.build_in_lane(
                self.controller,
                self.vehicle,
                law,
                certificate,
                horizon=self.interface["horizon"],
                car=car,
                planner=planner,
                friction=friction[0] if friction else None,
            )
        return Controller(_numerics()(controller.init), _numerics()(controller.act))

    def __reduce__(self) -> Any:
        """Refuse to be pickled; functions of a closure say less clearly why."""
        raise TypeError("a Policy cannot be pickled: sfkd_jax.load it in that process")

    @property
    def weights(self) -> Params:
        """The learned parameters as they were saved, to train on or to save again."""
        return unfold(self.params)


def save(
    path: Path,
    params: Params,
    settings: Values,
    *,
    made_from: Mapping[str, str] | None = None,
    law: PathLaw | None = None,
) -> dict[str, Any]:
    """Write policy.safetensors and return its manifest.

    Args:
        path: of the file.
        params: weights.
        settings: that they were made with.
        made_from: hashes of artefacts, by kind.
        law: that a model in path coordinates was learned around, or None.
    """
    # Beside the weights: the hash that certificates refer to then covers the law.
    tree = params if law is None else params | {LAW: law._asdict()}
    return store.write_arrays(
        path, _by_path(tree), kind=KIND, config=settings, made_from=made_from
    )


@contextmanager
def _numerics() -> Iterator[None]:
    """Numerical settings of a policy, whatever those of the caller are."""
    # A certificate speaks of float32; accelerators would multiply with ten bits.
    precise = jax.default_matmul_precision("float32")
    ranks, types = jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion
    with precise, ranks, types("standard"):
        yield


@_numerics()
def restore(path: str | Path) -> TrainedModel:
    """Return the model and weights in a run directory.

    Args:
        path: of the directory, or of a policy.safetensors.

    Raises:
        ArtefactError: missing, truncated, foreign, changed since it was written, saved
            with settings that this version lacks or weights that do not fit the model;
            or a model of a module that is not imported.
    """
    file = _file(path)
    arrays, manifest = store.read_arrays(file, kind=KIND)
    settings = manifest["config"]
    # Before anything is built: building imports and calls what the settings name.
    with store.as_artefact_error(file, ValueError):
        build.check_imported(settings)
    advice = f"saved by sfkd_jax {manifest['versions'].get('sfkd_jax')}: train again"
    with store.as_artefact_error(file, ValueError, advice=advice):
        vehicle, model = built(settings)
        # Settings of a wrong type fail only here. Weights are float32 in any process.
        with jax.enable_x64(False):
            shapes = jax.eval_shape(model.init, jax.eval_shape(jax.random.key, 0))
        for name, leaf in arrays.items():
            if not np.all(np.isfinite(leaf)):
                raise store.ArtefactError(f"{file}: weights {name} are not finite")
        # What is left without the law are the weights, compared name by name.
        names = [name for name in arrays if name.startswith(f"{LAW}/")]
        tables = {name.removeprefix(f"{LAW}/"): arrays.pop(name) for name in names}
        build.check_consistent(settings, vehicle, tables if model.along_path else None)
        law = law_from_arrays(tables) if model.along_path else None
    return TrainedModel(
        model=model,
        params=_weights(file, arrays, shapes),
        vehicle=vehicle,
        law=law,
        settings=settings,
        weights_sha256=manifest["sha256"],
        sha256=manifest["content_sha256"],
    )


@_numerics()
def load(
    path: str | Path,
    *,
    controller: Mapping[str, Any] | None = None,
    env_source: str = "measured",
    adaptive: bool = False,
) -> Policy:
    """Return the policy in a run directory, with its certificate verified.

    Without a certificate it warns and gives the reason.

    Args:
        path: of the directory, or of a policy.safetensors.
        controller: settings of a controller to build instead of the saved one.
        env_source: one of `build.ENV_SOURCES`. "estimated" for a policy in path
            coordinates that estimates the environment and ignores the one it is given;
            "none" for a policy that reads none.
        adaptive: whether a policy in path coordinates estimates unmeasured forces and
            errors of its inputs while driving, see `control.Adaptation`.

    Raises:
        ArtefactError: as `restore`, or a certificate that does not hold.
        ValueError: `controller` or `env_source` does not fit the policy, or an estimate
            is asked of a policy that is not in path coordinates.
    """
    trained, file = restore(path), _file(path)
    # Here, so that a certificate is checked on the weights that will be multiplied.
    trained = replace(trained, params=fold(trained.model, trained.params, on_host))
    certificate, reason = read_certificate(path, trained)
    with store.as_artefact_error(file):
        reads = trained.settings["model"].get("environment", True)
        box = trained.settings["environment"] | {"source": env_source}
        settings = {**trained.settings, "environment": box}
        settings["controller"] = controller or trained.settings["controller"]
        shielded = settings["controller"].get("shield")
    # Never the same planner without its shield, unless the caller says so.
    if shielded and not (certificate or {}).get("corridor"):
        raise store.ArtefactError(
            f"{file}: controller.shield needs a certified corridor, and "
            f"{reason or 'the certificate has none'}; run certify, or load it with "
            "controller=... and shield=False"
        )
    # What a model reads must come from somewhere; what it does not is not estimated.
    sources = [s for s in build.ENV_SOURCES if s != ("none" if reads else "estimated")]
    if env_source not in sources:
        raise ValueError(
            f"env_source must be {' or '.join(sources)} for a policy that "
            f"{'reads' if reads else 'ignores'} the environment, got {env_source!r}"
        )
    # Errors are about the file, unless the caller asked for something else.
    asked = controller is not None or env_source != "measured" or adaptive
    with nullcontext() if asked else store.as_artefact_error(file, ValueError):
        around = partial(
            build.build_controller,
            settings["controller"],
            trained.model,
            trained.vehicle,
            env_low=box["low"],
            env_high=box["high"],
            env_source=env_source,
            certificate=certificate,
            law=trained.law,
            adaptive=adaptive,
        )
        planner = around()
    if certificate is None:
        # 3: `_numerics` stands between this function and its caller.
        warnings.warn(f"{file}: nothing is certified; {reason}", stacklevel=3)
    return Policy(
        **vars(replace(trained, settings=settings)),
        controller=_entrance(planner, trained),
        certificate=certificate,
        around=around,
    )


def _entrance(controller: Controller, trained: TrainedModel) -> Controller:
    """Return the same controller, with `_numerics` and a check of its arguments.

    Positions in double precision are made relative before anything is float32.
    """
    names = trained.vehicle.state_names
    shape, env_shape = (len(names),), (len(trained.settings["space"]["env_mean"]),)
    # One program, where every array of the state would otherwise be one.
    compiled = jax.jit(controller.init)

    @wraps(controller.init)
    def init(key: Key) -> Any:
        if trained.model.along_path and jax.debug_nans.value:
            raise ValueError(
                "jax_debug_nans: controllers along a path keep NaN for what is not "
                "known yet; switch it off"
            )
        return compiled(key)

    @wraps(controller.act)
    def act(
        params: Params, state: Any, observation: Any, env: Any, reference: Any
    ) -> Any:
        # Broadcasting would accept some, and others fail far from here.
        if jnp.shape(observation) != shape:
            raise ValueError(
                f"observation must have shape {shape}: {', '.join(names)}; "
                f"got {jnp.shape(observation)}"
            )
        if jnp.shape(env) != env_shape:
            raise ValueError(f"env must have shape {env_shape}, got {jnp.shape(env)}")
        near, ahead, origin = relative(observation, reference)
        moved = near is not observation
        control, state, info = controller.act(
            params, state, jnp.asarray(near), env, jnp.asarray(ahead)
        )
        if moved:
            # What is reported is in the world again, on the host in float64.
            states = shifted(info["predicted_states"], origin)
            info = {**info, "predicted_states": states}
        return control, state, info

    return Controller(_numerics()(init), _numerics()(act))


def read_certificate(
    path: str | Path, trained: TrainedModel
) -> tuple[dict[str, Any] | None, str]:
    """Verify the certificate beside a policy, in its run directory.

    Returns:
        The certificate and "", or None and the reason why there is none.

    Raises:
        ArtefactError: it is damaged, or does not follow from its witnesses.
    """
    from sfkd_jax import certification  # loaded only if there is something to verify

    files = [_file(path).with_name(name) for name in (RECORDED, CERTIFICATE)]
    file = next((file for file in files if file.exists()), None)
    if file is None:
        return None, f"{CERTIFICATE} is missing"
    document = store.read_json(file, keys=("valid",))
    if document["valid"] is not True:
        reason = store.one_line(document.get("reason"))
        return None, f"the certificate was refused: {reason}"
    try:
        with store.as_artefact_error(file):
            certification.verify_document(document, trained)
    except certification.CertificateStale as reason:
        return None, f"{reason}; certify again"
    except certification.CertificationRefused as reason:
        raise store.ArtefactError(f"{file}: {reason}") from None
    return document, ""


def built(settings: Values) -> tuple[Vehicle, Model]:
    """Return vehicle and model of settings, the same ones for all who ask."""
    parts = {name: settings[name] for name in ("vehicle", "space", "model")}
    return _build(json.dumps(store.plain(parts), sort_keys=True))


@lru_cache(maxsize=8)
def _build(settings: str) -> tuple[Vehicle, Model]:
    """Build vehicle and model; cached by settings as JSON to compile nothing twice."""
    parts = json.loads(settings)
    plant = build.build_vehicle(parts["vehicle"])
    return plant, build.build_model(
        parts["model"], build.space_from_settings(parts["space"]), plant
    )


def _file(path: str | Path) -> Path:
    """Return policy.safetensors of a run directory, or the file itself."""
    named = Path(path).suffix == store.SUFFIX
    return Path(path) if named else Path(path) / "policy.safetensors"


def _weights(file: Path, arrays: Mapping[str, np.ndarray], shapes: Any) -> Params:
    """Return arrays as parameters of these shapes, or raise an ArtefactError."""
    needed = _by_path(shapes)
    held, fit = (
        {name: f"{leaf.dtype}{list(leaf.shape)}" for name, leaf in leaves.items()}
        for leaves in (arrays, needed)
    )
    # Both ways: a weight too many is another model as well.
    if wrong := sorted(held.items() ^ fit.items()):
        name, _ = wrong[0]
        found, wanted = held.get(name, "missing"), fit.get(name, "none")
        raise store.ArtefactError(
            f"{file}: weights {name} are {found}, the model has {wanted}"
        )
    # In the order of the tree, whatever that of the file is.
    leaves = jax.device_put([arrays[name] for name in needed])
    return jax.tree.unflatten(jax.tree.structure(shapes), leaves)


def _by_path(tree: Any) -> dict[str, Any]:
    """Return the leaves by path, "a/b/c", in the order of the tree."""
    name = partial(jax.tree_util.keystr, simple=True, separator="/")
    return {
        name(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }
