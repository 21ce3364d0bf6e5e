"""A trained controller as other JAX projects import it: no Hydra, no orbax, no solver, no matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import artefacts, assembly
from sfkd_jax.types import Controller, Model, Params

KIND = "policy"


class Policy(NamedTuple):
    """What `load` returns.

    Attributes:
        model, params: the learned rollout model. controller: `Controller(init, act)`, pure; jit, vmap, scan it.
        certificate: the document in certificate.json, or None if it is missing, refused, or about other weights.
        settings: how all of it was made.
    """

    model: Model
    params: Params
    controller: Controller
    certificate: dict[str, Any] | None
    settings: dict[str, Any]


def save(path: Path, params: Params, settings: Mapping[str, Any], *, made_from: Mapping[str, str]) -> dict[str, Any]:
    """Write policy.npz and its manifest; returns the manifest, whose `sha256` names the weights."""
    flat = {name: np.asarray(leaf) for name, leaf in artefacts.flatten(params).items()}
    return artefacts.write_arrays(path, flat, kind=KIND, config=settings, made_from=made_from)


def weights_hash(path: Path) -> str:
    """The hash that names the weights of the policy in a run directory."""
    return artefacts.read_arrays(path / "policy.npz", kind=KIND)[1]["sha256"]


def load(path: str | Path, *, controller: Mapping[str, Any] | None = None, env: str = "measured") -> Policy:
    """The policy in a run directory (or a policy.npz with its manifest beside it).

    Args:
        path: where. controller: settings of a controller to build instead of the one it was saved with.
        env: "estimated" for a controller that infers the environment and does not read the one it is given.

    Raises:
        ArtefactError: nothing there, truncated, foreign, changed since it was written, or saved with settings that
            this version does not have.
    """
    file = Path(path)
    file = file / "policy.npz" if file.suffix != ".npz" else file
    arrays, manifest = artefacts.read_arrays(file, kind=KIND)
    settings = manifest["config"] | {"env": env} | ({} if controller is None else {"controller": dict(controller)})
    certificate = _certificate(file.with_name("certificate.json"), manifest["sha256"])
    try:
        model, planner = _built(settings, certificate)
    except (KeyError, TypeError) as reason:  # a setting that is missing, or that no factory takes any more
        saved = manifest.get("versions", {}).get("sfkd_jax", "unknown")
        raise artefacts.ArtefactError(
            f"{file} has settings of sfkd_jax {saved} that this version does not read ({reason}): train again"
        ) from None
    params = jax.tree.map(jnp.asarray, artefacts.unflatten(arrays))
    return Policy(model, params, planner, certificate, settings)


def _built(settings: Mapping[str, Any], certificate: dict[str, Any] | None) -> tuple[Model, Controller]:
    """The model and the controller that the settings name."""
    plant = assembly.build_vehicle(settings["vehicle"])
    model = assembly.build_model(settings["model"], assembly.space_from_settings(settings["space"]), plant)
    box = settings["dataset"]
    limits = {"env_low": box["env_low"], "env_high": box["env_high"], "certificate": certificate}
    return model, assembly.build_controller(settings["controller"], model, plant, **limits, env=settings["env"])


def _certificate(path: Path, weights: str) -> dict[str, Any] | None:
    """The certificate beside a policy, if it is valid and about these weights."""
    if not path.exists():
        return None
    document = artefacts.read_json(path, keys=("valid", "weights_sha256"))
    return document if document["valid"] and document["weights_sha256"] == weights else None
