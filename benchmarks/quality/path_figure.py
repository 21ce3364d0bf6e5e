"""The figure of docs/results/path-frame.md, drawn by path_frame.py: error over the certified tube, a
point a weight of its loss.
"""

from pathlib import Path

FIGURE = (
    Path(__file__).resolve().parents[2] / "docs" / "results" / "path-frame_tube.png"
)
MEASURES = {
    "20 ahead [mm]": lambda rows: 1e3 * rows["s3"]["open_loop_rmse_m"]["20"],
    "S2 [mm]": lambda rows: 1e3 * rows["s2"]["rmse_m"]["mean"],
    "S3 [mm]": lambda rows: 1e3 * rows["s3"]["rmse_m"]["mean"],
}
"""What the figure has over the tube."""


def draw(weighed, bounds):
    """A line of panels a plant.

    Args:
        weighed: (plant, weight, scenario -> row), the weights of a plant ascending.
        bounds: (plant, system, weight) -> bounds of the corridor; without a weight for
            0.
    """
    from matplotlib.figure import Figure

    plants = list(dict.fromkeys(plant for plant, *_ in weighed))
    figure = Figure(figsize=(6.9, 4.4), layout="constrained")
    panels = figure.subplots(len(plants), len(MEASURES), sharex="row")
    for line, plant in zip(panels, plants, strict=True):
        result = [entry for entry in weighed if entry[0] == plant]
        keys = [
            (plant, "sfkd_path", *([weight] if weight else []))
            for _, weight, _ in result
        ]
        wide = [bounds[key]["followed_position"] for key in keys]
        for axes, (head, measure) in zip(line, MEASURES.items(), strict=True):
            high = [measure(rows) for *_, rows in result]
            axes.plot(wide, high, color="#0b57b0", marker="o", markersize=4)
            for (_, weight, _), *point in zip(result, wide, high, strict=True):
                offset = {
                    "textcoords": "offset points",
                    "xytext": (0, 6),
                    "ha": "center",
                    "fontsize": 7.5,
                }
                axes.annotate(f"{weight:g}", point, **offset)
            axes.set(ylim=(0.0, 1.25 * max(high)), title=f"{plant}: {head}")
            axes.title.set_fontsize(9)
            axes.margins(x=0.15)
            axes.grid(visible=True, color="#e3e6ea", linewidth=0.6)
        line[1].set_xlabel("certified tube of the class, followed [m]")
    figure.savefig(FIGURE, dpi=150, metadata={"Software": None})
