"""The panel beside the scene: readings, conditions and buttons."""

from __future__ import annotations

from threading import Event
from typing import TYPE_CHECKING

import numpy as np

from sfkd_jax.report import style
from sfkd_jax.viewer._live_drive import LiveDrive, LiveState, Moment, UserInput

if TYPE_CHECKING:
    import viser

LEGEND = (
    (style.ACCENT, "reference, in its certified corridor"),
    (style.THIRD, "admissible candidates"),
    (style.MUTED, "other candidates of the planner"),
    (style.SECOND, "not for the middle of the car"),
    (style.SOFT, "obstacles: drag them"),
)
"""Colours and what has them."""


class Panel:
    """Readings of the car, sliders of its surroundings, and buttons.

    Attributes:
        paused: set while the car waits.
        restarted: set until the car has been put back to the start.
    """

    def __init__(
        self, server: viser.ViserServer, drive: LiveDrive, user_input: UserInput
    ) -> None:
        """Put everything on the page.

        Args:
            server: of the page.
            drive: whose limits the sliders have.
            user_input: values of the sliders at the start.
        """
        self.paused = Event()
        self.restarted = Event()
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        self.readings = gui.add_markdown("")
        self.pause = gui.add_button("Pause")
        self.pause.on_click(lambda _: self.toggle_pause())
        restart = gui.add_button("Restart")
        restart.on_click(lambda _: self.restarted.set())
        names, lowest, highest = drive.env_box
        rows = zip(names, lowest, highest, user_input.env, strict=True)
        with gui.add_folder("Conditions"):
            self.env = [
                gui.add_slider(name, float(low), float(high), 0.05, float(value))
                for name, low, high, value in rows
            ]
            low, high = drive.speeds
            label = "wanted speed [m/s]"
            self.speed = gui.add_slider(label, low, high, 0.5, user_input.speed)
        with gui.add_folder("Legend"):
            gui.add_markdown(
                "\n".join(
                    f'<span style="color:{colour}">&#9632;</span> {words}<br/>'
                    for colour, words in LEGEND
                )
            )

    def toggle_pause(self) -> None:
        """Pause the car, or let it go on."""
        if self.paused.is_set():
            self.paused.clear()
        else:
            self.paused.set()
        self.pause.label = "Go on" if self.paused.is_set() else "Pause"

    def user_input(self, obstacles: np.ndarray) -> UserInput:
        """Return what the sliders say, and where the obstacles are [m]."""
        env = np.array([slider.value for slider in self.env])
        return UserInput(obstacles=obstacles, env=env, speed=float(self.speed.value))

    def read(self, state: LiveState, moment: Moment) -> None:
        """Show the readings after a control step."""
        self.readings.content = readings(state, moment)


def readings(state: LiveState, moment: Moment) -> str:
    """Return the readings after a control step, as Markdown."""
    claim = f"**± {moment.bound:.2f} m**"
    if not np.isfinite(moment.bound):
        claim = f"**none**: {moment.reason.advice}"
    standing = ", stops" if moment.braking else ""
    return "\n".join(
        [
            "| | |",
            "|---|---|",
            f"| speed | {moment.speed:.1f} m/s{standing} |",
            f"| corridor claimed | {claim} |",
            f"| deviation | {100 * moment.deviation:+.1f} cm |",
            f"| largest so far | {100 * state.largest:.1f} cm |",
            f"| to the next obstacle | {moment.gap:.1f} m |",
            f"| nearest so far | {state.nearest:.2f} m |",
            f"| time | {state.time:.0f} s |",
        ]
    )
