"""Where the three groups stand, and where the camera presets stand: functions of one rollout, in world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mild_viz.settings import choose

CAMERAS = ("both", "participant", "experimenter", "latent")
"""Camera presets: all groups; over the human's right shoulder; all from the robot's side; the latent plot."""

PLOT_SIZE = 1.3
"""Edge of the latent plot's box [m]."""

PLOT_TURN = -np.radians(28.0)
"""The box is turned about z, so that two of its walls stand behind what is drawn."""

VIEWER = np.array([-0.12, -0.97, 0.19])
"""From the plot to the camera of the preset 'both': forward, left and up of the robot."""

FIELD_OF_VIEW = np.radians(28.0)
"""Vertical field of view: narrow, so that figures at the sides of the picture do not lean outwards."""

CAPTION_SHARES = 0.14, 0.18
"""Half of the robot's and of the plot's caption, as a share of what a picture of all groups is wide: texts have a
size in pixels, so that those of a wide scene reach farther [m]."""

WIDEST = 1.85
"""Width over height of a canvas that just shows all three groups; one that is wider needs no more distance."""

TITLE_GAP, TITLE_STEP = 0.13, 0.23
"""From a head to its title, and from the human's title up to the robot's [m]."""

Vector = Float[np.ndarray, " 3"]


@dataclass(frozen=True)
class Camera:
    """A view point [m, world] with its vertical field of view [rad]; up is +z."""

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    fov: float = float(FIELD_OF_VIEW)


@dataclass(frozen=True, eq=False)
class Layout:
    """Robot on the left, human in the middle, latent plot on the right, seen from the side."""

    forward: Vector
    """Horizontal unit vector from the robot to the human."""
    robot_top: Vector
    human_top: Vector
    """The crowns of both heads."""
    human_eye: Vector
    hand: Vector
    """Where the hands are at their nearest."""
    floor: float
    walk: Float[np.ndarray, "W 3"]
    """Where the crown of the human's head is on the way, of one who walks."""
    plot_centre: Vector
    plot_yaw: float

    @property
    def side(self) -> Vector:
        """Horizontal unit vector from the dyad to the viewer: the robot's right, where its moving arm is."""
        return np.array([self.forward[1], -self.forward[0], 0.0])

    @property
    def span(self) -> float:
        """What a picture of all groups is wide, about [m]."""
        return float(self.plot_centre @ self.forward) + 1.5

    @property
    def human_title(self) -> Vector:
        """Above the human's head."""
        return self.human_top + np.array([0.0, 0.0, TITLE_GAP])

    @property
    def robot_title(self) -> Vector:
        """Above the robot's head, and high enough that its caption passes over the human's title."""
        height = max(float(self.robot_top[2]), float(self.human_top[2]) + TITLE_STEP) + TITLE_GAP
        return np.array([self.robot_top[0], self.robot_top[1], height])

    @property
    def plot_title(self) -> Vector:
        """Above the latent plot, clear of its axis labels."""
        return self.plot_centre + np.array([0.0, 0.0, 0.5 * PLOT_SIZE + 0.16])


def make_layout(
    robot_top: Vector,
    human_top: Vector,
    human_eye: Vector,
    hand: Vector,
    floor: float,
    walk: Float[np.ndarray, "W 3"] | None = None,
) -> Layout:
    """The layout of a dyad: the plot stands beyond the human, a little turned towards the dyad's viewer."""
    walk = human_top[None] if walk is None else walk
    away = human_top * [1.0, 1.0, 0.0]  # not where the human's frame is: one who walks leaves it behind
    distance = float(np.linalg.norm(away))
    forward = away / distance if distance > 0.1 else np.array([1.0, 0.0, 0.0])
    centre = forward * (max(distance, 0.75, float((walk @ forward).max())) + 1.40)
    centre[2] = floor + 0.98
    yaw = float(np.arctan2(forward[1], forward[0])) + PLOT_TURN
    return Layout(forward, robot_top, human_top, human_eye, hand, floor, walk, centre, yaw)


def camera(name: str, layout: Layout, aspect: float = WIDEST, headroom: float = 0.0) -> Camera:
    """One of `CAMERAS` for a canvas of the given width over height, with more space above the titles [m]."""
    choose("camera", name, CAMERAS)
    floor, up = layout.floor, np.array([0.0, 0.0, 1.0])
    if name == "participant":
        return over_shoulder(layout, aspect)
    plot = plot_points(layout) + [layout.plot_title + (0.12 + headroom) * up]
    robot_text, plot_text = (share * layout.span * layout.forward for share in CAPTION_SHARES)
    if name == "latent":
        direction = layout.side - 0.30 * layout.forward + 0.20 * up  # across the box, with a gap before the dyad
        nearest = layout.walk[int((layout.walk @ layout.forward).argmax())]
        return beside(nearest, fitted(np.array(plot), direction, aspect, 0.015), plot, aspect)
    dyad = [layout.robot_title + (0.14 + headroom) * up - robot_text, layout.plot_title + plot_text]
    dyad += [top + (TITLE_GAP + 0.14 + headroom) * up + 0.26 * layout.forward for top in layout.walk]
    dyad += [floor * up + 0.36 * (b * layout.side - layout.forward) for b in (-1, 1)]
    feet = layout.walk * [1.0, 1.0, 0.0] + floor * up
    dyad += [foot + 0.24 * (b * layout.side + layout.forward) for foot in feet for b in (-1, 1)]
    oblique = -0.55 * layout.forward + 0.38 * up if name == "experimenter" else 0.20 * up
    return fitted(np.array(dyad + plot), layout.side + oblique, aspect, margin=0.02)


def plot_points(layout: Layout) -> list[Vector]:
    """The corners of the latent plot's box, with room for the names of the axes below and at the upright edge."""
    half = 0.5 * PLOT_SIZE
    cos, sin = np.cos(layout.plot_yaw), np.sin(layout.plot_yaw)
    x, y = np.array([cos, sin, 0.0]), np.array([-sin, cos, 0.0])
    upright = layout.plot_centre - (half + 0.15) * (x + y) + [0.0, 0.0, 0.55 * half]
    return [upright] + [
        layout.plot_centre + reach * (a * x + b * y) + [0.0, 0.0, z]
        for a in (-1.0, 1.0)
        for b in (-1.0, 1.0)
        for reach, z in ((half, half), (half + 0.14, -half - 0.10))
    ]


def over_shoulder(layout: Layout, aspect: float) -> Camera:
    """What the person sees: just before the right eye, so that neither head nor title is in the way."""
    up = np.array([0.0, 0.0, 1.0])
    ahead = unit((layout.robot_top - layout.human_eye) * [1.0, 1.0, 0.0])
    eye = layout.human_eye + 0.12 * ahead + 0.10 * np.cross(ahead, up) + 0.05 * up
    wanted = np.array([layout.robot_top + 0.10 * up, layout.hand - 0.22 * up])
    ahead = unit(wanted[0] - eye) + unit(wanted[1] - eye)
    towards = -unit(ahead)
    right, above = picture_axes(towards)
    offsets = wanted - eye
    depth = np.maximum(-offsets @ towards, 0.05)
    slope = max(float((np.abs(offsets @ above) / depth).max()), float((np.abs(offsets @ right) / depth).max()) / aspect)
    fov = float(np.clip(2.0 * np.arctan(1.06 * slope), np.radians(38.0), np.radians(100.0)))
    return pinhole(eye, eye + unit(ahead), fov)


def beside(person: Vector, view: Camera, points: list[Vector], aspect: float) -> Camera:
    """Slide a camera to the right, as far as all points stay in its picture, until the person has left it."""
    position, look_at = np.array(view.position), np.array(view.look_at)
    towards = unit(position - look_at)
    right, _ = picture_axes(towards)

    def to_border(point: Vector) -> float:
        offset = point - position
        return float(offset @ right) + aspect * np.tan(view.fov / 2.0) * float(-offset @ towards)

    room = min(to_border(point) for point in points)
    step = float(np.clip(to_border(person) + 0.30, 0.0, max(room - 0.03, 0.0))) * right
    return pinhole(position + step, look_at + step, view.fov)


def unit(vector: Vector) -> Vector:
    """The vector at length one."""
    return vector / np.linalg.norm(vector)


def fitted(points: Float[np.ndarray, "P 3"], direction: Vector, aspect: float, margin: float) -> Camera:
    """The nearest camera on the side of `direction` that sees all points, `margin` of the picture left free."""
    towards = direction / np.linalg.norm(direction)
    right, above = picture_axes(towards)
    half = np.tan(FIELD_OF_VIEW / 2.0) * (1.0 - 2.0 * margin)
    across, high, depth = points @ right, points @ above, points @ towards
    # A point is inside the picture when |across - x| <= aspect half (distance - depth), and so for height:
    # each pair of opposite borders bounds centre and distance, the larger distance of the two wins.
    x, far_x = centred(across, depth, aspect * half)
    y, far_y = centred(high, depth, half)
    far = max(far_x, far_y)
    position = x * right + y * above + far * towards
    return pinhole(position, position - (far - float(depth.mean())) * towards, float(FIELD_OF_VIEW))


def picture_axes(towards: Vector) -> tuple[Vector, Vector]:
    """Unit vectors to the right and upwards in the picture of a camera on the side of `towards`."""
    right = np.cross(-towards, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    above = np.cross(towards, right)
    return right, above / np.linalg.norm(above)


def centred(offsets: Float[np.ndarray, " P"], depth: Float[np.ndarray, " P"], slope: float) -> tuple[float, float]:
    """Centre and least distance from which a symmetric wedge of this slope holds all points."""
    high = float((offsets + slope * depth).max())
    low = float((offsets - slope * depth).min())
    return 0.5 * (high + low), 0.5 * (high - low) / slope


def pinhole(position: Vector, look_at: Vector, fov: float) -> Camera:
    """A camera from arrays."""
    px, py, pz = (float(value) for value in position)
    lx, ly, lz = (float(value) for value in look_at)
    return Camera((px, py, pz), (lx, ly, lz), float(fov))
