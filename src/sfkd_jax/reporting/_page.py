"""The report of a run: reads what lies in its directory and writes page, Markdown and figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sfkd_jax.artefacts import read_jsonl, tell, write_bytes
from sfkd_jax.reporting import _sections as sections
from sfkd_jax.reporting._blocks import Block, Heading, Picture, Text, to_html, to_markdown
from sfkd_jax.reporting._driving import driving
from sfkd_jax.reporting._files import about, read
from sfkd_jax.reporting._numbers import dig, plain
from sfkd_jax.reporting._style import label
from sfkd_jax.reporting._tables import blocks_of
from sfkd_jax.reporting._words import command, headline, model_of, summary


def write_report(run: Path) -> dict[str, Any]:
    """Write `run/report/`: `index.html` (one self-contained page), `report.md` and `figures/*.png`.

    Reads policy.json, metrics.jsonl, open_loop.json, certificate.json, results.json and episodes.npz of `run`
    and recomputes none of their numbers; the same inputs give the same bytes.

    Args:
        run: directory of a run. All but policy.json may be missing; the page names the command that makes it.

    Returns:
        `report`: path of the page. `figures`: paths of the figures, in the order of the page.

    Raises:
        FileNotFoundError: no policy.json. ValueError: a file that is not JSON.
    """
    policy = read(run / "policy.json")
    if policy is None:
        raise FileNotFoundError(f"{run / 'policy.json'} is missing: {command('train', {})} makes a run")
    settings = policy.get("settings") or policy.get("config") or {}
    place = run / "report" / "figures"
    place.mkdir(parents=True, exist_ok=True)
    for stale in place.glob("*.png"):
        stale.unlink()
    log, errors = run / "metrics.jsonl", read(run / "open_loop.json")
    metrics = read_jsonl(log, damaged=tell) if log.exists() else []
    certificate = about(policy, read(run / "certificate.json"))
    results = read(run / "results.json") or {}
    rows = blocks_of(results.get("rows") or [])
    head, name = headline(rows, settings), plain(settings.get("experiment") or "unnamed run")
    title = f"{label(model_of(settings))} on {name}, seed {plain(settings.get('seed'))}"
    page: list[Block] = [Heading(1, title), Text(summary(settings, head, certificate, metrics), kind="lead")]
    page += sections.tiles(settings, head, errors, certificate)
    page += driving(run, rows, settings, place)
    page += sections.certified(run, certificate, errors, settings, place)
    page += sections.predicting(errors, settings, place)
    page += sections.training(metrics, settings, place)
    versions = policy.get("versions") or results.get("versions")
    page += sections.provenance(settings, versions, dig(results, "config", "command"))
    report = run / "report" / "index.html"
    write_bytes(report, to_html(title, page).encode())
    write_bytes(report.with_name("report.md"), to_markdown(page).encode())
    return {
        "report": str(report),
        "figures": [str(block.path) for block in page if isinstance(block, Picture)],
    }
