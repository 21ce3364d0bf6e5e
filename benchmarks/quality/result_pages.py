"""Write a page of results, such as docs/results/levels.md and its figures.

Run `python -m benchmarks.quality.result_pages levels`.
It takes the results of `python -m sfkd_jax.compare +experiment=NAME` below --root. If
there are none, the page is written again from the results in experiments/; figures that
need the arrays of episodes then stay as they are.
"""

from __future__ import annotations

import argparse
import functools
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from sfkd_jax.cli.config import conf_path, register
from sfkd_jax.paper import results_markdown, write_results_page

HOME = Path(__file__).parents[2]
PAGES_DIR = HOME / "docs" / "results"
PAGES = {
    "table1": ("table1_closed_loop", "table"),
    "figure2": ("figure2_disturbance", "side-forces"),
    "robustness": ("robustness", "robustness"),
    "levels": ("levels", "levels"),
    "small_data": ("small_data", "small-data"),
    "seeds": ("seeds", "seeds"),
    "longer": ("longer", "longer"),
    "protocol2": ("protocol2", "bench-2"),
    "protocol2_path": ("protocol2_path", "bench-2-path"),
    "protocol2_plain": ("protocol2_plain", "bench-2-plain"),
    "protocol2_speed": ("protocol2_speed", "bench-2-speed"),
    "protocol2_blind": ("protocol2_blind", "bench-2-blind"),
}
"""Name of a comparison -> its folder in experiments/ and its page in docs/results/."""
FROM_ARRAYS = ("figure1_*", "*.gif")
"""Figures that need the arrays of episodes."""


@functools.cache
def page_texts(name: str) -> dict[str, Any]:
    """`comparison.page` of an experiment, which results of older versions lack."""
    register()
    with initialize_config_dir(conf_path(), version_base="1.3"):
        config = compose("config", [f"+experiment={name}"])
    page: Any = OmegaConf.to_container(config.comparison.page)
    return page


def page_of(results: dict[str, Any], page: str) -> str:
    """The page as it is in docs/results/."""
    texts = page_texts(results["config"]["name"])
    markdown = results_markdown(results, texts)
    return markdown.replace("results_files/", f"{page}_files/")


def update_figures(figures: list[Path], files: Path, text: str, *, final: bool) -> None:
    """Replace the figures of a page.

    Args:
        figures: as drawn.
        files: folder of the page.
        text: of the page, which links figures. Films are not linked; they stay if they
            are there, because other pages show them.
        final: whether the arrays of episodes were available.
    """
    files.mkdir(exist_ok=True)
    before = set(files.iterdir())
    old = {path for pattern in FROM_ARRAYS for path in files.glob(pattern)}
    keep = {one for one in old if one.suffix == ".gif" or one.name in text}
    keep = set() if final else keep
    for stale in before - keep:
        stale.unlink()
    for figure in figures:
        path = files / figure.name
        if path not in keep and (figure.name in text or path in before):
            shutil.copyfile(figure, path)


def main() -> None:
    """Copy the results, draw them, write the page."""
    parser = argparse.ArgumentParser(description="Write a page of results.")
    parser.add_argument("name", choices=PAGES)
    help_text = "root of the artefacts"
    parser.add_argument("--root", type=Path, default=Path("runs"), help=help_text)
    options = parser.parse_args()
    folder, page = PAGES[options.name]
    stored = HOME / "experiments" / folder / "results.json"
    source = options.root / options.name / "results.json"
    final = source.exists()
    if not final and not stored.exists():
        command = f"python -m sfkd_jax.compare +experiment={options.name}"
        parser.error(f"{source} is missing: {command} writes it")
    if final:
        stored.parent.mkdir(exist_ok=True)
        shutil.copyfile(source, stored)
    text = page_of(json.loads(stored.read_text("utf-8")), page)
    files = PAGES_DIR / f"{page}_files"
    with tempfile.TemporaryDirectory() as scratch:
        if not final:
            shutil.copyfile(stored, Path(scratch, "results.json"))
        directory = source.parent if final else Path(scratch)
        written = write_results_page(directory, page_texts(options.name))
        figures = [Path(figure) for figure in written["figures"]]
        update_figures(figures, files, text, final=final)
    (PAGES_DIR / f"{page}.md").write_text(text, encoding="utf-8")
    print(f"docs/results/{page}.md, {len(list(files.iterdir()))} figures")


if __name__ == "__main__":
    main()
