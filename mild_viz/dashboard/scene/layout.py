"""Where the three groups stand, and where the camera presets stand: functions of one rollout, in world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mild_viz.settings import choose

CAMERAS = ("both", "participant", "experimenter", "latent")
"""Camera presets: all three groups; over the human's shoulder; from the side of the dyad; the latent plot."""

PLOT_SIZE = 1.3
"""Edge of the latent plot's box [m]."""

PLOT_TURN = -np.radians(28.0)
"""The box is turned about z, so that two of its walls stand behind what is drawn."""

VIEWER = np.array([-0.12, -0.97, 0.19])
"""From the plot to the camera of the preset 'both': forward, left and up of the robot."""

FIELD_OF_VIEW = np.radians(28.0)
"""Vertical field of view: narrow, so that figures at the sides of the picture do not lean outwards."""

WIDEST = 1.85
"""Width over height of a canvas that just shows all three groups; one that is wider needs no more distance."""

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
    plot_centre: Vector
    plot_yaw: float

    @property
    def side(self) -> Vector:
        """Horizontal unit vector from the dyad to the viewer: the robot's right, where its moving arm is."""
        return np.array([self.forward[1], -self.forward[0], 0.0])

    @property
    def plot_title(self) -> Vector:
        """Above the latent plot, clear of its axis labels."""
        return self.plot_centre + np.array([0.0, 0.0, 0.5 * PLOT_SIZE + 0.16])


def make_layout(
    T_world_human: Float[np.ndarray, "4 4"],
    robot_top: Vector,
    human_top: Vector,
    human_eye: Vector,
    hand: Vector,
    floor: float,
) -> Layout:
    """The layout of a dyad: the plot stands beyond the human, a little turned towards the dyad's viewer."""
    away = T_world_human[:3, 3] * [1.0, 1.0, 0.0]
    distance = float(np.linalg.norm(away))
    forward = away / distance if distance > 0.1 else np.array([1.0, 0.0, 0.0])
    centre = forward * (max(distance, 0.75) + 1.25)
    centre[2] = floor + 0.98
    yaw = float(np.arctan2(forward[1], forward[0])) + PLOT_TURN
    return Layout(forward, robot_top, human_top, human_eye, hand, floor, centre, yaw)


def camera(name: str, layout: Layout, aspect: float = WIDEST, headroom: float = 0.0) -> Camera:
    """One of `CAMERAS` for a canvas of the given width over height, with more space above the titles [m]."""
    choose("camera", name, CAMERAS)
    floor, up = layout.floor, np.array([0.0, 0.0, 1.0])
    if name == "participant":
        behind = layout.human_eye + 0.80 * layout.forward + 0.62 * layout.side + 0.30 * up
        return pinhole(behind, 0.4 * layout.robot_top + 0.6 * layout.hand, np.radians(38.0))
    plot = [
        layout.plot_centre + PLOT_SIZE * (0.74 * a * layout.forward + 0.6 * b * layout.side + 0.5 * c * up)
        for a in (-1, 1)
        for b in (-1, 1)
        for c in (-1.15, 1.0)
    ] + [layout.plot_title + (0.12 + headroom) * up]
    if name == "latent":
        direction = layout.side + 0.12 * layout.forward + 0.28 * up
        return fitted(np.array(plot), direction, aspect, margin=0.06)
    foot = layout.human_top * [1.0, 1.0, 0.0] + floor * up
    above = (0.27 + headroom) * up
    dyad = [layout.robot_top + above - 0.34 * layout.forward, layout.human_top + above + 0.26 * layout.forward]
    dyad += [floor * up + 0.36 * (b * layout.side - layout.forward) for b in (-1, 1)]
    dyad += [foot + 0.24 * (b * layout.side + layout.forward) for b in (-1, 1)]
    if name == "experimenter":
        direction = layout.side - 0.55 * layout.forward + 0.38 * up
        return fitted(np.array(dyad), direction, aspect, margin=0.03)
    return fitted(np.array(dyad + plot), layout.side + 0.20 * up, aspect, margin=0.02)


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
