"""Write the table of docs/corridor.md.

python -m benchmarks.quality.corridor_page [--root runs]: from the certificates that ship and from
experiments/corridor/; with --root both are taken first from where
experiments/corridor/run.sh left them.
"""

import argparse
import json
import shutil
from pathlib import Path

from benchmarks.harness import SHIPPED

HOME = Path(__file__).resolve().parents[2]
RESULTS = HOME / "experiments" / "corridor" / "results.json"
PAGE = HOME / "docs" / "corridor.md"
PLANTS = ("dynamic", "kinematic")
OPEN, CLOSE = "<!-- corridor -->\n", "<!-- /corridor -->"


def table() -> str:
    """What is claimed of both policies and what they drove, as markdown."""
    result = [_facts(plant) for plant in PLANTS]
    lines = [f"| | {' | '.join(PLANTS)} |", f"|---|{'---|' * len(PLANTS)}"]
    lines += [
        f"| {name} | {' | '.join(facts[name] for facts in result)} |"
        for name in result[0]
    ]
    return "\n".join(lines) + "\n"


def _facts(plant: str) -> dict[str, str]:
    """One column."""
    certificate = json.loads(
        (SHIPPED / f"{plant}_path" / "certificate.json").read_text()
    )
    rows = {
        row["system"]: row
        for row in json.loads(RESULTS.read_text())["rows"]
        if row["vehicle"] == plant
    }
    own, oracle = rows["sfkd_path"], rows["oracle"]
    output, corridor = certificate["outputs"]["position"], certificate["corridor"]
    bounds, attack, s3 = (
        corridor["bounds"],
        corridor["attack"],
        corridor["by_scenario"]["s3"],
    )
    rest = [corridor["fixed_points"][name] for name in ("corridor_m", "after_switch_m")]
    low, high = corridor["coverage_ci95"]
    return {
        "**corridor: bound on \\|e_y\\| for 95 % of drives of the class [m]**": f"**{corridor['corridor_m']:.3f}**",
        "half width W of the nominal corridor [m]": f"{bounds['nominal']:.3f}",
        "of it, car to its simulated model (`followed`) [m]": f"{bounds['followed_position']:.3f}",
        "tube around the copy, `for_ever` [m]": f"{bounds['for_ever_position']:.3f}",
        "share of fresh drives of the class inside": f"{corridor['coverage']:.3f} ({low:.3f} to {high:.3f})",
        "share of S3 drives of 60 s inside, never calibrated on": f"{s3['coverage']:.3f}",
        "largest \\|e_y − ê_y\\| of those fresh drives [m]": f"{corridor['seen']['distance_m']:.3f}",
        "tube on 5 s drives like the data, `for_ever` [m]": f"{output['tube']['for_ever']:.3f}",
        "tube on 5 s drives like the data, `followed` [m]": f"{output['tube']['followed']:.3f}",
        "without a copy: the law alone [m]; right after a switch": "; ".join(
            f"{part['law']:.3f}" for part in rest
        ),
        "without a copy: any ν in its limits [m]; right after a switch": "; ".join(
            f"{part['planner']:.3f}" for part in rest
        ),
        "α in the metric of e_y, proved; in the 2-norm": f"{output['alpha']:.3f}; {certificate['alpha']:.3f}",
        "attack that keeps the error bound: share of the tube reached": f"{attack['over_tube']:.2f}",
        "attack that may break it: \\|e_y\\| [m]": f"{attack['shielded_lateral_m']:.2f}",
        "S3 inside the shield, RMSE [mm]; divided by the oracle's": (
            f"{1e3 * own['rmse_m']['mean']:.1f}; {own['ratio_to_oracle']:.3f}"
        ),
        "S3, largest \\|e_y\\| [m]; departures": f"{own['max_deviation_m']:.3f}; {own['departures']}",
        "the oracle with the same law [mm]": f"{1e3 * oracle['rmse_m']['mean']:.1f}",
        "certify everything [s]": f"{certificate['seconds']:.0f}",
    }


def page(text: str) -> str:
    """The page with the table as it has to be."""
    before, rest = text.split(OPEN)
    return before + OPEN + table() + CLOSE + rest.split(CLOSE)[1]


def take(root: Path) -> None:
    """Copy what run.sh left: policies with their certificates, and the rows that they
    drove.
    """
    rows = []
    for plant in PLANTS:
        made = root / f"corridor_{plant}" / "sfkd_path" / "seed=0"
        rows += json.loads((made / "results.json").read_text())["rows"]
        for name in ("policy.npz", "policy.json", "certificate.json"):
            shutil.copy(made / name, SHIPPED / f"{plant}_path" / name)
    RESULTS.write_text(json.dumps({"rows": rows}, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--root", type=Path, default=None, help="where run.sh left its runs"
    )
    root = parser.parse_args().root
    if root:
        take(root)
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
