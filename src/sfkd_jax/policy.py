"""A trained controller as other JAX projects import it: no Hydra, no orbax, no convex solver, no matplotlib."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import artefacts, build
from sfkd_jax.control import PathLaw, law_from_arrays, law_to_arrays
from sfkd_jax.core.folding import fold, unfold
from sfkd_jax.types import Controller, Model, Params
from sfkd_jax.vehicle import Vehicle

KIND, LAW = "policy", "law"
CERTIFICATE = "certificate.json"
BOXES = {"state": "body", "control": "control", "env": "env"}
"""Box of a certificate -> scales of the model of the same size."""


class TrainedModel(NamedTuple):
    """A model with its weights, as they lie in a run directory.

    Attributes:
        model, params: the learned rollout model.
        vehicle: that it was trained for.
        settings: how all of it was made.
        weights_sha256: of the weights alone.
        sha256: of them and of every setting; a certificate is about this one.
        version: of the package that saved it.
        law: of a model in path coordinates, the one it was learned around.
    """

    model: Model
    params: Params
    vehicle: Vehicle
    settings: dict[str, Any]
    weights_sha256: str
    sha256: str
    version: str
    law: PathLaw | None = None


class Policy(NamedTuple):
    """What `load` returns.

    Attributes:
        model, params: the learned rollout model.
        controller: `Controller(init, act)`, pure; jit, vmap, scan it.
        certificate: the document in certificate.json, verified, or None if it is
            missing, refused or stale.
        settings: how all of it was made.
        law: of a model in path coordinates, the one it was learned around.
    """

    model: Model
    params: Params
    controller: Controller
    certificate: dict[str, Any] | None
    settings: dict[str, Any]
    law: PathLaw | None = None

    @property
    def weights(self) -> Params:
        """The learned parameters as they were saved, to train on or to save again."""
        return unfold(self.params)


def save(
    path: Path,
    params: Params,
    settings: Mapping[str, Any],
    *,
    made_from: Mapping[str, str],
    law: PathLaw | None = None,
) -> dict[str, Any]:
    """Write policy.npz and its manifest; returns the manifest, whose `sha256` names the weights and the law."""
    tree = params if law is None else params | {LAW: law_to_arrays(law)}
    flat = {name: np.asarray(leaf) for name, leaf in artefacts.flatten(tree).items()}
    return artefacts.write_arrays(
        path, flat, kind=KIND, config=settings, made_from=made_from
    )


def policy_hash(manifest: Mapping[str, Any]) -> str:
    """The hash of all that a policy computes with: its weights, and every setting of vehicle, model and controller."""
    return artefacts.sha256(
        {"weights": manifest["sha256"], "settings": manifest["config"]}
    )


def restore(path: str | Path) -> TrainedModel:
    """The model and weights in a run directory (or a policy.npz with its manifest beside it).

    Raises:
        ArtefactError: nothing there, truncated, foreign, changed since it was written,
            saved with settings that this version does not have, or weights that are not
            finite or do not fit the model.
    """
    file = _file(path)
    arrays, manifest = artefacts.read_arrays(file, kind=KIND)
    settings = manifest["config"]
    version = _version(manifest)
    with artefacts.as_artefact_error(
        file.with_suffix(".json"), ValueError, advice=_advice(version)
    ):
        plant, model = _built(
            json.dumps({name: settings[name] for name in ("vehicle", "space", "model")})
        )
    mine = {
        name: leaf for name, leaf in arrays.items() if not name.startswith(f"{LAW}/")
    }
    law = (
        _law(file, {name: leaf for name, leaf in arrays.items() if name not in mine})
        if model.along_path
        else None
    )
    params = _weights(file, mine if model.along_path else arrays, model)
    return TrainedModel(
        model,
        params,
        plant,
        settings,
        manifest["sha256"],
        policy_hash(manifest),
        version,
        law,
    )


def load(
    path: str | Path,
    *,
    controller: Mapping[str, Any] | None = None,
    env_source: str = "measured",
) -> Policy:
    """The policy in a run directory (or a policy.npz with its manifest beside it), its certificate verified.

    Where nothing is certified, a warning says why; where `controller.monitor.fallback`
    needs it, that is an error.

    Args:
        path: where.
        controller: settings of a controller to build instead of the one it was saved
            with.
        env_source: "estimated" for a controller that infers the environment and does not read
            the one it is given.

    Raises:
        ArtefactError: as `restore`; a certificate that does not hold; none where a
            fallback asks for one.
    """
    trained = restore(path)
    file = _file(path)
    certificate, reason = read_certificate(path, trained)
    settings: dict[str, Any] = trained.settings | {"env_source": env_source}
    blamed: tuple[type[Exception], ...] = (ValueError,)
    if controller is not None:
        settings, blamed = settings | {"controller": dict(controller)}, ()
    with artefacts.as_artefact_error(
        file.with_suffix(".json"), *blamed, advice=_advice(trained.version)
    ):
        asked, box = settings["controller"], settings["dataset"]
        fallback = asked.get("monitor", {}).get("fallback", "none")
        limits = {
            "env_low": box["env_low"],
            "env_high": box["env_high"],
            "env_source": env_source,
            "certificate": certificate,
        }
        limits["law"] = trained.law
        planner = build.build_controller(
            asked, trained.model, trained.vehicle, **limits
        )
    if certificate is None and fallback != "none":
        raise artefacts.ArtefactError(
            f"{file}: controller.monitor.fallback={fallback} needs a certificate; {reason}"
        )
    if certificate is None:
        warnings.warn(
            f"{file}: nothing is certified and nothing is monitored; {reason}",
            stacklevel=2,
        )
    params = jax.jit(fold, static_argnums=0)(trained.model, trained.params)
    return Policy(trained.model, params, planner, certificate, settings, trained.law)


def read_certificate(
    path: str | Path, trained: TrainedModel
) -> tuple[dict[str, Any] | None, str]:
    """The verified certificate beside a policy, or None and the reason why there is none.

    Raises:
        ArtefactError: it is damaged, or does not follow from its witnesses.
    """
    from sfkd_jax import (
        certification,
    )  # what it needs is loaded only where something is to be verified

    file = _file(path).with_name(CERTIFICATE)
    if not file.exists():
        return None, f"{CERTIFICATE} is missing"
    document = artefacts.read_json(file, keys=("valid",))
    if document["valid"] is not True:
        return None, f"the certificate was refused: {document.get('reason')}"
    try:
        with artefacts.as_artefact_error(file):
            bound = {"model": trained.model, "policy_sha256": trained.sha256}
            certification.verify_document(document, trained.params, **bound)
    except certification.CertificateStale as reason:
        return None, f"{reason}; certify again"
    except certification.CertificationRefused as reason:
        raise artefacts.ArtefactError(f"{file}: {reason}") from None
    sizes = {
        name: len(trained.settings["space"][f"{part}_mean"])
        for name, part in BOXES.items()
    }
    if wrong := [
        name for name, size in sizes.items() if len(document["boxes"][name][0]) != size
    ]:
        raise artefacts.ArtefactError(
            f"{file}: boxes.{wrong[0]} is of another size than the model"
        )
    return document, ""


@lru_cache(maxsize=8)
def _built(settings: str) -> tuple[Vehicle, Model]:
    """The vehicle and the model of settings as JSON; the same objects again, so that nothing is compiled twice."""
    asked = json.loads(settings)
    plant = build.build_vehicle(asked["vehicle"])
    return plant, build.build_model(
        asked["model"], build.space_from_settings(asked["space"]), plant
    )


def _file(path: str | Path) -> Path:
    """policy.npz of a run directory, or the file itself."""
    return Path(path) if Path(path).suffix == ".npz" else Path(path) / "policy.npz"


def _version(manifest: Mapping[str, Any]) -> str:
    versions = manifest.get("versions")
    return (
        str(versions.get("sfkd_jax", "unknown"))
        if isinstance(versions, Mapping)
        else "unknown"
    )


def _advice(version: str) -> str:
    return f"saved by sfkd_jax {version}: train again"


def _law(file: Path, arrays: Mapping[str, np.ndarray]) -> PathLaw:
    """Arrays as the law that a model in path coordinates was learned around.

    Raises:
        ArtefactError: some are missing, of another shape, or not finite.
    """
    if not all(np.all(np.isfinite(leaf)) for leaf in arrays.values()):
        raise artefacts.ArtefactError(f"{file}: the law's arrays are not finite")
    with artefacts.as_artefact_error(file, ValueError):
        return law_from_arrays(artefacts.unflatten(arrays)[LAW])


def _weights(file: Path, arrays: Mapping[str, np.ndarray], model: Model) -> Params:
    """Arrays as the parameters of a model.

    Raises:
        ArtefactError: a name, shape or kind that the model does not have, or a number
            that is not finite.
    """
    with artefacts.as_artefact_error(file, ValueError):
        params = artefacts.unflatten(arrays)
        expected = _listed(
            jax.eval_shape(model.init, jax.random.key(0))
        )  # settings of another kind fail only here
    found = _listed(params)
    if wrong := sorted(expected.keys() ^ found.keys()):
        verb = "lacks" if wrong[0] in expected else "holds"
        raise artefacts.ArtefactError(
            f"{file}: {verb} weights {wrong[0]}, which does not fit the model"
        )
    for name, leaf in found.items():
        if (leaf.shape, leaf.dtype) != (expected[name].shape, expected[name].dtype):
            wanted = f"{expected[name].dtype}{list(expected[name].shape)}"
            raise artefacts.ArtefactError(
                f"{file}: weights {name} are {leaf.dtype}{list(leaf.shape)}, not {wanted}"
            )
        if not np.all(np.isfinite(leaf)):
            raise artefacts.ArtefactError(f"{file}: weights {name} are not finite")
    return jax.tree.map(jnp.asarray, params)


def _listed(tree: Any) -> dict[str, Any]:
    """Leaves by their path."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {
        "/".join(str(getattr(key, "key", key)) for key in path): leaf
        for path, leaf in leaves
    }
