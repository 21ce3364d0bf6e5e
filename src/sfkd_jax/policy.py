"""A trained controller as other JAX projects import it: no Hydra, no orbax, no solver, no matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import artefacts, assembly
from sfkd_jax.control import PathLaw, law_arrays, law_from_arrays
from sfkd_jax.types import Controller, Model, Params, Space

KIND, LAW = "policy", "law"


class Policy(NamedTuple):
    """What `load` returns.

    Attributes:
        model, params: the learned rollout model. controller: `Controller(init, act)`, pure; jit, vmap, scan it.
        certificate: the document in certificate.json, or None if it is missing, refused, or about other weights.
        settings: how all of it was made. law: of a model in path coordinates, the one it was learned around.
    """

    model: Model
    params: Params
    controller: Controller
    certificate: dict[str, Any] | None
    settings: dict[str, Any]
    law: PathLaw | None = None


def save(
    path: Path,
    params: Params,
    settings: Mapping[str, Any],
    *,
    made_from: Mapping[str, str],
    law: PathLaw | None = None,
) -> dict[str, Any]:
    """Write policy.npz and its manifest; returns the manifest, whose `sha256` names the weights and the law."""
    tree = params if law is None else params | {LAW: law_arrays(law)}
    flat = {name: np.asarray(leaf) for name, leaf in artefacts.flatten(tree).items()}
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
    manifest_file, blamed = file.with_suffix(".json"), () if controller else (ValueError,)
    saved = f"saved by sfkd_jax {manifest.get('versions', {}).get('sfkd_jax', 'unknown')}: train again"
    with artefacts.understood(manifest_file, ValueError, advice=saved):
        plant = assembly.build_vehicle(settings["vehicle"])
        space = assembly.space_from_settings(settings["space"])
        model, box = assembly.build_model(settings["model"], space, plant), settings["dataset"]
        limits = {"env_low": box["env_low"], "env_high": box["env_high"], "env": env}
    certificate = _certificate(file.with_name("certificate.json"), manifest["sha256"], space)
    params = jax.tree.map(jnp.asarray, artefacts.unflatten(arrays))
    with artefacts.understood(manifest_file, KeyError, advice=saved):
        limits["law"] = law_from_arrays(params.pop(LAW)) if model.along_path else None
    with artefacts.understood(manifest_file, *blamed, advice=saved):
        planner = assembly.build_controller(settings["controller"], model, plant, certificate=certificate, **limits)
    return Policy(model, params, planner, certificate, settings, limits["law"])


def _certificate(path: Path, weights: str, space: Space) -> dict[str, Any] | None:
    """The certificate beside a policy, if it is valid and about these weights.

    Raises:
        ArtefactError: it holds no boxes and bounds that a monitor could use.
    """
    if not path.exists():
        return None
    document = artefacts.read_json(path, keys=("valid", "weights_sha256"))
    if not document["valid"] or document["weights_sha256"] != weights:
        return None
    sizes = {"state": space.body_mean.size, "control": space.control_mean.size, "env": space.env_mean.size}
    with artefacts.understood(path):
        corners = {name: _numbers(document["boxes"][name], (2, size)) for name, size in sizes.items()}
        sound = all(corners.values()) and _numbers(document["monitor"]["bounds"], (4,))
        sound = sound and _numbers(document["tube"]["latent"], None) and _numbers(document["d_bar"]["value"], ())
    if not sound or not _numbers(document.get("alpha"), ()):
        raise artefacts.ArtefactError(f"{path}: malformed, its boxes, bounds or tube are no numbers for this model")
    return document


def _numbers(values: Any, shape: tuple[int, ...] | None) -> bool:
    """Whether a part of a document is finite numbers, of one shape."""
    try:
        array = np.asarray(values)
    except ValueError:  # lists of different lengths
        return False
    numbers = array.dtype.kind in "if" and bool(np.isfinite(array).all())
    return numbers and (shape is None or array.shape == shape)
