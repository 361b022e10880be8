"""Our Pepper against the reference descriptions, and its committed files against their generator."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.visual import ColorVisuals

FOLDER = Path(__file__).resolve().parents[1] / "assets" / "urdf" / "pepper"
CHECKED = ("Head", "RElbow", "RForeArm", "r_wrist", "r_gripper", "LForeArm", "l_wrist", "l_gripper", "base_footprint")
MOVING = ["HeadYaw", "HeadPitch", "HipRoll", "HipPitch", "KneePitch"] + [
    side + name
    for side in "LR"
    for name in ("ShoulderPitch", "ShoulderRoll", "ElbowYaw", "ElbowRoll", "WristYaw", "Hand")
]


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
            if self.joints[name].get("type") != "fixed":
                step[:3, :3] = step[:3, :3] @ turn(self.axes[name], angles[name])
            total = step @ total
            link = self.end(self.joints[name], "parent")
        return total

    def limits(self, name: str) -> dict[str, float]:
        limit = self.joints[name].find("limit")
        assert limit is not None
        return {key: float(value) for key, value in limit.items()}


@pytest.fixture(scope="module")
def ours() -> Tree:
    return Tree(FOLDER / "pepper.urdf")


def check_poses(ours: Tree, reference: Tree, base: str, links: tuple[str, ...], joints: list[str]) -> None:
    """1,000 random configurations: links seen from `base` agree within 1e-6 m and 1e-6 rad."""
    rng = np.random.default_rng(20)
    bounds = np.array([[ours.limits(name)["lower"], ours.limits(name)["upper"]] for name in joints])
    for values in rng.uniform(bounds[:, 0], bounds[:, 1], (1000, len(joints))):
        angles = dict.fromkeys(MOVING, 0.0) | dict(zip(joints, values.tolist(), strict=True))
        ours_base, reference_base = ours.pose(base, angles), reference.pose(base, angles)
        for link in links:
            ours_pose = np.linalg.solve(ours_base, ours.pose(link, angles))
            reference_pose = np.linalg.solve(reference_base, reference.pose(link, angles))
            assert np.linalg.norm(ours_pose[:3, 3] - reference_pose[:3, 3]) < 1e-6
            # |R1 - R2| = 2 sqrt(2) sin(angle / 2): accurate for small angles, where arccos of the trace is not
            gap = np.linalg.norm(ours_pose[:3, :3] - reference_pose[:3, :3]) / np.sqrt(2)
            assert gap < 1e-6


def test_poses_equal_the_naoqi_description(ours: Tree, shared: Callable[[str], Path]) -> None:
    reference = Tree(shared("robots/pepper_naoqi/pepper.urdf"))
    check_poses(ours, reference, "base_link", CHECKED, MOVING)


def test_arm_poses_equal_the_lirmm_description(ours: Tree, shared: Callable[[str], Path]) -> None:
    # Its root is the floor and its torso frame lies lower: compare from the shoulder on.
    reference = Tree(shared("robots/pepper_description/urdf/pepper.urdf"))
    right = ("RElbow", "RForeArm", "r_wrist", "r_gripper")
    check_poses(ours, reference, "RShoulder", right, [name for name in MOVING if name.startswith("R")])


def test_joints_equal_the_naoqi_description(ours: Tree, shared: Callable[[str], Path]) -> None:
    reference = Tree(shared("robots/pepper_naoqi/pepper.urdf"))
    assert sorted(MOVING) == sorted(name for name, joint in ours.joints.items() if joint.get("type") == "revolute")
    for name, joint in ours.joints.items():
        other = reference.joints[name]
        assert joint.get("type") == other.get("type")
        assert [Tree.end(joint, kind) for kind in ("parent", "child")] == [
            Tree.end(other, kind) for kind in ("parent", "child")
        ]
        for key in ("xyz", "rpy"):
            np.testing.assert_array_equal(numbers(joint.find("origin"), key), numbers(other.find("origin"), key))
        if name in MOVING:
            np.testing.assert_array_equal(numbers(joint.find("axis"), "xyz"), numbers(other.find("axis"), "xyz"))
            assert ours.limits(name) == reference.limits(name)


def test_stands_on_the_floor_at_published_size(ours: Tree) -> None:
    corners = []
    angles = dict.fromkeys(MOVING, 0.0)
    floor = np.linalg.inv(ours.pose("base_footprint", angles))
    for link in ours.root.findall("link"):
        for mesh in link.findall("visual/geometry/mesh"):
            drawn = trimesh.load_mesh(FOLDER / str(mesh.get("filename")))
            pose = floor @ ours.pose(str(link.get("name")), angles)
            corners.append(trimesh.transform_points(drawn.vertices, pose))
    low, high = np.concatenate(corners).min(0), np.concatenate(corners).max(0)
    assert abs(low[2]) < 1e-3
    assert high[2] == pytest.approx(1.21, abs=1e-3)
    body = np.concatenate([points for points in corners if points[:, 2].max() < 0.5])  # the base
    size = body.max(0) - body.min(0)
    assert size[1] == pytest.approx(0.48, abs=0.01)
    assert size[0] == pytest.approx(0.425, abs=0.01)


def test_meshes_load_coloured_and_small(ours: Tree) -> None:
    names = [str(mesh.get("filename")) for mesh in ours.root.iter("mesh")]
    assert sorted(names) == sorted(f"meshes/{path.name}" for path in (FOLDER / "meshes").iterdir())
    assert sum((FOLDER / name).stat().st_size for name in names) < 1_500_000
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.suffix != ".pyc") < 1_500_000
    shades = set()
    for name in names:
        mesh = trimesh.load_mesh(FOLDER / name)
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
        assert np.quantile(lean, 0.1) > 0.85
        shades |= {tuple(colour) for colour in np.unique(palette, axis=0).tolist()}
    brightness = [sum(shade[:3]) / 3 for shade in shades]
    assert max(brightness) > 220 and min(brightness) < 30  # white shells, black tablet
    assert all(shade[3] == 255 for shade in shades)


def test_right_arm_mirrors_the_left() -> None:
    for right, left in (("RBicep", "LBicep"), ("RForeArm", "LForeArm"), ("r_wrist", "l_wrist")):
        first, second = (trimesh.load_mesh(FOLDER / "meshes" / f"{name}.ply") for name in (right, left))
        mirrored = second.vertices * (1, -1, 1)
        assert np.array_equal(first.vertices[np.lexsort(first.vertices.T)], mirrored[np.lexsort(mirrored.T)])
        assert first.volume == pytest.approx(second.volume, rel=1e-6)
        assert first.volume > 0


def test_generator_reproduces_the_committed_files(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-B", str(FOLDER / "generate.py"), "--out", str(tmp_path)], check=True)
    written = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file())
    assert len(written) == 17
    for name in written:
        assert (tmp_path / name).read_bytes() == (FOLDER / name).read_bytes(), name
