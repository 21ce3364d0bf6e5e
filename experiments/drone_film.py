"""The film of a flight of `experiments.drone`."""

from functools import partial

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle
from matplotlib.text import Text

from sfkd_jax.report import style
from sfkd_jax.report.frames import (
    EVERY,
    area_between,
    draw_frames,
    draw_once,
    rotation_into,
)

SIGHT = (-3.0, 7.8)
"""What is seen behind and ahead of the drone [m]."""
SIDE = 1.9
"""What is seen above and below its reference, smoothed [m]."""
SMOOTH = 41
"""Number of steps over which the height of the view is averaged."""
ARM = 0.25
"""From the middle of the drone to a rotor [m]."""
OURS = style.ACCENT
NOMINAL = "#d55e00"
WALL = {"color": style.DARK, "lw": 3.0}
TUBE = {"fc": style.ACCENT, "alpha": 0.35, "lw": 0}


class DroneFilm:
    """A drone on its way through windows, beside the nominal planner without a shield.

    The view moves along with the reference.
    """

    def __init__(self, flight, *, dt, radius, bound):
        """Take what is drawn.

        Args:
            flight: of `drone.flight_for_film`.
            dt: sampling period [s].
            radius: of the cage [m].
            bound: of the position [m], certified.
        """
        self.flight = flight
        self.dt = dt
        self.radius = radius
        self.bound = bound
        self.places = flight["reference"][:, [0, 2]]
        padded = np.pad(self.places[:, 1], SMOOTH // 2, mode="edge")
        self.heights = np.convolve(padded, np.ones(SMOOTH) / SMOOTH, "valid")

    def frames(self):
        """Yield the frames."""
        figure = style.canvas(3.5)
        # No layout engine: axes that shift between frames would make the film shake.
        figure.set_layout_engine("none")
        figure.set(figwidth=8.0, dpi=100)
        axes = figure.add_axes((0.03, 0.13, 0.94, 0.76))
        axes.set(xlim=SIGHT, ylim=(-SIDE, SIDE), aspect="equal", xticks=(), yticks=())
        axes.set_facecolor("#f3f5f1")
        handles = [
            Line2D([], [], color=OURS, lw=2.5, label="policy"),
            Line2D([], [], color=NOMINAL, lw=2.5, label="the same without e"),
            Polygon([[0, 0]], **TUBE, label=f"certified, ± {self.bound:.2f} m"),
            Line2D([], [], color=OURS, lw=0.9, label="reference"),
        ]
        figure.legend(
            handles=handles, loc="lower center", ncols=4, fontsize=9, frameon=False
        )
        steps = range(0, len(self.flight["policy"]) - 1, EVERY)
        return draw_frames(figure, steps, partial(self._draw, axes))

    def _draw(self, axes, step):
        """Draw walls, reference and drones at a step."""
        centre = np.array([self.places[step, 0], self.heights[step]])
        places = self.places - centre
        across = np.gradient(self.places, axis=0)
        across = across[:, ::-1] * [-1.0, 1.0]
        across /= np.linalg.norm(across, axis=1, keepdims=True) + 1e-9
        edges = [(places + side * self.bound * across).T for side in (1.0, -1.0)]
        draw_once(axes, area_between(*edges, **TUBE))
        draw_once(axes, Line2D(*places.T, color=OURS, lw=0.9))
        half = self.radius + self.bound
        for window in self.flight["windows"] - centre:
            for side in (1.0, -1.0):
                wall = [window[0]] * 2, [window[1] + side * half, side * 20.0]
                draw_once(axes, Line2D(*wall, **WALL))
        end = self.flight["end"]
        self._draw_drone(axes, "nominal", min(step, end), centre, NOMINAL)
        self._draw_drone(axes, "policy", step, centre, OURS)
        payload, wind = self.flight["envs"][step]
        arrow = FancyArrowPatch(
            (1.8 - 0.3 * wind, 0.85 * SIDE),
            (1.8 + 0.3 * wind, 0.85 * SIDE),
            arrowstyle="-|>",
            mutation_scale=10,
            color=style.DARK,
            lw=2.5,
        )
        if abs(wind) > 0.2:
            draw_once(axes, arrow)
        away = np.linalg.norm(self.flight["policy"][step, :2] - self.places[step])
        text = "   ".join(
            [
                f"{step * self.dt:4.1f} s",
                f"payload {payload:.2f} kg",
                f"wind {wind:+.1f} N",
                f"{100 * away:4.1f} cm off its reference",
            ]
        )
        above = {"transform": axes.transAxes, "clip_on": False}
        draw_once(axes, Text(0, 1.04, text, fontsize=11, **above))
        if step > end:
            look = {"ha": "right", "fontweight": "bold", "color": NOMINAL}
            draw_once(axes, Text(1, 1.04, "hit a wall", fontsize=11, **look, **above))

    def _draw_drone(self, axes, name, step, centre, colour):
        """Draw cage, arms, rotors and payload of a drone."""
        state = self.flight[name][step]
        place = state[:2] - centre
        look = {"fc": "none", "ec": colour, "lw": 1.0, "alpha": 0.8}
        draw_once(axes, Circle(place, self.radius, **look))
        turn = rotation_into(-state[4])
        arms = turn @ np.array([[-ARM, ARM], [0.0, 0.0]]) + place[:, None]
        draw_once(axes, Line2D(*arms, color=colour, lw=3.0))
        for side in (-1.0, 1.0):
            rotor = np.array([[side * ARM - 0.1, side * ARM + 0.1], [0.06, 0.06]])
            rotor = turn @ rotor + place[:, None]
            draw_once(axes, Line2D(*rotor, color=style.DARK, lw=1.6))
        size = 0.2 * np.sqrt(self.flight["envs"][step, 0])
        corner = place - np.array([0.5 * size, size])
        draw_once(axes, Rectangle(corner, size, size, fc=style.DARK))
