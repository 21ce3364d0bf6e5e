"""A trained model in its file: weights, law and settings, saved and restored."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sfkd_jax import assembly, store
from sfkd_jax.driving.path_following import PathLaw, law_from_arrays
from sfkd_jax.driving.plants import Vehicle
from sfkd_jax.policy._files import POLICY_FILE
from sfkd_jax.policy._shipped import SHIPPED, shipped_names
from sfkd_jax.settings import Values
from sfkd_jax.types import Controller, Model, Params

KIND = "policy"
"""The kind of artefact that the manifest of policy.safetensors states."""
LAW = "law"
"""The tables of the law are stored under this name, beside the weights."""


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A model with its weights, as stored in a run directory.

    Attributes:
        model: the learned rollout model.
        params: its weights.
        vehicle: the vehicle that it was trained for.
        law: the law that a model in path coordinates was learned around, or None.
        settings: the settings that it was trained with, as JSON in its file.
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


@contextmanager
def policy_numerics() -> Iterator[None]:
    """Set the numerical settings of a policy, whatever those of the caller are."""
    # A certificate speaks of float32; accelerators would multiply with ten bits.
    precise_products = jax.default_matmul_precision("float32")
    usual_ranks = jax.numpy_rank_promotion("allow")
    usual_types = jax.numpy_dtype_promotion("standard")
    with precise_products, usual_ranks, usual_types:
        yield


def in_policy_numerics(controller: Controller) -> Controller:
    """Return the same controller, which sets the numerics of a policy for itself."""
    return Controller(
        init=policy_numerics()(controller.init),
        act=policy_numerics()(controller.act),
    )


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
        path: path of the file.
        params: the weights.
        settings: the settings that they were trained with.
        made_from: hashes of the artefacts that they were trained from, by kind.
        law: the law that a model in path coordinates was learned around, or None.
    """
    tree = params
    if law is not None:
        # Beside the weights: the hash that certificates refer to then covers the law.
        tree = {**params, LAW: law._asdict()}
    return store.write_arrays(
        path, arrays_of(tree), kind=KIND, config=settings, made_from=made_from
    )


@policy_numerics()
def restore(path: str | Path) -> TrainedModel:
    """Return the model and weights in a run directory.

    Args:
        path: path of the directory or of a policy.safetensors, or the name of a policy
            that ships, see `policies`.

    Raises:
        ArtefactError: the file is missing, truncated, foreign or changed since it was
            written; or it was saved with settings that this version lacks or weights
            that do not fit the model; or its model is of a module that is not imported.
    """
    file = policy_file(path)
    arrays, manifest = store.read_arrays(file, kind=KIND)
    settings = manifest["config"]
    # Before anything is built: building imports and calls what the settings name.
    with store.as_artefact_error(file, ValueError):
        assembly.check_imported(settings)
    advice = f"saved by sfkd_jax {manifest['versions'].get('sfkd_jax')}: train again"
    with store.as_artefact_error(file, ValueError, advice=advice):
        vehicle, model = built(settings)
        # Settings of a wrong type fail only here. Weights are float32 in any process.
        with jax.enable_x64(False):
            key = jax.eval_shape(jax.random.key, 0)
            shapes = jax.eval_shape(model.init, key)
        for name, leaf in arrays.items():
            if not np.all(np.isfinite(leaf)):
                raise store.ArtefactError(f"{file}: weights {name} are not finite")
        tables = _take_law(arrays)
        assembly.check_consistent(
            settings, vehicle, tables if model.frame.inputs else None
        )
        law = law_from_arrays(tables) if model.frame.inputs else None
    return TrainedModel(
        model=model,
        params=params_from_arrays(file, arrays, shapes),
        vehicle=vehicle,
        law=law,
        settings=settings,
        weights_sha256=manifest["sha256"],
        sha256=manifest["content_sha256"],
    )


def _take_law(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Remove the tables of the law from the arrays of a policy, and return them.

    The arrays that stay are the weights, which are then compared with the model's.
    """
    prefix = f"{LAW}/"
    names = [name for name in arrays if name.startswith(prefix)]
    return {name.removeprefix(prefix): arrays.pop(name) for name in names}


def built(settings: Values) -> tuple[Vehicle, Model]:
    """Return vehicle and model of settings; equal settings give the same objects."""
    parts = {name: settings[name] for name in ("vehicle", "space", "model")}
    return _built_from_json(json.dumps(store.plain(parts), sort_keys=True))


@lru_cache(maxsize=8)
def _built_from_json(settings: str) -> tuple[Vehicle, Model]:
    """Build vehicle and model; cached by settings as JSON to compile nothing twice."""
    parts = json.loads(settings)
    vehicle = assembly.build_vehicle(parts["vehicle"])
    space = assembly.space_from_settings(parts["space"])
    return vehicle, assembly.build_model(parts["model"], space, vehicle)


def policy_file(path: str | Path) -> Path:
    """Return the policy.safetensors that a path or the name of a shipped policy means.

    Args:
        path: of a run directory, of the file itself, or a name of `policies`. A path
            that exists comes before a name.

    Raises:
        ArtefactError: a single word that is neither.
    """
    file = Path(path)
    if file.suffix == store.SUFFIX:
        return file
    # "./name" is a path; "name" may be either.
    is_a_word = str(path) == file.name
    if is_a_word and not file.exists():
        shipped = shipped_names()
        if file.name not in shipped:
            raise store.ArtefactError(
                f"{path}: no such run directory, and no policy of this name ships with "
                f"the package; there are {', '.join(shipped)}"
            )
        file = SHIPPED / file.name
    return file / POLICY_FILE


def params_from_arrays(
    file: Path, arrays: Mapping[str, np.ndarray], shapes: Any
) -> Params:
    """Return arrays as parameters of these shapes, or raise an ArtefactError."""
    leaves = arrays_of(shapes)
    stored = _dtypes_and_shapes(arrays)
    expected = _dtypes_and_shapes(leaves)
    # Both ways: a weight too many is another model as well.
    differences = sorted(stored.items() ^ expected.items())
    if differences:
        name, _ = differences[0]
        raise store.ArtefactError(
            f"{file}: weights {name} are {stored.get(name, 'missing')}, "
            f"the model has {expected.get(name, 'none')}"
        )
    # In the order of the tree, whatever that of the file is.
    on_device = jax.device_put([arrays[name] for name in leaves])
    return jax.tree.unflatten(jax.tree.structure(shapes), on_device)


def _dtypes_and_shapes(leaves: Mapping[str, Any]) -> dict[str, str]:
    """Return dtype and shape of arrays by name, as in "float32[3, 4]"."""
    return {name: f"{leaf.dtype}{list(leaf.shape)}" for name, leaf in leaves.items()}


def arrays_of(tree: Any) -> dict[str, Any]:
    """Return the leaves by path, "a/b/c", in the order of the tree."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }
