"""The directory of a run: the settings that made it, its results, and their sources."""

from __future__ import annotations

import functools
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from sfkd_jax import store
from sfkd_jax.driving import simulation
from sfkd_jax.driving.simulation.metrics import Row

IDENTITY = ("vehicle", "environment", "dataset", "model", "training", "seed")
"""Settings that determine the weights of a run; of the environment, its box."""
EPISODES = "episodes"
"""The kind of a file of recorded episodes."""
UNREADABLE = frozenset("[]")
"""Characters of a path that the checkpoint library writes, but reads as a pattern."""
PACKAGE = Path(__file__).resolve().parents[1]


def claim(run_dir: Path, policy_path: Path, identity: Mapping[str, Any]) -> None:
    """Record the settings of a run in its directory, or check the recorded ones.

    The recorded settings of a run that failed before it kept anything are replaced.

    Args:
        run_dir: of the run.
        policy_path: of its policy, whether or not it exists.
        identity: the plain settings that determine its weights.

    Raises:
        ArtefactError: the run was made with other settings.
        ValueError: checkpoints could not be read back from this path.
    """
    path = run_dir / "settings.json"
    if unreadable := UNREADABLE & set(str(path.resolve())):
        raise ValueError(
            "checkpoints cannot be read back from a path "
            f"with {' '.join(sorted(unreadable))}: {path}"
        )
    if path.exists():
        changed = store.differences(store.read_json(path), identity)
        if not changed:
            return
        checkpoints = run_dir / "checkpoints"
        kept = checkpoints.is_dir() and any(checkpoints.iterdir())
        # Without weights the recorded settings made nothing that could be mistaken.
        if kept or policy_path.is_file():
            raise store.ArtefactError(
                f"{run_dir} was made with other settings "
                f"({'; '.join(changed[:3])}); pass name=… for another run"
            )
    store.write_json(path, identity)


def read_results(run_dir: Path) -> list[Row]:
    """Return the rows that a run already has."""
    results = run_dir / "results.json"
    if not results.exists():
        return []
    with store.as_artefact_error(results):
        return simulation.merge([], store.read_json(results, keys=("rows",))["rows"])


def keep_episodes(directory: Path, name: str, row: Row, arrays: Any) -> Row:
    """Write the arrays of a row to a file; return the row with the name of the file.

    Args:
        directory: of the run or the comparison.
        name: of the file, relative to the directory.
        row: whose episodes they are.
        arrays: by name.
    """
    config = simulation.identity(row)
    store.write_arrays(directory / name, arrays, kind=EPISODES, config=config)
    return {**row, "arrays": name}


def write_results(
    run_dir: Path,
    config: Mapping[str, Any],
    results: Sequence[tuple[Row, Mapping[str, Any]]],
    seconds: float,
) -> Path:
    """Add rows and their arrays to those of a run; return the path of results.json.

    Rows replace earlier ones of the same identity. Other processes may add theirs at
    the same time.

    Args:
        run_dir: of the run.
        config: plain settings and the command that was typed.
        results: rows with the arrays of their episodes.
        seconds: how long the command took [s].
    """
    path = run_dir / "results.json"
    rows: list[Row] = []
    # Read and written under one lock, or rows of another process would be lost.
    with store.locked(run_dir, wait=True):
        # Arrays first: a row that is listed then has its episodes.
        for row, arrays in results:
            digest = store.sha256(simulation.identity(row))[:16]
            name = f"episodes/{digest}.safetensors"
            rows.append(keep_episodes(run_dir, name, row, arrays))
        document = {
            "rows": simulation.merge(read_results(run_dir), rows),
            "config": config,
            "versions": store.versions(),
            "seconds": seconds,
        }
        store.write_json(path, document)
    return path


@functools.cache
def provenance() -> dict[str, str | None]:
    """Return the commit that made a result.

    It ends with "+" if files were changed since; outside a checkout it is None.
    """
    describe = ["describe", "--always", "--exclude=*", "--abbrev=40", "--dirty=+"]
    command = ["git", "-C", str(PACKAGE), *describe]
    commit = None
    # An installed package may lie inside the checkout of somebody else.
    if (PACKAGE.parents[1] / ".git").exists():
        with suppress(OSError, subprocess.CalledProcessError):
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            commit = done.stdout.strip()
    return {"commit": commit}
