"""What a description is written from: joints as text, meshes as pieces of one colour each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from modelling.surfaces import Piece, weld

X, Y, Z = ("1", "0", "0"), ("0", "1", "0"), ("0", "0", "1")
ZERO = ("0", "0", "0")


@dataclass(frozen=True)
class Joint:
    """One joint of the tree; limits are (lower, upper, effort, velocity) in SI units, None if it is fixed."""

    name: str
    parent: str
    child: str
    xyz: tuple[str, str, str]
    rpy: tuple[str, str, str] = ("0", "0", "0")
    axis: tuple[str, str, str] | None = None
    limits: tuple[str, str, str, str] | None = None
    slides: bool = False
    mimic: str | None = None
    """The joint that this one follows."""

    @property
    def kind(self) -> str:
        if self.axis is None:
            return "fixed"
        return "prismatic" if self.slides else "revolute"


@dataclass(frozen=True)
class Inertial:
    """What a link weighs [kg], where its centre of mass is [m], and the size of the solid that stands for it [m].

    The solid is a uniform elliptic cylinder: length along x, full width along y, full height along z.
    """

    mass: float
    centre: tuple[float, float, float]
    size: tuple[float, float, float]

    @property
    def moments(self) -> tuple[float, float, float]:
        """Principal moments of inertia about the centre of mass, along x, y and z [kg m^2]."""
        length, width, height = (extent * extent for extent in self.size)
        return (
            self.mass * (width + height) / 16.0,
            self.mass * (length / 12.0 + height / 16.0),
            self.mass * (length / 12.0 + width / 16.0),
        )

    def lines(self) -> list[str]:
        """The <inertial> of a description."""
        xx, yy, zz = (f"{moment:.4g}" for moment in self.moments)
        return [
            "    <inertial>",
            f'      <origin xyz="{" ".join(f"{value:g}" for value in self.centre)}" rpy="0 0 0"/>',
            f'      <mass value="{self.mass:g}"/>',
            f'      <inertia ixx="{xx}" ixy="0" ixz="0" iyy="{yy}" iyz="0" izz="{zz}"/>',
            "    </inertial>",
        ]


def ply(pieces: list[Piece]) -> bytes:
    """Binary PLY with a colour (sRGB) at every vertex."""
    welded = [weld(piece) for piece in pieces]
    start = np.cumsum([0, *(len(piece.vertices) for piece in welded)])
    vertices = np.empty(start[-1], dtype=[("xyz", "<f4", 3), ("rgba", "u1", 4)])
    vertices["xyz"] = np.concatenate([piece.vertices for piece in welded])
    vertices["rgba"] = np.concatenate([np.tile([*piece.colour, 255], (len(piece.vertices), 1)) for piece in welded])
    indices = np.concatenate([piece.faces + first for piece, first in zip(welded, start[:-1], strict=True)])
    faces = np.empty(len(indices), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, indices
    properties = [f"property float {axis}" for axis in "xyz"]
    properties += [f"property uchar {colour}" for colour in ("red", "green", "blue", "alpha")]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *properties]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()


def urdf(
    name: str,
    root: str,
    joints: Sequence[Joint],
    meshes: Mapping[str, str],
    inertials: Mapping[str, Inertial] | None = None,
) -> str:
    """The text of the description of robot `name`; a link not in `meshes` is only a frame.

    Only the links in `inertials` weigh anything.
    `meshes` names a mesh of the robot's own folder, or the file of another robot's relative to this one's.
    """
    lines = [
        '<?xml version="1.0"?>',
        "<!-- Written by generate.py; edit that. Sources of the numbers: README.md. -->",
        f'<robot name="{name}">',
    ]
    for link in [root, *(joint.child for joint in joints)]:
        if link not in meshes:
            lines.append(f'  <link name="{link}"/>')
            continue
        mesh = meshes[link]
        lines += [
            f'  <link name="{link}">',
            f'    <visual name="{link}_visual">',
            "      <geometry>",
            f'        <mesh filename="{mesh if "/" in mesh else f"meshes/{mesh}.ply"}"/>',
            "      </geometry>",
            "    </visual>",
            *(inertials[link].lines() if inertials and link in inertials else []),
            "  </link>",
        ]
    for joint in joints:
        lines += [
            f'  <joint name="{joint.name}" type="{joint.kind}">',
            f'    <parent link="{joint.parent}"/>',
            f'    <child link="{joint.child}"/>',
            f'    <origin xyz="{" ".join(joint.xyz)}" rpy="{" ".join(joint.rpy)}"/>',
        ]
        if joint.axis is not None and joint.limits is not None:
            lower, upper, effort, velocity = joint.limits
            lines += [
                f'    <axis xyz="{" ".join(joint.axis)}"/>',
                f'    <limit lower="{lower}" upper="{upper}" effort="{effort}" velocity="{velocity}"/>',
            ]
        if joint.mimic is not None:
            lines.append(f'    <mimic joint="{joint.mimic}"/>')
        lines.append("  </joint>")
    return "\n".join([*lines, "</robot>", ""])
