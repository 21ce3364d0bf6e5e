"""Draw docs/adaptation.png and docs/adaptation.gif: one drive under side forces that nobody measures, with adaptation and without.

python -m benchmarks.quality.adaptation_figure [--vehicle dynamic --episode 0]
Roads, forces and noise are those of the case "force, 3 s" of
benchmarks/quality/adaptation.py.
"""

import argparse
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.harness import ROOT
from benchmarks.quality import adaptation
from sfkd_jax import build, evaluation, policy, scenarios
from sfkd_jax.report import style

CASE, SECONDS, EPISODES, SEED = adaptation.CASES["force, 3 s"], 30.0, 16, 2027
FILM_SECONDS, WINDOW, FRAME = 15.0, 6.0, 2
"""Length of the film [s], what it shows of the past [s], control steps per frame."""
LARGEST = 0.08
"""Half height of the panels [m]."""
ABOVE = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.98)}
ABOVE |= {"frameon": False, "fontsize": 8}
"""Legends hide no data."""


class Drive(NamedTuple):
    """What a figure shows of a drive.

    Attributes:
        lateral: e_y [m], (step,).
        plan: e_y of the plan of every step [m], (step, horizon).
        tube: its radii [m], (step, horizon).
        force: estimated side force with its standard deviation [N], (step, 2), or None.
    """

    lateral: np.ndarray
    plan: np.ndarray
    tube: np.ndarray
    force: np.ndarray | None


def drives(name, episode):
    """The true force [N], and the drives by label."""
    directory = ROOT / "src" / "sfkd_jax" / "pretrained" / f"{name}_path"
    loaded = policy.load(directory)
    plant = build.build_vehicle(loaded.settings["vehicle"])
    rows = adaptation.Rows(name, loaded, plant)
    made, keys = adaptation.roads(plant, CASE, EPISODES, SECONDS, SEED)
    scene, key = jax.tree.map(lambda leaf: leaf[episode], (made, keys))
    plain = adaptation.with_tube(rows.planner(loaded.model), lane=None)
    adapting = rows.adaptive(tube={"lane": None})
    shown = {"not adapting": plain, "adapting": adapting}
    made = {
        label: drive(rows, controller, scene, key)
        for label, controller in shown.items()
    }
    force = [
        plant.wind_force * wind * np.abs(wind)
        for wind in np.asarray((scene.envs, scene.observed_envs))[..., 1]
    ]
    return force[0] - force[1], made


def drive(rows, controller, scene, key):
    """Drive one road."""
    plant = rows.plant

    def reported(info):
        parts = {name: info[name] for name in ("predicted_states", "tube")}
        if "causes" in info:
            parts["force"] = jnp.stack([info["causes"][0], info["causes_std"][0]])
        return parts

    episode = jax.jit(
        partial(
            evaluation.simulate,
            plant.step,
            controller,
            rows.loaded.params,
            dt=plant.dt,
            horizon=20,
            observation_noise=adaptation.sensor_noise(rows),
            record={"shown": reported},
        )
    )(scene, key)

    def offsets(progress, states):
        ahead = progress + scene.speed * plant.dt * jnp.arange(states.shape[0])
        position = jax.vmap(partial(scenarios.project, scene.path))
        return position(states[:, :2], ahead)[1]

    report = episode.signals["shown"]
    plan = jax.jit(jax.vmap(offsets))(episode.progress, report["predicted_states"])
    scale = plant.wind_force * rows.box["env_high"][1] ** 2
    force = scale * np.asarray(report["force"]) if "force" in report else None
    return Drive(
        np.asarray(episode.lateral), *map(np.asarray, (plan, report["tube"])), force
    )


def draw(force, shown, dt, path):
    """e_y with the tube one step ahead, and the force with its estimate."""
    figure = Figure(figsize=(style.WIDTH, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(3, 1, sharex=True)
    time = dt * np.arange(len(force))
    for axes, (label, found) in zip(panels, shown.items(), strict=False):
        middle, radius = found.plan[:, 9], found.tube[:, 9]
        band = time + 10 * dt, 1e3 * (middle - radius), 1e3 * (middle + radius)
        axes.fill_between(*band, color=style.ROAD, label="plan and tube 1 s before")
        axes.plot(time, 1e3 * found.lateral, color=style.ACCENT, label=label)
        axes.set(ylabel="$e_y$ [mm]", ylim=(-1e3 * LARGEST, 1e3 * LARGEST))
        axes.legend(**ABOVE, ncols=2)
    mean, spread = shown["adapting"].force.T
    panels[2].fill_between(
        time, mean - 2 * spread, mean + 2 * spread, color=style.ROAD, label="± 2 std"
    )
    panels[2].plot(time, force, color=style.DARK, label="side force")
    panels[2].plot(time, mean, color=style.SECOND, label="estimate")
    panels[2].set(ylabel="force [N]", xlabel="time [s]", xlim=(0.0, time[-1]))
    panels[2].legend(**ABOVE, ncols=3)
    figure.savefig(path, dpi=150, metadata={"Software": None})


def animate(force, shown, dt, path):
    """The last seconds of e_y, and ahead of it the plan with its tube."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        figure = Figure(figsize=(6.0, 3.9), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(2, 1, sharex=True, sharey=True)
        writer = PillowWriter(fps=round(1 / (FRAME * dt)))
        with writer.saving(figure, str(path), dpi=90):
            for now in range(1, round(FILM_SECONDS / dt), FRAME):
                for axes, (label, found) in zip(panels, shown.items(), strict=True):
                    _frame(axes, found, now, dt)
                    axes.set_title(label, fontsize=9, loc="left")
                panels[0].set_title(f"side force {force[now]:+.0f} N", fontsize=9)
                panels[1].set_xlabel("time from now [s]", fontsize=9)
                writer.grab_frame()


def _frame(axes, found, now, dt):
    """One panel of one frame."""
    begin = max(now - round(WINDOW / dt), 0)
    past = dt * (np.arange(begin, now + 1) - now)
    horizon = found.plan.shape[1]
    ahead = dt * np.arange(1, horizon + 1)
    plan, radius = 1e3 * found.plan[now], 1e3 * found.tube[now]
    axes.clear()
    axes.axhline(0.0, color=style.AXIS, linewidth=0.8)
    axes.fill_between(ahead, plan - radius, plan + radius, color=style.ROAD)
    axes.plot(ahead, plan, color=style.MUTED, linewidth=1.0)
    axes.plot(past, 1e3 * found.lateral[begin : now + 1], color=style.ACCENT)
    axes.set(xlim=(-WINDOW, dt * horizon), ylim=(-1e3 * LARGEST, 1e3 * LARGEST))
    axes.set_ylabel("$e_y$ [mm]", fontsize=9)


def main():
    """Parse, drive, draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--vehicle", choices=tuple(adaptation.DEFAULTS), default="dynamic"
    )
    parser.add_argument("--episode", type=int, choices=range(EPISODES), default=0)
    given = parser.parse_args()
    force, shown = drives(given.vehicle, given.episode)
    draw(force, shown, 0.1, ROOT / "docs" / "adaptation.png")
    animate(force, shown, 0.1, ROOT / "docs" / "adaptation.gif")


if __name__ == "__main__":
    main()
