"""An artefact: arrays in `name.npz` and their manifest in `name.json`.

A writer that is killed, whenever that is, leaves the old pair or the new one readable. Both files are completed under
hidden names; the arrays then wait under a name made of their hash, replacing the manifest commits, and only then do the
arrays take their place. A manifest whose arrays still wait is read from there, and the next writer moves them.
"""

from __future__ import annotations

import io
import json
import os
import re
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from sfkd_jax.artefacts._content import differences, plain, sha256, versions
from sfkd_jax.artefacts._files import ArtefactError, encode, failure, read_bytes, read_json, replacement, synchronise

FORMAT = 1
"""Version of the manifest; a reader refuses every other one."""
PORTABLE = "biufcSUmM"
"""Kinds of dtype that an .npz file gives back as they were."""


def write_arrays(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    *,
    kind: str,
    config: Mapping[str, Any],
    made_from: Mapping[str, str] | None = None,
    compressed: bool = False,
) -> dict[str, Any]:
    """Write `path` and its manifest, which is returned; `made_from` holds the hashes of what the arrays were made from.

    Raises:
        ArtefactError: the disk is full or not writable (an earlier pair stays as it was), `path` does not end in .npz,
            a dtype has no portable form (objects, bfloat16), or `config` is not JSON.
    """
    if path.suffix != ".npz":
        raise failure(path, "not written, the name must end in .npz")
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    if odd := [name for name, array in arrays.items() if array.dtype.kind not in PORTABLE]:
        raise failure(path, f"not written, {odd[0]} is of dtype {arrays[odd[0]].dtype}, which is not portable")
    digest, manifest_path = sha256(arrays), path.with_suffix(".json")
    manifest = {"kind": kind, "format": FORMAT, "sha256": digest, "config": config, "made_from": made_from or {}}
    manifest |= {"versions": versions(), "created": datetime.now(UTC).isoformat(timespec="seconds")}
    text = encode(path, manifest, indent=2)
    _complete(path)
    with replacement(manifest_path) as (manifest_file, manifest_part), replacement(path) as (file, part):
        _save(file, arrays, zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED)
        manifest_file.write(text)
        for written in (file, manifest_file):
            synchronise(written)
        os.replace(part, _waiting(path, digest))
        try:
            os.replace(manifest_part, manifest_path)
        except OSError:
            _waiting(path, digest).unlink(missing_ok=True)
            raise
        with suppress(FileNotFoundError):  # another writer has completed this
            os.replace(_waiting(path, digest), path)
    return json.loads(text)


def read_arrays(
    path: Path, *, kind: str, config: Mapping[str, Any] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays of `path` and their manifest; nothing pickled is ever loaded.

    Raises:
        ArtefactError: either file is missing, truncated, damaged or foreign; the artefact is of another kind or format,
            was made with other settings than `config`, or its arrays are not those that the manifest is about.
    """
    manifest = _manifest(path, kind)
    if config is not None and (found := differences(manifest["config"], plain(config))):
        more = f" and {len(found) - 3} more" if len(found) > 3 else ""
        raise failure(path, f"made with other settings: {'; '.join(found[:3])}{more}")
    arrays = _load(path, manifest["sha256"])
    actual = sha256(arrays)
    if actual == manifest["sha256"]:
        return arrays, manifest
    if _manifest(path, kind)["sha256"] != manifest["sha256"]:  # rewritten while it was being read
        return read_arrays(path, kind=kind, config=config)
    raise failure(path, f"does not match its manifest: sha256 {actual[:12]}, recorded {manifest['sha256'][:12]}")


def exists(path: Path) -> bool:
    """Whether both files of an artefact are there."""
    return path.is_file() and path.with_suffix(".json").is_file()


def _waiting(path: Path, digest: str) -> Path:
    """Where complete arrays wait for their manifest to be committed."""
    return path.with_name(f".{path.name}.{digest[:16]}.part")


def _complete(path: Path) -> None:
    """Move the arrays that a writer killed after its commit left waiting."""
    with suppress(ArtefactError, OSError, TypeError, ValueError):  # a damaged manifest commits nothing
        os.replace(_waiting(path, read_json(path.with_suffix(".json"), keys=("sha256",))["sha256"]), path)


def _manifest(path: Path, kind: str) -> dict[str, Any]:
    """The manifest of `path`, checked as far as it can be without the arrays."""
    manifest_path = path.with_suffix(".json")
    if not manifest_path.exists():
        reason = f"incomplete, its manifest {manifest_path.name} is missing" if path.exists() else "missing"
        raise failure(path, reason)
    manifest = read_json(manifest_path, keys=("kind", "format", "sha256", "config"))
    if manifest["kind"] != kind:
        raise failure(path, f"is of kind {manifest['kind']}, not {kind}")
    if manifest["format"] != FORMAT:
        raise failure(path, f"is of format {manifest['format']}, this version reads {FORMAT}")
    if not isinstance(manifest["config"], dict) or not re.fullmatch("[0-9a-f]{64}", str(manifest["sha256"])):
        raise failure(manifest_path, "not a manifest, config or sha256 is malformed")
    return manifest


def _save(file: BinaryIO, arrays: Mapping[str, np.ndarray], compression: int) -> None:
    """As np.savez, for any names and without pickles."""
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)


def _load(path: Path, digest: str) -> dict[str, np.ndarray]:
    """The arrays that a manifest with `digest` is about, not yet compared with it."""
    try:
        content = read_bytes(_waiting(path, digest))
    except ArtefactError:
        content = read_bytes(path)
    if not b"PK".startswith(content[:2]):
        raise failure(path, "foreign, not an archive of arrays")
    if not zipfile.is_zipfile(io.BytesIO(content)):
        raise failure(path, "truncated, the end of the archive is missing")
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return {name: np.asarray(archive[name]) for name in archive.files}
    except Exception as error:  # a damaged archive raises nearly anything
        pickled = "allow_pickle" in str(error)
        raise failure(path, "holds pickled objects, refused" if pickled else f"damaged ({error})") from error
