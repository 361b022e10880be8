"""The shapes of the head and the body, link by link. Shapes are ours; README.md says where sizes come from.

Neck and head are drawn in their own frames, the others in the standing frame (x forward, y left, z up, floor at 0, all
joints at zero), and moved into their link's frame by generate.py.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from modelling.palette import BLACK, DARK, GREY, LED, LIGHT, SCREEN, WHITE
from modelling.round import revolve
from modelling.surfaces import Y_AXIS, Array, Colour, LobedLoft, Loft, Piece, body, disc_decal, ellipsoid, shell, slab
from scipy.interpolate import PchipInterpolator

PI = np.pi


def ramp(*knots: tuple[float, float]) -> Callable[[Array], Array]:
    """Smooth function through (z, value) knots in rising z, which never overshoots; constant outside them."""
    z, value = np.asarray(knots, float).T
    curve = PchipInterpolator(z, value)
    return lambda at: curve(np.clip(at, z[0], z[-1]))


def panel(
    loft: Loft,
    colour: Colour,
    size: tuple[int, int],
    heights: tuple[float, float],
    first: Callable[[Array], Array],
    last: Callable[[Array], Array],
    lip: float = 0.004,
    raised: float = 0.0,
) -> Piece:
    """A shell between two heights and two borders given as angles over the height."""
    span = (float(loft.at_height(heights[0])), float(loft.at_height(heights[1])))
    return shell(loft, colour, size, span, lambda v: (first(loft.height(v)), last(loft.height(v))), lip, raised)


def neck() -> list[Piece]:
    """Link Neck, in its own frame: a slim dark column with a collar."""
    column = [(0.0, -0.05), (0.037, -0.05), (0.037, -0.012), (0.030, -0.004), (0.030, 0.03), (0.030, 0.045), (0, 0.045)]
    return [revolve(column, DARK, 30, 16)]


def flared(skull: Piece) -> Piece:
    """The skull drawn out sideways to a flat seat for each ear."""
    x, y, z = skull.vertices.T
    ring = np.hypot(x + 0.004, z - 0.113)
    share = np.clip((0.082 - ring) / (0.082 - 0.034), 0, 1)
    share = share * share * (3 - 2 * share)
    seat = np.where(np.abs(y) > 0.02, share, 0) * (0.1005 * np.sign(y) - y)
    return Piece(skull.vertices + np.column_stack([0 * x, seat, 0 * z]), skull.faces, skull.colour)


def head() -> list[Piece]:
    """Link Head, in its own frame: skull, eyes, mouth, camera, touch strip, ears."""
    skull = Loft(
        [
            (0.0030, 0.022, 0.0, 0.0, 0.0, 2.0),
            (0.0030, 0.022, 0.024, 0.026, 0.022, 2.0),
            (0.0080, 0.020, 0.050, 0.052, 0.040, 2.0),
            (0.0380, 0.008, 0.082, 0.076, 0.064, 2.1),
            (0.0760, 0.002, 0.099, 0.096, 0.082, 2.15),
            (0.1150, 0.000, 0.104, 0.106, 0.096, 2.2),
            (0.1520, 0.000, 0.103, 0.109, 0.098, 2.15),
            (0.1880, 0.000, 0.092, 0.098, 0.080, 2.05),
            (0.2160, -0.001, 0.064, 0.068, 0.058, 2.0),
            (0.2201, -0.002, 0.028, 0.030, 0.028, 2.0),
            (0.2201, -0.002, 0.0, 0.0, 0.0, 2.0),
        ]
    )
    pieces = [flared(body(skull, WHITE, (44, 64)))]
    forward = (1.0, 0.0, 0.0)
    for side in (1.0, -1.0):
        eye, look = (0.0, 0.026 * side, 0.119), (1.0, 0.15 * side, 0.0)
        rim = [(1.0, -0.002), (0.985, 0.0005), (0.95, 0.0009), (0.86, 0.0006), (0.5, 0.0004), (0.0, 0.0004)]
        ring = [(0.925, 0.0), (0.915, 0.0012), (0.90, 0.0016), (0.80, 0.0016), (0.785, 0.0012), (0.775, 0.0)]
        lens = [(0.74, 0.0), (0.73, 0.0012), (0.70, 0.0018), (0.5, 0.0028), (0.25, 0.0034), (0.0, 0.0036)]
        glint = [(1.0, 0.0020), (0.8, 0.0042), (0.0, 0.0046)]
        pieces += [
            disc_decal(skull, eye, look, (0.0225, 0.0255), rim, DARK),
            disc_decal(skull, eye, look, (0.0225, 0.0255), ring, LED),
            disc_decal(skull, eye, look, (0.0225, 0.0255), lens, BLACK),
            disc_decal(skull, (0.0, 0.026 * side - 0.005, 0.127), look, (0.0036, 0.0042), glint, WHITE, 16),
        ]
        ear = [(0.040, -0.012), (0.0405, -0.002), (0.0398, 0.005), (0.0365, 0.0082), (0.0335, 0.0065), (0.032, 0.0045),
               (0.026, 0.0040)]  # fmt: skip
        glow = [(0.0322, 0.003), (0.0318, 0.0055), (0.0305, 0.0062), (0.0290, 0.0055), (0.0286, 0.003)]
        speaker = [(0.0265, 0.003), (0.026, 0.0056), (0.0245, 0.0064), (0.016, 0.0056), (0.008, 0.0060), (0.0, 0.0062)]
        parts = [revolve(ear, WHITE, 36, 16), revolve(glow, LED, 36), revolve(speaker, LIGHT, 30, 11)]
        parts = [part.moved(Y_AXIS, (-0.004, 0.1005, 0.113)) for part in parts]
        pieces += parts if side > 0 else [part.mirrored() for part in parts]
    dot = [(1.0, -0.001), (0.9, 0.0006), (0.6, 0.0010), (0.0, 0.0012)]
    pieces.append(disc_decal(skull, (0.0, 0.0, 0.163), forward, (0.0058, 0.0058), dot, BLACK, 24))
    pieces.append(disc_decal(skull, (0.0, 0.0, 0.059), forward, (0.0145, 0.0036), dot, BLACK, 32, 0.0035))
    strip = [(1.0, -0.001), (0.97, 0.0004), (0.9, 0.0006), (0.6, 0.0006), (0.3, 0.0006), (0.0, 0.0006)]
    pieces.append(disc_decal(skull, (0.0, 0.0, 0.12), (0.001, 0.0, 1.0), (0.013, 0.055), strip, DARK, 40))
    return pieces


def torso() -> list[Piece]:
    """Link torso, standing frame: dark core, white chest, back and shoulder shells, collar, tablet on its bracket."""
    trunk = Loft(
        [
            (0.686, -0.004, 0.0, 0.0, 0.0, 2.3),
            (0.686, -0.004, 0.050, 0.050, 0.052, 2.3),
            (0.694, -0.006, 0.064, 0.064, 0.072, 2.3),
            (0.740, -0.012, 0.082, 0.090, 0.094, 2.4),
            (0.795, -0.020, 0.098, 0.110, 0.113, 2.5),
            (0.850, -0.026, 0.104, 0.116, 0.121, 2.6),
            (0.900, -0.032, 0.098, 0.112, 0.124, 2.6),
            (0.940, -0.040, 0.080, 0.098, 0.124, 2.4),
            (0.966, -0.042, 0.062, 0.076, 0.108, 2.2),
            (0.974, -0.038, 0.042, 0.046, 0.062, 2.0),
            (0.974, -0.038, 0.0, 0.0, 0.0, 2.0),
        ]
    )
    pieces = [body(trunk, DARK, (24, 40), offset=-0.0035)]
    front = ramp((0.712, 0.10), (0.716, 0.42), (0.726, 0.70), (0.745, 0.88), (0.80, 1.00), (0.87, 1.04), (0.91, 1.16),
                 (0.936, 1.46))  # fmt: skip
    rear = ramp((0.690, 0.92), (0.76, 0.98), (0.86, 1.00), (0.905, 1.12), (0.936, 1.42))
    pieces.append(panel(trunk, WHITE, (32, 30), (0.712, 0.936), lambda z: -front(z), front))
    pieces.append(panel(trunk, WHITE, (26, 30), (0.692, 0.936), lambda z: PI - rear(z), lambda z: PI + rear(z)))
    gap = ramp((0.94, 0.34), (0.968, 0.62))
    for turn in (0.0, PI):  # the yoke: from collar to shoulder, open in front and behind
        pieces.append(
            panel(
                trunk, WHITE, (15, 32), (0.9385, 0.968), lambda z, t=turn: t + gap(z), lambda z, t=turn: t + PI - gap(z)
            )
        )
    collar = [(0.062, 0.958), (0.058, 0.968), (0.050, 0.972), (0.041, 0.978), (0.038, 0.986), (0.030, 0.986)]
    pieces.append(revolve(collar, GREY, 36, 14).moved(shift=(-0.038, 0.0, 0.0)))
    return pieces + tablet()


def tablet() -> list[Piece]:
    """The 246 x 175 x 14.5 mm tablet at Tablet_frame, its screen facing forward and 30 degrees up."""
    tilt = PI / 6
    # Slabs are built about z with height along x: turn z to the screen's normal and x up along the screen.
    normal, up = np.array([np.cos(tilt), 0, np.sin(tilt)]), np.array([-np.sin(tilt), 0, np.cos(tilt)])
    rotation = np.stack([up, np.cross(normal, up), normal], axis=1)
    centre = (0.0839249, 0.0, 0.82 + 0.06251)
    case = [(0.030, -0.0072), (0.008, -0.0070), (0.003, -0.0058), (0.0006, -0.0030), (0.0, 0.0), (0.0006, 0.0030),
            (0.002, 0.0056), (0.005, 0.0070), (0.0065, 0.00725), (0.030, 0.00725)]  # fmt: skip
    glass = [(0.0012, 0.0070), (0.0003, 0.0074), (0.0, 0.0077), (0.0004, 0.0080), (0.003, 0.0081), (0.02, 0.0081)]
    mount = Loft(
        [
            (-0.055, 0.0, 0.0, 0.0, 0.0, 3.0),
            (-0.055, 0.0, 0.020, 0.020, 0.026, 3.0),
            (-0.040, 0.0, 0.020, 0.020, 0.026, 3.0),
            (-0.020, 0.0, 0.022, 0.022, 0.030, 3.0),
            (-0.0068, 0.0, 0.034, 0.034, 0.050, 3.0),
        ]
    )
    parts = [
        slab(0.246, 0.175, case, 0.016, BLACK),
        slab(0.217, 0.136, glass, 0.003, SCREEN),
        body(mount, DARK, (16, 32)),
    ]
    return [part.moved(rotation, centre) for part in parts]


def hip() -> list[Piece]:
    """Link Hip, standing frame: the grey waist, round about the pitch axis below it."""
    waist = Loft(
        [
            (0.655, 0.0, 0.060, 0.064, 0.062, 2.4),
            (0.668, 0.0, 0.052, 0.056, 0.054, 2.4),
            (0.685, -0.002, 0.046, 0.050, 0.048, 2.4),
            (0.700, -0.004, 0.046, 0.050, 0.048, 2.4),
            (0.730, -0.006, 0.046, 0.050, 0.048, 2.4),
        ]
    )
    pieces = [body(waist, DARK, (16, 44))]
    pieces.append(ellipsoid((0.082, 0.094, 0.082), GREY, (22, 36), 2.2).moved(shift=(0.0, 0.0, 0.602)))
    return pieces


def pelvis() -> list[Piece]:
    """Link Pelvis, standing frame: two white thigh shells around a dark core."""
    thigh = Loft(
        [
            (0.352, 0.004, 0.0, 0.0, 0.0, 2.3),
            (0.352, 0.004, 0.052, 0.050, 0.084, 2.3),
            (0.362, 0.004, 0.060, 0.058, 0.094, 2.3),
            (0.430, 0.008, 0.074, 0.066, 0.101, 2.3),
            (0.500, 0.010, 0.088, 0.082, 0.112, 2.3),
            (0.560, 0.008, 0.092, 0.098, 0.122, 2.3),
            (0.610, 0.004, 0.086, 0.098, 0.122, 2.3),
            (0.650, 0.000, 0.072, 0.082, 0.106, 2.2),
            (0.672, 0.000, 0.052, 0.060, 0.080, 2.0),
            (0.680, 0.000, 0.030, 0.036, 0.052, 2.0),
        ]
    )
    top = float(thigh.at_height(0.575))
    pieces = [body(thigh, DARK, (20, 44), (0.0, top), offset=-0.004)]
    front = ramp((0.355, 0.10), (0.55, 0.11), (0.58, 0.22), (0.605, 0.48), (0.635, 0.86), (0.655, 1.10), (0.668, 1.38))
    rear = ramp((0.355, 0.05), (0.51, 0.06), (0.555, 0.15), (0.59, 0.40), (0.63, 0.80), (0.655, 1.08), (0.668, 1.36))
    for inner in (False, True):  # outside and inside of the shells, which shows through the opening at the waist
        colour, size, raised = (GREY, (18, 16), -0.0042) if inner else (WHITE, (36, 26), 0.0)
        left = panel(thigh, colour, size, (0.357, 0.668), front, lambda z: PI - rear(z), raised=raised)
        if inner:
            left = Piece(left.vertices, left.faces[:, ::-1], left.colour)
        pieces += [left, left.mirrored()]
    return pieces


def tibia() -> list[Piece]:
    """Link Tibia, standing frame: knee, flared skirt with its panels, three-lobed base, wheels."""
    skirt = LobedLoft(
        [
            (0.030, -0.010, 0.0, 0.0, 0.11, 0.030),
            (0.030, -0.010, 0.160, 0.175, 0.11, 0.030),
            (0.030, -0.010, 0.206, 0.224, 0.12, 0.030),
            (0.052, -0.010, 0.2145, 0.2335, 0.12, 0.028),
            (0.095, -0.010, 0.2145, 0.2335, 0.12, 0.020),
            (0.140, -0.016, 0.200, 0.216, 0.11, 0.004),
            (0.172, -0.028, 0.150, 0.166, 0.09, 0.0),
            (0.205, -0.030, 0.112, 0.122, 0.06, 0.0),
            (0.255, -0.018, 0.084, 0.102, 0.03, 0.0),
            (0.300, -0.004, 0.066, 0.094, 0.0, 0.0),
            (0.321, 0.000, 0.058, 0.088, 0.0, 0.0),
            (0.326, 0.000, 0.046, 0.074, 0.0, 0.0),
            (0.326, 0.000, 0.0, 0.0, 0.0, 0.0),
        ]
    )
    pieces = [body(skirt, GREY, (28, 54), offset=-0.004)]
    front = ramp((0.03, 0.84), (0.11, 0.82), (0.14, 0.70), (0.158, 0.46), (0.172, 0.24), (0.19, 0.12), (0.22, 0.085),
                 (0.33, 0.10))  # fmt: skip
    rear = ramp((0.03, 0.36), (0.20, 0.34), (0.33, 0.40))
    left = panel(skirt, WHITE, (36, 30), (0.0335, 0.3225), front, lambda z: PI - rear(z), 0.005)
    pieces += [left, left.mirrored()]
    knee = Loft([(0.30, 0.003, 0.040, 0.042, 0.070, 2.6), (0.325, 0.003, 0.050, 0.050, 0.084, 2.6),
                 (0.352, 0.003, 0.052, 0.050, 0.086, 2.6), (0.392, 0.003, 0.040, 0.040, 0.070, 2.4)])  # fmt: skip
    pieces.append(body(knee, DARK, (12, 48)))
    for x, y, yaw in ((0.09, 0.155, 1.07517), (0.09, -0.155, -1.07517), (-0.17, 0.0, PI)):
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        pieces.append(ellipsoid((0.036, 0.07, 0.07), DARK, (12, 20), 2.3).moved(turn, (x, y, 0.07)))
    return pieces
