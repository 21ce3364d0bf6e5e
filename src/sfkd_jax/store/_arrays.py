"""Read and write artefacts: arrays in `name.npz` with a manifest in `name.json`.

A writer that is killed at any time leaves the old pair or the new pair readable. It
completes both files under hidden names, renames the arrays to a hidden name with their
hash, commits by replacing the manifest, and then renames the arrays to `name.npz`. If a
writer was killed before that last step, readers use the hidden file, and the next
writer renames it.

A manifest records two hashes. `sha256` identifies the content, independent of order and
layout; other documents refer to it. `file_sha256` is the hash of the bytes of the file.
It is compared before the zip file is opened, so that only what the writer wrote is
parsed and inflated. Manifests of earlier versions have no `file_sha256`; for these, and
for files without a manifest, the limits of `_npz` apply.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sfkd_jax.store._content import differences, plain, sha256
from sfkd_jax.store._files import (
    ArtefactError,
    encode,
    failure,
    open_regular,
    read_json,
    replacement,
    synchronise,
)
from sfkd_jax.store._npz import PORTABLE, check_zip, members, write_npz
from sfkd_jax.store._provenance import versions

FORMAT = 1
"""Version of the manifest; a reader refuses every other one."""


def write_arrays(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    *,
    kind: str,
    config: Mapping[str, Any],
    made_from: Mapping[str, str] | None = None,
    compressed: bool = False,
) -> dict[str, Any]:
    """Write `path` and its manifest, and return the manifest.

    Args:
        path: of the arrays, ending in .npz.
        arrays: by name.
        kind: of artefact, such as "policy".
        config: settings that the arrays were made with.
        made_from: hashes of the artefacts that they were made from.
        compressed: compress with deflate.

    Raises:
        ArtefactError: the disk is full or not writable (an earlier pair stays as it
            was), `path` does not end in .npz, a dtype has no portable form (objects,
            bfloat16), or `config` is not JSON.
    """
    if path.suffix != ".npz":
        raise failure(path, "not written, the name must end in .npz")
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    if odd := [
        name for name, array in arrays.items() if array.dtype.kind not in PORTABLE
    ]:
        raise failure(
            path,
            f"not written, {odd[0]} is of dtype {arrays[odd[0]].dtype}, "
            "which is not portable",
        )
    manifest_path = path.with_suffix(".json")
    manifest = {
        "kind": kind,
        "format": FORMAT,
        "sha256": sha256(arrays),
        "config": config,
    }
    manifest |= {"made_from": made_from or {}, "versions": versions()}
    manifest["created"] = datetime.now(UTC).isoformat(timespec="seconds")
    _complete(path)
    with (
        replacement(manifest_path) as (manifest_file, manifest_part),
        replacement(path) as (file, part),
    ):
        write_npz(file, arrays, compressed=compressed)
        synchronise(file)
        manifest["file_sha256"] = _digest(part)
        text = encode(path, manifest, indent=2)
        manifest_file.write(text)
        synchronise(manifest_file)
        waiting = _waiting(path, manifest)
        os.replace(part, waiting)
        try:
            os.replace(manifest_part, manifest_path)
        except OSError:
            waiting.unlink(missing_ok=True)
            raise
        with suppress(FileNotFoundError):  # another writer has completed this
            os.replace(waiting, path)
    return json.loads(text)


def read_arrays(
    path: Path, *, kind: str, config: Mapping[str, Any] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the arrays of `path` and their manifest; pickles are never loaded.

    Args:
        path: of the arrays.
        kind: that the artefact must have.
        config: settings that it must have been made with, or None for any.

    Raises:
        ArtefactError: either file is missing, truncated, damaged or foreign; the
            artefact is of another kind or format, was made with other settings than
            `config`, or its arrays do not match the manifest.
    """
    manifest = _manifest(path, kind)
    if config is not None and (
        changed := differences(manifest["config"], plain(config))
    ):
        more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
        listed = "; ".join(changed[:3])
        raise failure(path, f"made with other settings: {listed}{more}")
    try:
        return _load(path, manifest), manifest
    except ArtefactError:
        if _manifest(path, kind) == manifest:
            raise
    # The artefact was replaced while it was read.
    return read_arrays(path, kind=kind, config=config)


def exists(path: Path) -> bool:
    """Whether both files of an artefact exist."""
    return path.is_file() and path.with_suffix(".json").is_file()


def _waiting(path: Path, manifest: Mapping[str, Any]) -> Path:
    """The hidden name of complete arrays before their manifest is committed."""
    digest = manifest.get("file_sha256", manifest["sha256"])
    return path.with_name(f".{path.name}.{digest[:16]}.part")


def _complete(path: Path) -> None:
    """Rename the arrays of a writer that was killed after its commit."""
    # A damaged manifest commits nothing.
    with suppress(ArtefactError, OSError, TypeError, ValueError):
        manifest = read_json(path.with_suffix(".json"), keys=("sha256",))
        os.replace(_waiting(path, manifest), path)


def _manifest(path: Path, kind: str) -> dict[str, Any]:
    """Return the manifest of `path`, checked without its arrays."""
    manifest_path = path.with_suffix(".json")
    if not manifest_path.exists():
        reason = (
            f"incomplete, its manifest {manifest_path.name} is missing"
            if path.exists()
            else "missing"
        )
        raise failure(path, reason)
    manifest = read_json(manifest_path, keys=("kind", "format", "sha256", "config"))
    if manifest["kind"] != kind:
        raise failure(path, f"is of kind {manifest['kind']}, not {kind}")
    if manifest["format"] != FORMAT or isinstance(manifest["format"], bool):
        raise failure(
            path, f"is of format {manifest['format']}, this version reads {FORMAT}"
        )
    hashes = (manifest["sha256"], manifest.get("file_sha256", manifest["sha256"]))
    if odd := [
        name
        for name in ("config", "made_from", "versions")
        if not isinstance(manifest.get(name, {}), dict)
    ]:
        raise failure(manifest_path, f"not a manifest, {odd[0]} is malformed")
    if not all(
        isinstance(digest, str) and re.fullmatch("[0-9a-f]{64}", digest)
        for digest in hashes
    ):
        raise failure(
            manifest_path, "not a manifest, sha256 or file_sha256 is malformed"
        )
    return manifest


def _load(path: Path, manifest: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the arrays of a manifest.

    Raises:
        ArtefactError: the bytes or the arrays do not match the manifest.
    """
    try:
        opened = open_regular(_waiting(path, manifest))
    except ArtefactError:
        opened = open_regular(path)
    with opened as file:
        check_zip(path, file)
        file.seek(0)
        recorded = manifest.get("file_sha256", "")
        actual = hashlib.file_digest(file, "sha256").hexdigest() if recorded else ""
        if actual == recorded:
            arrays = members(path, file)
            actual, recorded = sha256(arrays), manifest["sha256"]
            if actual == recorded:
                return arrays
    raise failure(
        path,
        f"does not match its manifest: sha256 {actual[:12]}, recorded {recorded[:12]}",
    )


def _digest(path: Path) -> str:
    """Hash the bytes of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
