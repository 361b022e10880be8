"""A URDF's kinematics in plain float64, and what every robot description of ours is checked for."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from trimesh.visual import ColorVisuals

URDFS = Path(__file__).resolve().parents[1] / "assets" / "urdf"


def numbers(element: ElementTree.Element | None, key: str) -> np.ndarray:
    return np.array([float(value) for value in (element.get(key, "0 0 0") if element is not None else "0 0 0").split()])


def turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation about a unit axis, Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


class Tree:
    """A URDF's joints with plain float64 forward kinematics, written for this test alone."""

    def __init__(self, path: Path) -> None:
        self.root = ElementTree.parse(path).getroot()
        self.joints = {str(joint.get("name")): joint for joint in self.root.findall("joint")}
        self.above = {self.end(joint, "child"): name for name, joint in self.joints.items()}
        self.origins = {name: self.origin(joint) for name, joint in self.joints.items()}
        self.axes = {name: numbers(joint.find("axis"), "xyz") for name, joint in self.joints.items()}

    @staticmethod
    def end(joint: ElementTree.Element, kind: str) -> str:
        element = joint.find(kind)
        assert element is not None
        return str(element.get("link"))

    @staticmethod
    def origin(joint: ElementTree.Element) -> np.ndarray:
        pose, (x, y, z) = np.eye(4), np.eye(3)
        roll, pitch, yaw = numbers(joint.find("origin"), "rpy")
        pose[:3, :3] = turn(z, yaw) @ turn(y, pitch) @ turn(x, roll)
        pose[:3, 3] = numbers(joint.find("origin"), "xyz")
        return pose

    def pose(self, link: str, angles: dict[str, float]) -> np.ndarray:
        """T_root_link."""
        total = np.eye(4)
        while link in self.above:
            name = self.above[link]
            step = self.origins[name].copy()
            if self.joints[name].get("type") == "revolute":
                step[:3, :3] = step[:3, :3] @ turn(self.axes[name], angles[name])
            elif self.joints[name].get("type") == "prismatic":
                step[:3, 3] += step[:3, :3] @ (angles[name] * self.axes[name])
            total = step @ total
            link = self.end(self.joints[name], "parent")
        return total

    def limits(self, name: str) -> dict[str, float]:
        limit = self.joints[name].find("limit")
        assert limit is not None
        return {key: float(value) for key, value in limit.items()}


def check_poses(ours: Tree, reference: Tree, base: str, links: Sequence[str], joints: Sequence[str]) -> None:
    """1,000 random configurations: links seen from `base` agree within 1e-6 m and 1e-6 rad."""
    rng = np.random.default_rng(20)
    bounds = np.array([[ours.limits(name)["lower"], ours.limits(name)["upper"]] for name in joints])
    for values in rng.uniform(bounds[:, 0], bounds[:, 1], (1000, len(joints))):
        angles = dict.fromkeys(ours.joints, 0.0) | dict(zip(joints, values.tolist(), strict=True))
        ours_base, reference_base = ours.pose(base, angles), reference.pose(base, angles)
        for link in links:
            ours_pose = np.linalg.solve(ours_base, ours.pose(link, angles))
            reference_pose = np.linalg.solve(reference_base, reference.pose(link, angles))
            assert np.linalg.norm(ours_pose[:3, 3] - reference_pose[:3, 3]) < 1e-6
            # |R1 - R2| = 2 sqrt(2) sin(angle / 2): accurate for small angles, where arccos of the trace is not
            gap = np.linalg.norm(ours_pose[:3, :3] - reference_pose[:3, :3]) / np.sqrt(2)
            assert gap < 1e-6


def check_joints(ours: Tree, reference: Tree, added: tuple[str, ...] = ()) -> None:
    """Our joints but those `added` are the reference's: type, links, origin, axis, limits, whom they follow."""
    for name, joint in ours.joints.items():
        if name in added:
            continue
        other = reference.joints[name]
        assert joint.get("type") == other.get("type")
        assert [Tree.end(joint, kind) for kind in ("parent", "child")] == [
            Tree.end(other, kind) for kind in ("parent", "child")
        ]
        for key in ("xyz", "rpy"):
            np.testing.assert_array_equal(numbers(joint.find("origin"), key), numbers(other.find("origin"), key))
        if joint.get("type") != "fixed":
            np.testing.assert_array_equal(numbers(joint.find("axis"), "xyz"), numbers(other.find("axis"), "xyz"))
            assert ours.limits(name) == reference.limits(name)
        mimics = [None if one is None else one.get("joint") for one in (joint.find("mimic"), other.find("mimic"))]
        assert mimics[0] == mimics[1]


def check_meshes(ours: Tree, folder: Path, most_bytes: int, bright: float = 220) -> None:
    """Every mesh is used, loads with colours and smooth normals, and all together are small."""
    names = {str(mesh.get("filename")) for mesh in ours.root.iter("mesh")}
    assert all((folder / name).is_file() for name in names)
    names = {name for name in names if not name.startswith("../")}  # another robot's are checked with it
    assert names == {f"meshes/{path.name}" for path in (folder / "meshes").iterdir()}
    assert sum((folder / name).stat().st_size for name in names) < most_bytes
    shades = set()
    for name in sorted(names):
        mesh = trimesh.load_mesh(folder / name)
        assert isinstance(mesh, trimesh.Trimesh)
        visual = mesh.visual
        assert isinstance(visual, ColorVisuals) and visual.kind == "vertex"
        palette = np.asarray(visual.vertex_colors)
        assert np.isfinite(mesh.vertices).all() and (mesh.area_faces > 0).all()
        # triangles of one colour each: colours never bleed into each other over an edge
        colours = palette[mesh.faces]
        assert (colours == colours[:, :1]).all()
        # smooth: no visible vertex normal is far from its triangles' (edges are rounded in the geometry)
        lean = np.einsum("fi,fki->fk", mesh.face_normals, mesh.vertex_normals[mesh.faces])
        assert np.quantile(lean, 0.1) > 0.85, name
        shades |= {tuple(colour) for colour in np.unique(palette, axis=0).tolist()}
    brightness = [sum(shade[:3]) / 3 for shade in shades]
    assert max(brightness) > bright and min(brightness) < 30  # white shells, black screens, rails and wheels
    assert all(shade[3] == 255 for shade in shades)


def check_generator(robot: str, folder: Path) -> None:
    """The generator writes the committed files, byte by byte."""
    script = URDFS / "generate.py"
    subprocess.run([sys.executable, "-B", str(script), robot, "--out", str(folder)], check=True)
    written = {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}
    committed = {path.relative_to(URDFS) for path in (URDFS / robot).rglob("*") if path.suffix in (".urdf", ".ply")}
    assert written == committed
    for name in written:
        assert (folder / name).read_bytes() == (URDFS / name).read_bytes(), name
