"""Write a page of results, such as docs/results/levels.md and its figures.

Run `python -m benchmarks.quality.result_pages levels`.
It takes what `python -m sfkd_jax.compare +experiment=NAME` left under --root. Where
nothing lies there, the page is written anew from the results in experiments/; figures
that need driven episodes then stay as they are.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path

from sfkd_jax.reporting import benchmark_markdown, benchmark_report

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
}
"""Name of a comparison -> its folder in experiments/ and its page in docs/results/."""
DRIVEN = ("figure1_*", "*.gif")
"""Figures that need the arrays of driven episodes."""


def page_of(results: dict, page: str) -> str:
    """The page as it stands in docs/results/."""
    return benchmark_markdown(results).replace("results_files/", f"{page}_files/")


def main() -> None:
    """Copy the results, draw them, write the page."""
    parser = argparse.ArgumentParser(
        description="Write a page of results in docs/results/."
    )
    parser.add_argument("name", choices=PAGES)
    parser.add_argument(
        "--root", type=Path, default=Path("runs"), help="of the artefacts"
    )
    asked = parser.parse_args()
    folder, page = PAGES[asked.name]
    kept, files = (
        HOME / "experiments" / folder / "results.json",
        PAGES_DIR / f"{page}_files",
    )
    source = asked.root / asked.name / "results.json"
    if not source.exists() and not kept.exists():
        parser.error(
            f"{source} is missing: python -m sfkd_jax.compare +experiment={asked.name} makes it"
        )
    if source.exists():
        kept.parent.mkdir(exist_ok=True)
        shutil.copyfile(source, kept)
    files.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        if not source.exists():
            shutil.copyfile(kept, Path(scratch, "results.json"))
        figures = benchmark_report(source.parent if source.exists() else Path(scratch))[
            "figures"
        ]
        text = page_of(json.loads(kept.read_text("utf-8")), page)
        there, driven = (
            set(files.iterdir()),
            [file for kind in DRIVEN for file in files.glob(kind)],
        )
        stays = (
            set()
            if source.exists()
            else {file for file in driven if file.suffix == ".gif" or file.name in text}
        )
        for old in there - stays:
            old.unlink()
        for figure in map(Path, figures):
            place = (
                files / figure.name
            )  # films are not linked; other pages show one that lies there
            if place not in stays and (figure.name in text or place in there):
                shutil.copyfile(figure, place)
    (PAGES_DIR / f"{page}.md").write_text(text, encoding="utf-8")
    print(f"docs/results/{page}.md, {len(list(files.iterdir()))} figures")


if __name__ == "__main__":
    main()
