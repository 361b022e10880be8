"""The shapes of the left arm and hand, each in its link's frame: x along the arm, y to the left, palm towards -z."""

from __future__ import annotations

import numpy as np
from modelling.palette import DARK, GREY, LIGHT, WHITE
from modelling.round import revolve, tube
from modelling.surfaces import X_AXIS, Y_AXIS, Array, Colour, Loft, Piece, body, ellipsoid, shell, spline

HAND_OPENING = 0.7
"""The value of the hand joint for which the fingers are drawn: relaxed, ready to be shaken."""
FINGER_TURN = 0.872665  # finger joint angle [rad] per unit of hand opening
FINGER_CURL = -1.0472  # of the second and third phalanx when the hand is closed [rad]
# Origin (x, y, z) and roll, pitch, yaw of each finger's first joint in the left wrist's frame, and phalanx lengths.
FINGERS = {
    "index": ((0.0821, -0.0268, 0.004), (1.74402, 1.04064, -0.0334335), (0.018, 0.018, 0.0125)),
    "middle": ((0.0873, -0.0073, 0.006), (1.5708, 1.0472, -0.061086), (0.018, 0.018, 0.0125)),
    "ring": ((0.0833, 0.0123, 0.004), (1.46636, 1.04483, -0.029314), (0.018, 0.018, 0.0125)),
    "little": ((0.074, 0.0309, 0.0), (1.39757, 1.04064, 0.0683394), (0.018, 0.018, 0.0125)),
    "thumb": ((0.0482, -0.0357, -0.0199), (-1.95836, 0.60626, 0.533978), (0.022, 0.0125)),
}


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll), as URDF has it."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def about_z(angle: float) -> Array:
    return rotation(0.0, 0.0, angle)


def shoulder() -> list[Piece]:
    """Link LShoulder: the joint's drum between torso and arm."""
    drum = ellipsoid((0.040, 0.042, 0.036), DARK, (13, 24), 2.3)
    hub = [(0.0, -0.050), (0.030, -0.050), (0.034, -0.040), (0.034, 0.0), (0.0, 0.0)]
    return [drum, revolve(hub, GREY, 26, 10).moved(Y_AXIS)]


def along_arm(loft: Loft, colour: Colour, size: tuple[int, int], outward: float = 0.0) -> Piece:
    """A closed loft along x, moved away from the body."""
    return body(loft, colour, size).moved(X_AXIS, (0.0, outward, 0.0))


def biceps() -> list[Piece]:
    """Link LBicep: the white upper arm with its rounded shoulder, and the grey bracket of the elbow."""
    arm = Loft(
        [
            (-0.043, 0.0, 0.0, 0.0, 0.0, 2.1),
            (-0.043, 0.0, 0.020, 0.020, 0.014, 2.1),
            (-0.034, 0.0, 0.038, 0.038, 0.029, 2.1),
            (-0.006, 0.0, 0.048, 0.048, 0.040, 2.1),
            (0.025, 0.0, 0.046, 0.046, 0.040, 2.2),
            (0.060, 0.0, 0.042, 0.042, 0.038, 2.2),
            (0.105, 0.0, 0.037, 0.037, 0.036, 2.2),
            (0.142, 0.0, 0.035, 0.034, 0.034, 2.2),
            (0.147, 0.0, 0.030, 0.030, 0.030, 2.2),
            (0.147, 0.0, 0.0, 0.0, 0.0, 2.2),
        ]
    )
    bracket = Loft(
        [
            (0.138, 0.0, 0.0, 0.0, 0.0, 2.0),
            (0.138, 0.0, 0.030, 0.030, 0.030, 2.0),
            (0.156, 0.0, 0.0335, 0.0335, 0.0335, 2.0),
            (0.172, 0.0, 0.0325, 0.0325, 0.0325, 2.0),
            (0.174, 0.0, 0.026, 0.026, 0.026, 2.0),
            (0.174, 0.0, 0.0, 0.0, 0.0, 2.0),
        ]
    )
    return [along_arm(arm, WHITE, (26, 28), 0.017), along_arm(bracket, GREY, (14, 28), 0.0155)]


def elbow() -> list[Piece]:
    """Link LElbow: a dark ball."""
    return [ellipsoid((0.0325, 0.0325, 0.0325), DARK, (16, 24), 2.0)]


def forearm() -> list[Piece]:
    """Link LForeArm: grey collar at the elbow and the first part of the sleeve."""
    collar = Loft([(0.014, 0, 0.0, 0.0, 0.0, 2), (0.014, 0, 0.022, 0.022, 0.022, 2), (0.020, 0, 0.031, 0.031, 0.031, 2),
                   (0.040, 0, 0.031, 0.031, 0.031, 2)])  # fmt: skip
    sleeve = Loft(
        [
            (0.026, 0.0, 0.0, 0.0, 0.0, 2.0),
            (0.026, 0.0, 0.028, 0.028, 0.028, 2.0),
            (0.029, 0.0, 0.0335, 0.0335, 0.0335, 2.0),
            (0.050, 0.0, 0.034, 0.0335, 0.0335, 2.0),
            (0.080, 0.0, 0.036, 0.035, 0.0355, 2.0),
            (0.0865, 0.0, 0.036, 0.035, 0.0355, 2.0),
            (0.0875, 0.0, 0.033, 0.032, 0.0330, 2.0),
            (0.0875, 0.0, 0.0, 0.0, 0.0, 2.0),
        ]
    )
    return [along_arm(collar, GREY, (10, 28)), along_arm(sleeve, WHITE, (20, 32))]


def finger(name: str) -> Piece:
    """A finger bent as for HAND_OPENING, thicker between its joints."""
    origin, angles, lengths = FINGERS[name]
    turn = FINGER_TURN * HAND_OPENING
    frame = rotation(*angles) @ about_z(turn)
    base = np.asarray(origin)
    hidden = base - frame[:, 0] * 0.014 if name == "thumb" else base - (0.014, 0.0, 0.004)
    points = [hidden, base]  # the root starts inside the palm
    for k, length in enumerate(lengths):
        if k:
            frame = frame @ about_z(FINGER_CURL + turn)
        points.append(points[-1] + frame[:, 0] * length)
    # Corners are rounded by a spline through doubled control points; the radius swells on every phalanx.
    control = [points[0]]
    for before, after in zip(points[:-1], points[1:], strict=True):
        control += [before + (after - before) * 0.3, before + (after - before) * 0.7]
    control.append(points[-1])
    t = np.linspace(0, 1, 6 * len(lengths) + 3)
    path = spline(control)(t)
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]) - 0.014
    phase = travelled / 0.018
    size = 0.0106 if name == "thumb" else 0.0092
    radii = size * (1 - 0.13 * np.clip(phase / (len(lengths) + 0.3), 0, 1)) * (1 - 0.07 * np.cos(2 * np.pi * phase))
    return tube(path, radii, LIGHT, 11)


def hand() -> list[Piece]:
    """Link l_wrist: the rest of the sleeve, palm, four fingers and a thumb."""
    glove = Loft(
        [
            (-0.0620, 0.000, 0.0, 0.0, 0.0, 2.0),
            (-0.0620, 0.000, 0.0330, 0.0320, 0.0330, 2.0),
            (-0.0610, 0.000, 0.0360, 0.0350, 0.0355, 2.0),
            (-0.0500, 0.000, 0.0365, 0.0355, 0.0365, 2.0),
            (-0.0100, 0.000, 0.0365, 0.0360, 0.0410, 2.1),
            (0.0250, 0.002, 0.0330, 0.0340, 0.0470, 2.3),
            (0.0600, 0.002, 0.0260, 0.0270, 0.0460, 2.5),
            (0.0840, 0.000, 0.0170, 0.0190, 0.0400, 2.5),
            (0.0920, 0.000, 0.0100, 0.0120, 0.0320, 2.3),
            (0.0920, 0.000, 0.0, 0.0, 0.0, 2.2),
        ]
    )
    pieces = [along_arm(glove, WHITE, (28, 30))]

    def borders(v: Array) -> tuple[Array, Array]:
        half = 0.30 + 0.62 * np.sin(np.pi * np.clip((glove.height(v) - 0.018) / 0.058, 0, 1)) ** 0.5
        return -half, half

    span = (float(glove.at_height(0.018)), float(glove.at_height(0.076)))
    pieces.append(shell(glove, GREY, (15, 15), span, borders, 0.003, 0.0012).moved(X_AXIS))
    return pieces + [finger(name) for name in FINGERS]
