"""The page of a run: reads its directory and writes HTML, Markdown and figures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from sfkd_jax.evaluation.formats import plain
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.reporting._certificate import certified
from sfkd_jax.reporting._driving import driving
from sfkd_jax.reporting._model import predicting, training
from sfkd_jax.reporting._summary import command, provenance, summary
from sfkd_jax.reporting.blocks import Block, Heading, Picture, to_html, to_markdown
from sfkd_jax.reporting.corridor import corridor
from sfkd_jax.reporting.run import Run, read_policy, read_run
from sfkd_jax.reporting.style import label
from sfkd_jax.store import ArtefactError, as_artefact_error, write_bytes, writing

Studies: TypeAlias = Callable[[list[list[Row]], Path], list[Block]]


def write_report(run_dir: Path, *, studies: Studies | None = None) -> dict[str, Any]:
    """Write `run_dir/report/`: index.html, report.md and figures/*.png.

    Reads policy.safetensors, metrics.jsonl, open_loop.json, certificate.json,
    results.json and episodes.safetensors of a run and recomputes none of their numbers;
    the same inputs give the same bytes.

    Args:
        run_dir: of a run. All but policy.safetensors may be missing; the page names the
            command that makes it.
        studies: makes further blocks from the groups of comparable rows and the folder
            of the figures.

    Returns:
        `report`: path of the page. `figures`: paths of the figures, in the order of the
        page.

    Raises:
        ArtefactError: no policy.safetensors; a file that is not JSON, or whose content
            does not fit on a page; or the disk refuses the page.
    """
    with writing(run_dir / "report"):
        return _write(run_dir, studies)


def _write(directory: Path, studies: Studies | None) -> dict[str, Any]:
    """`write_report`, without conversion of errors of the disk."""
    policy = read_policy(directory)
    if policy is None:
        makes = f"{command('train', {})} makes a run"
        raise ArtefactError(f"{directory / 'policy.safetensors'} is missing: {makes}")
    run = read_run(directory, policy)
    run.figures.mkdir(parents=True, exist_ok=True)
    for stale in run.figures.glob("*.png"):
        stale.unlink()
    with as_artefact_error(directory / "policy.safetensors", ValueError):
        experiment = plain(run.settings.get("experiment") or "unnamed run")
        seed = plain(run.settings.get("seed"))
        title = f"{label(run.system)} on {experiment}, seed {seed}"
        foot = provenance(run)
    body: list[Block] = []
    for section, name in (
        (driving, "results.json"),
        (partial(_studied, studies), "results.json"),
        (corridor, "certificate.json"),
        (certified, "certificate.json"),
        (predicting, "open_loop.json"),
        (training, "metrics.jsonl"),
    ):
        with as_artefact_error(directory / name, ValueError):
            body += section(run)
    with as_artefact_error(directory / "certificate.json", ValueError):
        page = [Heading(1, title), *summary(run), *body, *foot]
    path = directory / "report" / "index.html"
    write_bytes(path, to_html(title, page).encode())
    write_bytes(path.with_name("report.md"), to_markdown(page).encode())
    figures = [str(block.path) for block in page if isinstance(block, Picture)]
    return {"report": str(path), "figures": figures}


def _studied(studies: Studies | None, run: Run) -> list[Block]:
    return studies(run.groups, run.figures) if studies else []
