"""The report of a run: reads what lies in its directory and writes page, Markdown and figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sfkd_jax.artefacts import (
    ArtefactError,
    read_jsonl,
    print_message,
    as_artefact_error,
    write_bytes,
    writing,
)
from sfkd_jax.reporting import _sections as sections
from sfkd_jax.reporting._blocks import (
    Block,
    Heading,
    Picture,
    Text,
    to_html,
    to_markdown,
)
from sfkd_jax.reporting._corridor_words import corridor
from sfkd_jax.reporting._driving import driving
from sfkd_jax.reporting._files import about, read
from sfkd_jax.reporting._numbers import dig, plain
from sfkd_jax.reporting._style import label
from sfkd_jax.reporting._tables import blocks_of
from sfkd_jax.reporting._words import command, headline, model_of, summary


def write_report(run: Path) -> dict[str, Any]:
    """Write `run/report/`: `index.html` (one self-contained page), `report.md` and `figures/*.png`.

    Reads policy.json, metrics.jsonl, open_loop.json, certificate.json, results.json and
    episodes.npz of `run` and recomputes none of their numbers; the same inputs give the
    same bytes.

    Args:
        run: directory of a run. All but policy.json may be missing; the page names the
            command that makes it.

    Returns:
        `report`: path of the page. `figures`: paths of the figures, in the order of the
        page.

    Raises:
        ArtefactError: no policy.json; a file that is not JSON, or holds what no page
            can be made of; or the disk refuses the page.
    """
    with writing(run / "report"):
        return _write(run)


def _write(run: Path) -> dict[str, Any]:
    """`write_report`, errors as they come."""
    policy = read(run / "policy.json")
    if policy is None:
        raise ArtefactError(
            f"{run / 'policy.json'} is missing: {command('train', {})} makes a run"
        )
    settings = policy.get("settings") or policy.get("config") or {}
    place = run / "report" / "figures"
    place.mkdir(parents=True, exist_ok=True)
    for stale in place.glob("*.png"):
        stale.unlink()
    log, errors = run / "metrics.jsonl", read(run / "open_loop.json")
    metrics = read_jsonl(log, damaged=print_message) if log.exists() else []
    certificate = about(policy, read(run / "certificate.json"))
    results = read(run / "results.json") or {}
    with as_artefact_error(run / "policy.json", ValueError):
        name, seed = (
            plain(settings.get("experiment") or "unnamed run"),
            plain(settings.get("seed")),
        )
        title = f"{label(model_of(settings))} on {name}, seed {seed}"
        made = sections.provenance(
            settings,
            policy.get("versions") or results.get("versions"),
            dig(results, "config", "command"),
        )
    with as_artefact_error(run / "results.json", ValueError):
        rows = blocks_of(results.get("rows") or [])
        head = headline(rows, settings)
        driven = driving(run, rows, settings, place)
    with as_artefact_error(run / "open_loop.json", ValueError):
        predicted = sections.predicting(errors, settings, place)
    with as_artefact_error(log, ValueError):
        trained = sections.training(metrics, settings, place)
    with as_artefact_error(run / "certificate.json", ValueError):
        lead = Text(summary(settings, head, certificate, metrics), kind="lead")
        tiles = sections.tiles(settings, head, errors, certificate)
        certified = corridor(run, certificate, settings, place)
        certified += sections.certified(run, certificate, errors, settings, place)
    page: list[Block] = [
        Heading(1, title),
        lead,
        *tiles,
        *driven,
        *certified,
        *predicted,
        *trained,
        *made,
    ]
    report = run / "report" / "index.html"
    write_bytes(report, to_html(title, page).encode())
    write_bytes(report.with_name("report.md"), to_markdown(page).encode())
    return {
        "report": str(report),
        "figures": [str(block.path) for block in page if isinstance(block, Picture)],
    }
