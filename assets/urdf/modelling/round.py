"""Round shapes: profiles turned about an axis, and tubes along paths. Lengths in metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from modelling.surfaces import Array, Colour, Piece, grid, spline


def revolve(profile: Sequence[Sequence[float]], colour: Colour, columns: int = 40, rows: int = 0) -> Piece:
    """A profile (radius, z) turned about z, from low z to high at the outside; rows > 0: smoothed by a spline first."""
    points = spline(profile)(np.linspace(0, 1, rows)) if rows else np.asarray(profile, float)
    angle = np.arange(columns) * 2 * np.pi / columns
    x = points[:, :1] * np.cos(angle)
    y = points[:, :1] * np.sin(angle)
    return grid(np.stack([x, y, np.repeat(points[:, 1:], columns, axis=1)], axis=-1), colour)


def lathe(profile: Sequence[Sequence[float]], colour: Colour, columns: int = 26, edge: float = 0.003) -> Piece:
    """A profile (radius, z) turned about z, its corners rounded over `edge` to either side."""
    points = np.asarray(profile, float)
    rounded = [points[0]]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        back, on = before - corner, after - corner
        near = corner + back * min(edge / np.linalg.norm(back), 0.45)
        far = corner + on * min(edge / np.linalg.norm(on), 0.45)
        rounded += [near, (near + 2 * corner + far) / 4, far]
    return revolve([*rounded, points[-1]], colour, columns)


def band(radius: float, low: float, high: float, colour: Colour, columns: int = 28) -> Piece:
    """The outside of a cylinder about z: a ring whose ends are hidden in other pieces."""
    return revolve([(radius, low), (radius, high)], colour, columns)


def tube(path: Array, radii: Array, colour: Colour, columns: int = 14, edge: float | None = None) -> Piece:
    """A round tube along points (K, 3) with radii (K,), closed by half spheres, or flat with rounded edges."""
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.cross(tangents[0], (0.0, 0.0, 1.0) if abs(tangents[0][2]) < 0.9 else (0.0, 1.0, 0.0))
    angle = np.arange(columns) * 2 * np.pi / columns
    rings = []
    for k, (point, tangent, radius) in enumerate(zip(path, tangents, radii, strict=True)):
        across = across - tangent * (across @ tangent)  # carried along the path, so that the tube does not twist
        across /= np.linalg.norm(across)
        circle = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(tangent, across)
        around, along = np.array([radius]), np.zeros(1)
        if k == len(path) - 1:
            around, along = end_profile(radius, edge)
        elif k == 0:
            around, along = (profile[::-1] for profile in end_profile(radius, edge))
            along = -along
        rings += [point + wide * circle + far * tangent for wide, far in zip(around, along, strict=True)]
    return grid(np.stack(rings), colour)


def end_profile(radius: float, edge: float | None) -> tuple[Array, Array]:
    """Radii and distances beyond the last point of the rings that close a tube."""
    dome = np.linspace(0, np.pi / 2, 5)
    if edge is None:
        return radius * np.cos(dome) * (dome < 1.57), radius * np.sin(dome)
    around, along = radius - edge * (1 - np.cos(dome)), edge * (np.sin(dome) - 1)
    return np.append(around, [0.85 * around[-1], 0.0]), np.append(along, [0.0, 0.0])


def limb(
    keys: Sequence[Sequence[float]], colour: Colour, rows: int = 14, columns: int = 30, edge: float = 0.006
) -> Piece:
    """A tube along a spline with control points (x, y, z, radius), its ends flat with rounded edges."""
    points = spline(keys)(np.linspace(0, 1, rows))
    return tube(points[:, :3], points[:, 3], colour, columns, edge)
