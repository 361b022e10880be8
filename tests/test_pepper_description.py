"""Our Pepper against the reference descriptions, and its committed files against their generator."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from urdf_tree import URDFS, Tree, check_generator, check_joints, check_meshes, check_poses

FOLDER = URDFS / "pepper"
ARM = ("Shoulder", "Bicep", "Elbow", "ForeArm")
CHECKED = ("Head", "base_footprint", *(side + name for side in "RL" for name in ARM),
           "r_wrist", "r_gripper", "l_wrist", "l_gripper")  # fmt: skip
MOVING = ["HeadYaw", "HeadPitch", "HipRoll", "HipPitch", "KneePitch"] + [
    side + name
    for side in "LR"
    for name in ("ShoulderPitch", "ShoulderRoll", "ElbowYaw", "ElbowRoll", "WristYaw", "Hand")
]


@pytest.fixture(scope="module")
def ours() -> Tree:
    return Tree(FOLDER / "pepper.urdf")


def test_poses_equal_the_naoqi_description(ours: Tree, shared: Callable[[str], Path]) -> None:
    reference = Tree(shared("robots/pepper_naoqi/pepper.urdf"))
    check_poses(ours, reference, "base_link", CHECKED, MOVING)


def test_arm_poses_equal_the_lirmm_description(ours: Tree, shared: Callable[[str], Path]) -> None:
    # Its root is the floor and its torso frame lies lower: compare from the shoulder on.
    reference = Tree(shared("robots/pepper_description/urdf/pepper.urdf"))
    for side in "RL":
        links = (f"{side}Bicep", f"{side}Elbow", f"{side}ForeArm", f"{side.lower()}_wrist", f"{side.lower()}_gripper")
        check_poses(ours, reference, f"{side}Shoulder", links, [name for name in MOVING if name.startswith(side)])


def test_joints_equal_the_naoqi_description(ours: Tree, shared: Callable[[str], Path]) -> None:
    reference = Tree(shared("robots/pepper_naoqi/pepper.urdf"))
    assert sorted(MOVING) == sorted(name for name, joint in ours.joints.items() if joint.get("type") == "revolute")
    check_joints(ours, reference)


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
    check_meshes(ours, FOLDER, 1_500_000)
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.suffix != ".pyc") < 1_500_000


def test_right_arm_mirrors_the_left() -> None:
    for right, left in (("RBicep", "LBicep"), ("RForeArm", "LForeArm"), ("r_wrist", "l_wrist")):
        first, second = (trimesh.load_mesh(FOLDER / "meshes" / f"{name}.ply") for name in (right, left))
        mirrored = second.vertices * (1, -1, 1)
        assert np.array_equal(first.vertices[np.lexsort(first.vertices.T)], mirrored[np.lexsort(mirrored.T)])
        assert first.volume == pytest.approx(second.volume, rel=1e-6)
        assert first.volume > 0


def test_generator_reproduces_the_committed_files(tmp_path: Path) -> None:
    check_generator("pepper", tmp_path)
