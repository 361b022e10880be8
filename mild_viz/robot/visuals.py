"""What a robot looks like: one coloured mesh per drawn link, from the visuals of its description."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from mild_viz.errors import UserError
from mild_viz.robot.description import Description

if TYPE_CHECKING:
    import trimesh

logger = logging.getLogger(__name__)

GREY = (178, 178, 178, 255)
"""Colour of a visual without material (RGBA)."""


class Part(NamedTuple):
    """A piece of a link, in the link's frame: V vertices [m], F triangles."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    normals: Float[np.ndarray, "V 3"]
    colors: UInt8[np.ndarray, "V 4"]


def drawn_links(description: Description) -> tuple[str, ...]:
    """Links that have a visual, in the order of the file."""
    return tuple(link.name for link in description.urdf.robot.links if link.visuals)


def resolve_file(urdf: Path, name: str) -> Path | None:
    """The file that a mesh's `filename` means, or None where there is none.

    `package://name/rest` is looked for beside the description and in the folders above it, as `name/rest`
    and as `rest` inside a folder of that name; plain and file:// names are relative to the description.
    """
    scheme, _, rest = name.rpartition("://")
    folder = urdf.resolve().parent
    if scheme in ("package", "model"):
        inside = rest.partition("/")[2]
        candidates = [parent / rest for parent in (folder, *folder.parents)]
        # the folder that holds the package may have been renamed: what is inside it must still fit
        candidates += [parent / inside for parent in (folder, *folder.parents)] if inside else []
    else:
        candidates = [folder / rest]  # an absolute path stays as it is
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def load_visuals(description: Description) -> dict[str, trimesh.Trimesh]:
    """One mesh per drawn link, in the link's frame, with vertex colours and smooth normals where given.

    Raises `UserError` naming the file where a mesh cannot be read, or where none of them is there; where
    only some are missing, they are left out and named in the log.
    """
    parts: dict[str, list[Part]] = {}
    missing: list[str] = []
    for link in description.urdf.robot.links:
        for visual in link.visuals:
            try:
                parts.setdefault(link.name, []).extend(_load_visual(description, visual))
            except FileNotFoundError as error:
                missing.append(str(error))
    meshes = {name: _merge(pieces) for name, pieces in parts.items() if pieces}
    if missing and not meshes:
        raise UserError(
            f"{description.path}: none of its {len(missing)} meshes is there, e.g. {missing[0]}; expected them "
            "beside the description or in the package's folder above it"
        )
    if missing:
        logger.warning("%s: %d meshes are missing and not drawn: %s", description.path, len(missing), missing)
    return meshes


def _load_visual(description: Description, visual: Any) -> list[Part]:
    """The parts of one <visual>; raises FileNotFoundError where the file of its mesh is not there."""
    import trimesh

    shape, scale = visual.geometry, np.ones(3)
    if shape is None:
        return []
    if shape.box is not None:
        solids = [trimesh.creation.box(extents=shape.box.size)]
    elif shape.sphere is not None:
        solids = [trimesh.creation.icosphere(subdivisions=3, radius=shape.sphere.radius)]
    elif shape.cylinder is not None:
        solids = [trimesh.creation.cylinder(shape.cylinder.radius, shape.cylinder.length, sections=32)]
    else:
        file = resolve_file(description.path, shape.mesh.filename)
        if file is None:
            raise FileNotFoundError(shape.mesh.filename)
        try:
            solids = [solid for solid in trimesh.load_scene(file).dump() if isinstance(solid, trimesh.Trimesh)]
        except Exception as error:  # whatever the reader of the file's format raises
            raise UserError(f"{file} cannot be read as a mesh: {error}") from error
        if not any(len(solid.faces) for solid in solids):
            raise UserError(f"{file} cannot be read as a mesh: it holds no triangles")
        if shape.mesh.scale is not None:
            scale = np.broadcast_to(np.asarray(shape.mesh.scale, dtype=np.float64), 3)
    transform = np.eye(4) if visual.origin is None else np.array(visual.origin, dtype=np.float64)
    transform[:3, :3] = transform[:3, :3] * scale
    color = _material_color(description, visual.material)
    return [_part(solid, transform, color) for solid in solids]


def _material_color(description: Description, material: Any) -> UInt8[np.ndarray, "4"] | None:
    """The colour that the description gives a visual; None where it leaves that to the mesh's file."""
    if material is None:
        return None
    named = {known.name: known.color for known in description.urdf.robot.materials}
    color = material.color if material.color is not None else named.get(material.name)
    return None if color is None else np.round(255 * np.asarray(color.rgba)).astype(np.uint8)


def _part(solid: Any, transform: Float[np.ndarray, "4 4"], color: UInt8[np.ndarray, "4"] | None) -> Part:
    """A mesh moved into the link's frame, with one colour per vertex."""
    linear = transform[:3, :3]
    normals = solid.vertex_normals @ np.linalg.inv(linear)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)
    faces = solid.faces[:, ::-1] if np.linalg.det(linear) < 0.0 else solid.faces
    if color is not None:
        colors = color
    elif solid.visual.kind == "texture":
        colors = np.asarray(solid.visual.to_color().vertex_colors)
    else:
        colors = np.asarray(solid.visual.vertex_colors if solid.visual.defined else GREY, dtype=np.uint8)
    count = len(solid.vertices)
    return Part(
        solid.vertices @ linear.T + transform[:3, 3], np.asarray(faces), normals, np.broadcast_to(colors, (count, 4))
    )


def _merge(parts: list[Part]) -> trimesh.Trimesh:
    """One mesh of several parts, keeping their normals and colours."""
    import trimesh

    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return trimesh.Trimesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
        vertex_normals=np.concatenate([part.normals for part in parts]),
        vertex_colors=np.concatenate([part.colors for part in parts]),
        process=False,
    )
