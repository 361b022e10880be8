"""Smooth surfaces as triangle grids: lofts, thick shells cut from them, decals, revolved profiles, tubes, slabs.

Lengths in metres. A surface maps (u, v) to a point: u is the angle around its axis, counter-clockwise seen from the
axis' tip, u = 0 in front; v in [0, 1] runs along the axis. Edges are rounded in the geometry itself, so that
vertex normals computed by any viewer shade well and no crease depends on duplicated vertices.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import BSpline

Array = np.ndarray
Colour = tuple[int, int, int]
GRID = 2.0**-17  # vertices are rounded to 7.6 micrometres: exact in float32, and the same bytes on every processor
X_AXIS = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Turns a surface that runs along z into one along x (its front then faces -z)."""
Y_AXIS = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns a surface that runs along z into one along y (its front still faces x)."""


@dataclass(frozen=True)
class Piece:
    """Triangles of one colour (sRGB bytes)."""

    vertices: Array  # (V, 3)
    faces: Array  # (F, 3), counter-clockwise seen from outside
    colour: Colour

    def moved(self, rotation: Array | None = None, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> Piece:
        turned = self.vertices if rotation is None else self.vertices @ rotation.T
        return Piece(turned + np.asarray(shift), self.faces, self.colour)

    def mirrored(self) -> Piece:
        """Left becomes right: y changes sign, and the winding with it."""
        return Piece(self.vertices * (1.0, -1.0, 1.0), self.faces[:, ::-1], self.colour)


class Surface(Protocol):
    def __call__(self, u: Array, v: Array) -> Array: ...


def spline(points: Sequence[Sequence[float]]) -> Callable[[Array], Array]:
    """Clamped cubic B-spline over [0, 1] with these control points (K, C): twice smooth, and never overshoots."""
    control = np.asarray(points, float)
    degree = min(3, len(control) - 1)
    knots = np.concatenate([np.zeros(degree), np.linspace(0, 1, len(control) - degree + 1), np.ones(degree)])
    return BSpline(knots, control, degree)


class Loft:
    """Superelliptic sections along z, their sizes smoothed by a spline.

    Keys are control points (z, centre x, depth in front, depth behind, half-width, exponent): exponent 2 is an
    ellipse, 4 nearly a rectangle. An end closes smoothly if its last two keys share z and the last has size 0.
    """

    def __init__(self, keys: Sequence[Sequence[float]]) -> None:
        self.section = spline(keys)
        self.table_v = np.linspace(0, 1, 4001)
        self.table_z = np.maximum.accumulate(self.section(self.table_v)[:, 0])

    def __call__(self, u: Array, v: Array) -> Array:
        z, centre, front, back, side, exponent = np.moveaxis(self.section(np.asarray(v, float)), -1, 0)
        cosine, sine = np.cos(u), np.sin(u)
        depth = np.where(cosine >= 0, front, back)
        x = centre + depth * np.sign(cosine) * np.abs(cosine) ** (2 / exponent)
        y = side * np.sign(sine) * np.abs(sine) ** (2 / exponent)
        return np.stack(np.broadcast_arrays(x, y, z), axis=-1)

    def height(self, v: Array) -> Array:
        """z of the section at v."""
        return self.section(np.asarray(v, float))[..., 0]

    def at_height(self, z: Array | float) -> Array:
        """v of the section at height z."""
        return np.asarray(np.interp(z, self.table_z, self.table_v))

    def inside(self, points: Array) -> Array:
        """Whether points (..., 3) lie inside the loft."""
        z = points[..., 2]
        _, centre, front, back, side, exponent = np.moveaxis(self.section(self.at_height(z)), -1, 0)
        x = points[..., 0] - centre
        depth = np.maximum(np.where(x >= 0, front, back), 1e-9)
        level = np.abs(x / depth) ** exponent + np.abs(points[..., 1] / np.maximum(side, 1e-9)) ** exponent
        return (level < 1) & (z > self.table_z[0]) & (z < self.table_z[-1])


class LobedLoft(Loft):
    """Sections with three rounded lobes at +-60 and 180 degrees, as of a base on three wheels.

    Keys: (z, centre x, radius along x, radius along y, lobe depth, lift of the lower edge in front). A lobe depth up to
    0.125 keeps a section convex.
    """

    def __call__(self, u: Array, v: Array) -> Array:
        z, centre, along_x, along_y, lobe, lift = np.moveaxis(self.section(np.asarray(v, float)), -1, 0)
        radius = 1 - lobe * np.cos(3 * u)
        x = centre + along_x * radius * np.cos(u)
        y = along_y * radius * np.sin(u)
        z = z + lift * (1 + np.cos(3 * u)) / 2 * ((1 + np.cos(u)) / 2) ** 2
        return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def normals(surface: Surface, u: Array, v: Array) -> Array:
    """Outward unit normals by central differences (one-sided at the ends)."""
    step = 1e-4
    along_u = surface(u + step, v) - surface(u - step, v)
    along_v = surface(u, np.minimum(v + step, 1.0)) - surface(u, np.maximum(v - step, 0.0))
    cross = np.cross(along_u, along_v)
    length = np.linalg.norm(cross, axis=-1, keepdims=True)
    return cross / np.maximum(length, 1e-15)


def grid(points: Array, colour: Colour, closed: bool = True) -> Piece:
    """Triangles of a grid of points (rows, columns, 3); closed: the last column meets the first."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    if closed:
        index = np.concatenate([index, index[:, :1]], axis=1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    return Piece(points.reshape(-1, 3), faces, colour)


def body(
    surface: Surface, colour: Colour, size: tuple[int, int], span: tuple[float, float] = (0.0, 1.0), offset: float = 0.0
) -> Piece:
    """The whole surface all around, over a span of v; offset moves it outward."""
    v, u = np.meshgrid(np.linspace(*span, size[0]), np.arange(size[1]) * 2 * np.pi / size[1], indexing="ij")
    return grid(surface(u, v) + offset * normals(surface, u, v) if offset else surface(u, v), colour)


def shell(
    surface: Surface,
    colour: Colour,
    size: tuple[int, int],
    span: tuple[float, float],
    borders: Callable[[Array], tuple[Array, Array]],
    lip: float = 0.004,
    raised: float = 0.0,
) -> Piece:
    """A panel on the surface between two borders u0(v), u1(v), with rounded edges turned inward by `lip`."""
    # Two extra rows and columns at each border make the lip; a little inset keeps its shading off the panel.
    inset = np.array([0.0, 0.0, 0.0, 0.012])
    depth = np.array([1.0, 0.35, 0.08, 0.0]) * lip
    inner = (1 - np.cos(np.linspace(0.3, np.pi - 0.3, size[0] - 6))) / 2
    t = np.concatenate([inset, inner[1:-1], 1 - inset[::-1]])
    inner = np.linspace(0, 1, size[1] - 6)
    s = np.concatenate([inset, inner[1:-1], 1 - inset[::-1]])
    edge_t = np.concatenate([depth, np.zeros(len(t) - 8), depth[::-1]])
    edge_s = np.concatenate([depth, np.zeros(len(s) - 8), depth[::-1]])
    v = np.repeat((span[0] + (span[1] - span[0]) * t)[:, None], len(s), axis=1)
    first, last = borders(v[:, 0])
    u = first[:, None] + (last - first)[:, None] * s[None, :]
    sunk = np.maximum(edge_t[:, None], edge_s[None, :])
    return grid(surface(u, v) + (raised - sunk)[..., None] * normals(surface, u, v), colour, closed=False)


def decal(
    loft: Loft, origins: Array, direction: Array | Sequence[float], heights: Array, colour: Colour, closed: bool
) -> Piece:
    """A grid of points (rows, columns, 3) inside a loft thrown onto it along a direction, and raised by `heights`."""
    ray = np.asarray(direction, float) / np.linalg.norm(direction)
    near, far = np.zeros(origins.shape[:2]), np.full(origins.shape[:2], 0.4)
    for _ in range(45):
        middle = (near + far) / 2
        inside = loft.inside(origins + middle[..., None] * ray)
        near, far = np.where(inside, middle, near), np.where(inside, far, middle)
    return grid(origins + (near + heights)[..., None] * ray, colour, closed)


def disc_decal(
    loft: Loft,
    centre: Sequence[float],
    direction: Sequence[float],
    radii: tuple[float, float],
    profile: Sequence[tuple[float, float]],
    colour: Colour,
    columns: int = 40,
    bend: float = 0.0,
) -> Piece:
    """An elliptic disc or ring on a loft: profile rows are (fraction of the radii, height), from the rim inward.

    The radii are along the two directions across the ray: sideways (horizontal) and upward; bend lifts both ends.
    """
    ray = np.asarray(direction, float) / np.linalg.norm(direction)
    sideways = np.cross((0.0, 0.0, 1.0), ray)
    sideways /= np.linalg.norm(sideways)
    upward = np.cross(ray, sideways)
    angle = np.arange(columns) * 2 * np.pi / columns
    circle = radii[0] * np.cos(angle)[:, None] * sideways + radii[1] * np.sin(angle)[:, None] * upward
    fraction, height = np.asarray(profile, float).T
    origins = np.asarray(centre) + fraction[:, None, None] * circle
    origins = origins + bend * (fraction[:, None] * np.cos(angle))[..., None] ** 2 * upward
    return decal(loft, origins, ray, np.repeat(height[:, None], columns, axis=1), colour, True)


def ellipsoid(radii: Sequence[float], colour: Colour, size: tuple[int, int] = (18, 28), power: float = 2.0) -> Piece:
    """A superellipsoid about the origin: power 2 is an ellipsoid, larger ones are boxier."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, size[0])[:, None]
    longitude = (np.arange(size[1]) * 2 * np.pi / size[1])[None, :]

    def soft(value: Array) -> Array:
        return np.sign(value) * np.abs(value) ** (2 / power)

    ring = soft(np.where(np.abs(latitude) > 1.5707, 0.0, np.cos(latitude)))
    x, y = ring * soft(np.cos(longitude)), ring * soft(np.sin(longitude))
    return grid(np.stack(np.broadcast_arrays(x, y, soft(np.sin(latitude))), -1) * np.asarray(radii), colour)


def slab(
    width: float, height: float, rows: Sequence[tuple[float, float]], corner: float, colour: Colour, straight: int = 8
) -> Piece:
    """A flat body with rounded corners about z, width along y, height along x.

    Rows are (inset of the outline, z) from the lower face over the rim to the upper face; both faces are closed.
    """
    arc = np.linspace(0, np.pi / 2, 6)
    rings = []
    for inset, z in rows:
        radius = max(corner - inset, 0.2 * corner)
        reach = np.array([height / 2, width / 2]) - inset - radius
        ends = []
        for quarter in range(4):
            turn = arc + quarter * np.pi / 2
            middle = reach * np.sign([np.cos(turn[3]), np.sin(turn[3])])
            ends.append(middle + radius * np.stack([np.cos(turn), np.sin(turn)], axis=1))
        outline = []
        for quarter in range(4):  # points along the straight sides too, so that no face is a sliver
            start, stop = ends[quarter][-1], ends[(quarter + 1) % 4][0]
            outline += [ends[quarter], start + (stop - start) * (np.arange(1, straight) / straight)[:, None]]
        flat = np.concatenate(outline)
        rings.append(np.column_stack([flat, np.full(len(flat), z)]))
    lower, upper = rings[0] * (0, 0, 1), rings[-1] * (0, 0, 1)
    return grid(np.stack([lower, *rings, upper]), colour)


def rim(low: float, high: float, edge: float, steps: int = 4) -> list[tuple[float, float]]:
    """Rows of a slab between two heights, its edges rounded."""
    turn = np.linspace(0, np.pi / 2, steps)
    inset, rise = edge * (1 - np.sin(turn)), edge * (1 - np.cos(turn))
    lower = list(zip(inset.tolist(), (low + rise).tolist(), strict=True))
    return lower + [(back, low + high - z) for back, z in reversed(lower)]


def weld(piece: Piece) -> Piece:
    """Round to the grid, join equal vertices, drop triangles without area and vertices without triangles."""
    steps = np.round(piece.vertices / GRID).astype(np.int64)
    unique, index = np.unique(steps, axis=0, return_inverse=True)
    faces = index.reshape(-1)[piece.faces]
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    corners = unique[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    faces = faces[distinct & (area > 0)]
    used, faces = np.unique(faces, return_inverse=True)
    return Piece(unique[used] * GRID, faces.reshape(-1, 3), piece.colour)
