"""Simple meshes and poses that the views are put together from."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SIDES = 20
"""Corners of a round cross-section."""

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) and triangles (F, 3)."""


def loft(sections: Float[np.ndarray, "K 5"], sides: int = SIDES) -> Mesh:
    """A closed surface through elliptic cross-sections across z.

    A section is z, half-extent along x, half-extent along y, the centre's x, the centre's y [m].
    """
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    z, half_x, half_y, centre_x, centre_y = sections.T
    rings = np.empty((len(sections), sides, 3))
    rings[..., 0] = centre_x[:, None] + half_x[:, None] * np.cos(angle)
    rings[..., 1] = centre_y[:, None] + half_y[:, None] * np.sin(angle)
    rings[..., 2] = z[:, None]
    poles = np.stack([[centre_x[0], centre_y[0], z[0]], [centre_x[-1], centre_y[-1], z[-1]]])
    vertices = np.concatenate([rings.reshape(-1, 3), poles])
    here = np.arange(sides)
    after = np.roll(here, -1)
    faces = []
    for k in range(len(sections) - 1):
        low, high = k * sides, (k + 1) * sides
        faces += [(low + here, low + after, high + after), (low + here, high + after, high + here)]
    bottom, top, last = len(vertices) - 2, len(vertices) - 1, (len(sections) - 1) * sides
    faces += [(np.full(sides, bottom), after, here), (np.full(sides, top), last + here, last + after)]
    return vertices, np.concatenate([np.stack(corners, axis=1) for corners in faces]).astype(np.uint32)


def limb(taper: float = 0.72) -> Mesh:
    """A limb of unit length along z from the origin and unit radius, thinner at its end, a little swollen."""
    along = np.linspace(0.0, 1.0, 9)
    radius = 1.0 + (taper - 1.0) * along + 0.10 * np.sin(np.pi * along)
    zero = np.zeros_like(along)
    return loft(np.stack([along, radius, radius, zero, zero], 1))


def ball() -> Mesh:
    """A sphere of unit radius about the origin."""
    polar = np.linspace(np.pi, 0.0, 13)
    radius = np.maximum(np.sin(polar), 1e-6)
    zero = np.zeros_like(polar)
    return loft(np.stack([np.cos(polar), radius, radius, zero, zero], 1))


def placed_limb(
    start: Float[np.ndarray, " 3"], end: Float[np.ndarray, " 3"], radius: float, taper: float = 0.75
) -> Mesh:
    """A limb with rounded ends from one point to another [m]."""
    vertices, faces = limb(taper)
    wxyz, scale = limb_poses(start[None], end[None], np.array([radius]))
    shaft = rotate(wxyz[0], vertices * scale[0]) + start
    parts = [(shaft, faces), placed_ball(start, np.full(3, radius)), placed_ball(end, np.full(3, radius * taper))]
    return merge(parts)


def placed_ball(centre: Float[np.ndarray, " 3"], radii: Float[np.ndarray, " 3"]) -> Mesh:
    """An ellipsoid along the axes about `centre` [m]."""
    vertices, faces = ball()
    return vertices * radii + centre, faces


def merge(parts: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [triangles.astype(np.int64) + offset for (_, triangles), offset in zip(parts, offsets, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces).astype(np.uint32)


def limb_poses(
    start: Float[np.ndarray, "P 3"], end: Float[np.ndarray, "P 3"], radius: Float[np.ndarray, " P"]
) -> tuple[Float[np.ndarray, "P 4"], Float[np.ndarray, "P 3"]]:
    """Orientation (wxyz) and scale that lay the unit `limb` from `start` to `end`.

    A missing end (NaN) gives the identity and a scale of zero, which hides the limb.
    """
    along = end - start
    length = np.linalg.norm(along, axis=1)
    seen = np.isfinite(length) & (length > 1e-6)
    direction = np.where(seen[:, None], along / np.where(seen, length, 1.0)[:, None], [0.0, 0.0, 1.0])
    scale = np.stack([radius, radius, length], 1)
    return quaternion_from_z(direction), np.where(seen[:, None], scale, 0.0)


def quaternion_from_z(direction: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 4"]:
    """The shortest rotation (wxyz) that turns z into each unit vector."""
    x, y, z = direction.T
    wxyz = np.stack([1.0 + z, -y, x, np.zeros_like(x)], 1)
    wxyz[z < -1.0 + 1e-9] = (0.0, 1.0, 0.0, 0.0)
    return wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)


def quaternion_from_matrix(rotation: Float[np.ndarray, "P 3 3"]) -> Float[np.ndarray, "P 4"]:
    """Unit quaternions (wxyz) of proper rotation matrices."""
    m = rotation
    trace = np.trace(m, axis1=1, axis2=2)
    # The four ways to solve for a quaternion; the one with the largest divisor is accurate everywhere.
    squares = np.stack([trace, m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]], 1)
    best = squares.argmax(1)
    a, b, c = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    d, e, f = m[:, 1, 0] + m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] + m[:, 1, 2]
    diagonal = 1.0 - trace[:, None] + 2.0 * np.stack([m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]], 1)
    rows = np.stack(
        [
            np.stack([1.0 + trace, a, b, c], 1),
            np.stack([a, diagonal[:, 0], d, e], 1),
            np.stack([b, d, diagonal[:, 1], f], 1),
            np.stack([c, e, f, diagonal[:, 2]], 1),
        ],
        axis=1,
    )
    wxyz = rows[np.arange(len(m)), best]
    return wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)


def rotate(wxyz: Float[np.ndarray, " 4"], points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Points turned by one unit quaternion."""
    w, u = wxyz[0], wxyz[1:]
    cross = np.cross(u, points)
    return points + 2.0 * (w * cross + np.cross(u, cross))
