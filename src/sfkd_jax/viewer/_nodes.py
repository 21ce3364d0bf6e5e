"""What the browser shows of a drive: road, car, corridor, obstacles and candidates.

The road moves below a camera that stands still, so that whoever looks may turn the view
while the car drives. Reference, corridor and what is kept clear are those of the
`LaneScene`. Obstacles are bodies that are dragged, and the car is drawn several times
in a step, with the outlines that the scene has.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jaxtyping import Float, Int
from matplotlib.colors import to_rgb

from sfkd_jax.driving.lanes import Lane
from sfkd_jax.report import style
from sfkd_jax.report.frames import beside, surface_colour
from sfkd_jax.report.lane_scene import Line, car_at
from sfkd_jax.viewer._live_drive import RADIUS, Moment, UserInput

if TYPE_CHECKING:
    import viser

Mesh: TypeAlias = tuple[Float[np.ndarray, "vertex 3"], Int[np.ndarray, "face 3"]]
"""Vertices [m], and the indices of the corners of triangles."""

WORLD = "/world"
"""Node of everything that stands still in the world."""
CAMERA = (-17.0, 0.0, 11.0)
"""Place of the camera relative to the car: ahead, left and above [m]."""
LOOK_AT = (9.0, 0.0, 0.0)
"""What it looks at [m]."""
FIELD_OF_VIEW = 0.85
"""Of the camera [rad]."""
AMBIENT = 2.2
"""Intensity of the light from everywhere."""
SUN = 1.4
"""Intensity of the light from one side."""
SUN_AT = (-20.0, 30.0, 40.0)
"""Where that comes from."""
GROUND = 400.0
"""Half of the side of the ground [m]."""
HEIGHTS = {
    "road": 0.02,
    "needed": 0.05,
    "corridor": 0.08,
    "line": 0.11,
    "marking": 0.06,
}
"""At which flat things lie, one above the other [m]."""
PARTS = ((0.25, 1.0), (1.0, 1.03), (1.0, 1.03))
"""Lower and upper end of body, front and rear window of the car [m]."""
OBSTACLE_HEIGHT = 1.4
"""Of an obstacle [m]."""
DASH = 12
"""Number of points of the road between the beginnings of two dashes in its middle."""
ARROW = 0.5
"""Length of the arrow of the wind for each m/s [m]."""
ARROW_AT = (14.0, 0.0, 4.0)
"""Place of its middle relative to the car: ahead, left and above [m]."""


class Nodes:
    """Nodes of the scene in the browser.

    Attributes:
        controls: by which obstacles are dragged.
    """

    def __init__(
        self, server: viser.ViserServer, lane: Lane, user_input: UserInput
    ) -> None:
        """Draw what does not change, and the obstacles.

        Args:
            server: of the page.
            lane: the road.
            user_input: with the first places of the obstacles.
        """
        self.scene = server.scene
        self.drawn: dict[str, Any] = {}
        # The lights of viser make everything nearly white.
        self.scene.configure_default_lights(False)
        self.scene.configure_environment_map(None)
        self.scene.add_light_ambient("/ambient", intensity=AMBIENT)
        self.scene.add_light_directional("/sun", intensity=SUN, position=SUN_AT)
        server.initial_camera.position = CAMERA
        server.initial_camera.look_at = LOOK_AT
        server.initial_camera.fov = FIELD_OF_VIEW
        self.world = self.scene.add_frame(WORLD, show_axes=False)
        self.surface = self._draw_road(lane)
        self.controls = [
            self._draw_obstacle(number, place)
            for number, place in enumerate(user_input.obstacles)
        ]
        self.friction = float("nan")

    def _draw_road(self, lane: Lane) -> Any:
        """Draw ground, surface, edges and middle of the road; return the surface."""
        side = GROUND
        corners = np.array([[-side, side, side, -side], [-side, -side, side, side]])
        self._draw_mesh("ground", area(corners, 0.0), style.ROADSIDE)
        points = np.asarray(lane.path.points)
        left = beside(points, np.asarray(lane.left))
        right = beside(points, -np.asarray(lane.right))
        road = HEIGHTS["road"]
        surface = self._draw_mesh("road", strip(left, right, road), "white")
        marking = HEIGHTS["marking"]
        for name, edge in (("left", left), ("right", right)):
            self._draw_line(name, pieces(edge, marking), style.DARK, 0.12)
        middle = pieces(beside(points), marking)
        dashes = np.arange(len(middle)) % DASH < DASH // 2
        self._draw_line("middle", middle[dashes], style.MARKING, 0.12)
        return surface

    def _draw_obstacle(self, number: int, place: Float[np.ndarray, " 2"]) -> Any:
        """Draw an obstacle that can be dragged along the ground; return its control."""
        name = f"{WORLD}/obstacle_{number}"
        control = self.scene.add_transform_controls(
            name,
            scale=4.0,
            active_axes=(True, True, False),
            disable_rotations=True,
            depth_test=False,
            position=(*place, OBSTACLE_HEIGHT),
        )
        self.scene.add_cylinder(
            f"{name}/body",
            radius=RADIUS,
            height=OBSTACLE_HEIGHT,
            color=rgb(style.SOFT),
            position=(0.0, 0.0, -0.5 * OBSTACLE_HEIGHT),
        )
        return control

    def obstacles(self) -> Float[np.ndarray, "obstacle 2"]:
        """Return where the obstacles have been dragged [m]."""
        return np.array([control.position[:2] for control in self.controls])

    def place(self, obstacles: Float[np.ndarray, "obstacle 2"]) -> None:
        """Put the obstacles somewhere else [m]."""
        for control, place in zip(self.controls, obstacles, strict=True):
            control.position = (*place, OBSTACLE_HEIGHT)

    def draw(self, moment: Moment, user_input: UserInput) -> None:
        """Draw what changes from one control step to the next, but for the car.

        Args:
            moment: after the step.
            user_input: that it was taken with.
        """
        scene = moment.scene
        friction, wind = user_input.env
        if friction != self.friction:
            self.friction = friction
            self.surface.color = rgb(surface_colour(friction))
        for number, outline in enumerate(scene.needed):
            mesh = area(outline, HEIGHTS["needed"])
            self._draw_mesh(f"needed_{number}", mesh, style.SECOND, 0.35)
        self._draw_corridor(scene.corridor)
        reference = pieces(scene.reference, HEIGHTS["line"])
        self._draw_line("reference", reference, style.ACCENT, 0.08)
        self._draw_candidates(moment)
        self._draw_wind(float(wind))

    def move(
        self,
        pose: Float[np.ndarray, " 3"],
        centre: Float[np.ndarray, " 3"],
        half: tuple[float, float],
    ) -> None:
        """Draw the car, and the world as it is seen from the road beside it.

        Args:
            pose: of the car: x, y, yaw.
            centre: of the road beside the car: x, y, yaw.
            half: half of length and width of the car [m].
        """
        colours = (style.CAR, style.DARK, style.DARK)
        outlines = car_at(pose, half)
        for number, outline in enumerate(outlines):
            mesh = prism(outline, *PARTS[number])
            self._draw_mesh(f"car_{number}", mesh, colours[number])
        x, y, yaw = centre
        cos = np.cos(yaw)
        sin = np.sin(yaw)
        self.world.wxyz = (np.cos(0.5 * yaw), 0.0, 0.0, -np.sin(0.5 * yaw))
        self.world.position = (-cos * x - sin * y, sin * x - cos * y, 0.0)

    def _draw_corridor(self, edges: tuple[Line, Line] | None) -> None:
        """Draw the certified corridor, if one is claimed."""
        if edges is not None:
            mesh = strip(*edges, HEIGHTS["corridor"])
            self._draw_mesh("corridor", mesh, style.ACCENT, 0.45)
        if "corridor" in self.drawn:
            self.drawn["corridor"].visible = edges is not None

    def _draw_candidates(self, moment: Moment) -> None:
        """Draw references that the planner considers, by whether it may commit them."""
        for name, chosen, colour in (
            ("admissible", moment.admissible, style.THIRD),
            ("refused", ~moment.admissible, style.MUTED),
        ):
            lines = [
                pieces(line, HEIGHTS["marking"]) for line in moment.candidates[chosen]
            ]
            flat = np.concatenate([np.zeros((0, 2, 3)), *lines])
            self._draw_line(name, flat, colour, 0.03)

    def _draw_wind(self, wind: float) -> None:
        """Draw an arrow from the side that the wind comes from.

        Args:
            wind: to the left [m/s].
        """
        along, aside, above = ARROW_AT
        length = ARROW * wind
        ends = [[along, aside - s * length, above] for s in (0.5, -0.5)]
        arrow = self.drawn.get("wind")
        if arrow is None:
            arrow = self.scene.add_arrows(
                "/wind",
                np.array([ends]),
                rgb(style.DARK),
                shaft_radius=0.08,
                head_radius=0.22,
                head_length=0.6,
            )
            self.drawn["wind"] = arrow
        arrow.points = np.array([ends], dtype=np.float32)
        arrow.visible = abs(wind) > 0.1

    def _draw_mesh(
        self, name: str, mesh: Mesh, colour: str, opacity: float | None = None
    ) -> Any:
        """Draw a mesh in the world in place of the one of the same name; return it."""
        vertices, faces = mesh
        node = self.drawn.get(name)
        if node is not None and node.faces.shape == faces.shape:
            node.vertices = vertices.astype(np.float32)
            return node
        node = self.scene.add_mesh_simple(
            f"{WORLD}/{name}",
            vertices,
            faces,
            color=rgb(colour),
            opacity=opacity,
            flat_shading=True,
            side="double",
            cast_shadow=False,
        )
        self.drawn[name] = node
        return node

    def _draw_line(
        self,
        name: str,
        segments: Float[np.ndarray, "segment 2 3"],
        colour: str,
        width: float,
    ) -> None:
        """Draw segments in the world in place of those of the same name."""
        node = self.drawn.get(name)
        if node is not None:
            node.points = segments.astype(np.float32)
            return
        self.drawn[name] = self.scene.add_line_segments(
            f"{WORLD}/{name}", segments, rgb(colour), thickness=width
        )


def rgb(colour: Any) -> tuple[int, int, int]:
    """Return a colour of matplotlib as red, green and blue from 0 to 255."""
    red, green, blue = (round(255 * part) for part in to_rgb(colour))
    return red, green, blue


def at_height(places: Line, height: float) -> Float[np.ndarray, "point 3"]:
    """Return places on the ground, lifted to a height [m]."""
    return np.column_stack([places.T, np.full(places.shape[1], height)])


def pieces(line: Line, height: float) -> Float[np.ndarray, "segment 2 3"]:
    """Return the segments of a line at a height [m]."""
    points = at_height(line, height)
    return np.stack([points[:-1], points[1:]], axis=1)


def area(outline: Line, height: float) -> Mesh:
    """Return the area inside a convex outline, at a height [m]."""
    last = outline.shape[1] - 1
    following = np.arange(1, last)
    faces = np.stack([np.zeros_like(following), following, following + 1], axis=1)
    return at_height(outline, height), faces


def strip(left: Line, right: Line, height: float) -> Mesh:
    """Return the area between two lines of equally many points, at a height [m]."""
    count = left.shape[1]
    here = np.arange(count - 1)
    there = here + count
    faces = np.concatenate(
        [
            np.stack([here, there, here + 1], axis=1),
            np.stack([there, there + 1, here + 1], axis=1),
        ]
    )
    lines = (at_height(left, height), at_height(right, height))
    return np.concatenate(lines), faces


def prism(outline: Line, low: float, high: float) -> Mesh:
    """Return a body with a convex outline between two heights [m]."""
    count = outline.shape[1]
    top, lid = area(outline, high)
    bottom = at_height(outline, low)
    here = np.arange(count)
    after = (here + 1) % count
    sides = [
        np.stack([here, here + count, after], axis=1),
        np.stack([here + count, after + count, after], axis=1),
    ]
    return np.concatenate([top, bottom]), np.concatenate([lid, *sides])
