"""Descriptions, the folded arm and its cache, link poses and visuals, against yourdfpy and pytorch-kinematics."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mild_viz.errors import UserError
from mild_viz.robot import chain as chain_module
from mild_viz.robot.chain import load_chain
from mild_viz.robot.ik import forward, jacobian
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.robot.robots import ROBOTS
from mild_viz.robot.visuals import resolve_file
from mild_viz.trial import ACTIONS

REFERENCES = ["robots/pepper_naoqi/pepper.urdf", "robots/pepper_description/urdf/pepper.urdf"]

ARM = """<robot name="two">
  <material name="paint"><color rgba="1 0.5 0 1"/></material>
  <link name="base"><visual><geometry><box size="0.2 0.2 0.2"/></geometry><material name="paint"/></visual></link>
  <link name="upper"><visual><origin xyz="0.1 0 0"/><geometry><mesh filename="package://parts/tri.stl" scale="2 2 2"/>
    </geometry></visual></link>
  <link name="hand"/>
  <link name="finger"><visual><geometry><sphere radius="0.01"/></geometry></visual></link>
  <joint name="swing" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 1" rpy="0 0 0.5"/>
    <axis xyz="0 0 2"/><limit lower="-1" upper="2" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="upper"/><child link="hand"/><origin xyz="0.3 0 0"/>
    <axis xyz="1 0 0"/><limit lower="0.1" upper="0.5" effort="1" velocity="1"/></joint>
  <joint name="follow" type="revolute"><parent link="hand"/><child link="finger"/><origin xyz="0.1 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-9" upper="9" effort="1" velocity="1"/>
    <mimic joint="swing" multiplier="-2" offset="0.25"/></joint>
</robot>"""

TRIANGLE = b"""solid t
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid t
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of folded chains."""
    folder = tmp_path / "cache"
    monkeypatch.setattr(chain_module, "cache_folder", lambda: folder)
    return folder


@pytest.fixture
def small_arm(tmp_path: Path, cache: Path) -> Path:
    """A robot of one turning joint, beside its package of meshes."""
    folder = tmp_path / "models" / "urdf"
    folder.mkdir(parents=True)
    (tmp_path / "models" / "parts").mkdir()
    (tmp_path / "models" / "parts" / "tri.stl").write_bytes(TRIANGLE)
    (folder / "two.urdf").write_text(ARM)
    return folder / "two.urdf"


def vertex_colors(mesh: Any) -> np.ndarray:
    return np.asarray(mesh.visual.vertex_colors)


def random_joints(robot: RobotModel, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(robot.chain.lower, robot.chain.upper, (count, robot.chain.n_joints))


@pytest.mark.parametrize("relative", REFERENCES)
def test_link_poses_agree_with_yourdfpy(shared, relative):
    import yourdfpy

    robot = load_robot(str(shared(relative)))
    joints = random_joints(robot, 5)
    poses = robot.link_poses(joints)
    assert poses.shape == (5, len(robot.link_names), 7)
    np.testing.assert_allclose(np.linalg.norm(poses[..., :4], axis=-1), 1.0, atol=1e-12)
    oracle = yourdfpy.URDF.load(str(robot.urdf), load_meshes=False)
    rest = robot.description.values(dict(ROBOTS["pepper"].rest))
    for k in range(len(joints)):
        values = {name: rest[name] for name in oracle.actuated_joint_names}
        oracle.update_cfg(values | dict(zip(ROBOTS["pepper"].joint_names, joints[k], strict=True)))
        for name, pose in zip(robot.link_names, poses[k], strict=True):
            expected = oracle.get_transform(name, robot.description.root)
            np.testing.assert_allclose(pose[4:], expected[:3, 3], atol=1e-12)
            rotation = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix()
            np.testing.assert_allclose(rotation, expected[:3, :3], atol=1e-12)


@pytest.mark.parametrize("relative", REFERENCES)
def test_fold_agrees_with_pytorch_kinematics(shared, relative, cache):
    import pytorch_kinematics as pk
    import torch

    robot = load_robot(str(shared(relative)))
    joints = random_joints(robot, 1000)
    oracle = pk.build_serial_chain_from_urdf(robot.urdf.read_bytes(), "r_gripper").to(dtype=torch.float64)
    names = oracle.get_joint_parameter_names()
    rest = robot.description.values(dict(ROBOTS["pepper"].rest))
    full = np.tile([rest[name] for name in names], (len(joints), 1))
    full[:, [names.index(name) for name in ROBOTS["pepper"].joint_names]] = joints
    pose: Any = oracle.forward_kinematics(torch.from_numpy(full))
    expected = pose.get_matrix()[:, :3, 3].numpy()
    np.testing.assert_allclose(robot.end_effector(joints), expected, atol=1e-7)


def test_limits_and_rest_come_from_the_description(shared):
    chain = load_robot(str(shared(REFERENCES[0]))).chain
    np.testing.assert_allclose(chain.lower, [-2.08567, -1.56207, -2.08567, 0.00872665])
    np.testing.assert_allclose(chain.upper, [2.08567, -0.00872665, 2.08567, 1.56207])
    assert np.all((chain.rest >= chain.lower) & (chain.rest <= chain.upper))
    assert chain.reach == pytest.approx(np.hypot(0.1812, 0.015) + 0.175, abs=1e-4)


def test_own_pepper_loads_by_name_and_equals_the_reference(shared):
    own, reference = load_robot("pepper"), load_robot(str(shared(REFERENCES[0])))
    joints = random_joints(reference, 1000)
    np.testing.assert_allclose(own.end_effector(joints), reference.end_effector(joints), atol=1e-6)
    np.testing.assert_allclose(own.chain.lower, reference.chain.lower)
    np.testing.assert_allclose(own.chain.upper, reference.chain.upper)
    assert set(own.visuals) == set(own.link_names)
    assert {"RShoulder", "RBicep", "RForeArm"} <= set(own.moving_links)
    # the head's top and the wheels: as tall as Pepper, standing on its floor
    poses = dict(zip(own.link_names, own.link_poses(own.chain.rest[None])[0], strict=True))
    assert max(poses[name][6] for name in poses) - own.floor < 1.25
    assert own.floor == pytest.approx(reference.floor, abs=0.01)


def test_jacobian_equals_finite_differences():
    chain = load_robot("pepper").chain
    joints = np.random.default_rng(1).uniform(chain.lower, chain.upper, (50, 4))
    step = 1e-6
    for j in range(4):
        moved = np.eye(4)[j] * step
        difference = (forward(chain, joints + moved) - forward(chain, joints - moved)) / (2 * step)
        np.testing.assert_allclose(jacobian(chain, joints)[:, j], difference, atol=1e-9)


def test_links_that_do_not_move_keep_their_pose():
    robot = load_robot("pepper")
    left = np.random.default_rng(3).uniform(robot.arms["left"].lower, robot.arms["left"].upper, (20, 4))
    poses = robot.link_poses(random_joints(robot, 20), others={"left": left})
    for column, name in enumerate(robot.link_names):
        spread = np.abs(poses[:, column] - poses[0, column]).max()
        assert (spread > 1e-3) == (name in robot.moving_links), name


def test_hand_of_an_action_turns_without_moving_the_end_effector(shared):
    for name in ("pepper", str(shared(REFERENCES[0]))):
        robot = load_robot(name)
        joints = random_joints(robot, 10)
        plain = dict(zip(robot.link_names, robot.link_poses(joints).swapaxes(0, 1), strict=True))
        for action in ACTIONS:
            poses = robot.link_poses(joints, action)
            for column, link in enumerate(robot.link_names):
                hand = link == "r_wrist" or link.startswith(("RFinger", "RThumb"))
                changed = np.abs(poses[:, column] - plain[link]).max() > 1e-9
                # the forearm and everything else stay; every action has a wrist or fingers of its own
                assert not changed or hand, (action, link)
            chain = load_chain(
                robot.description,
                ROBOTS["pepper"].joint_names,
                "r_gripper",
                {**robot.spec.rest, **robot.spec.hands[action]},
            )
            np.testing.assert_allclose(forward(chain, joints), robot.end_effector(joints), atol=1e-9)


def test_palm_forward_in_a_wave_and_thumb_up_in_a_handshake(shared):
    robot = load_robot(str(shared(REFERENCES[0])))

    def thumb_and_palm(joints: list[float], action: str) -> tuple[np.ndarray, np.ndarray]:
        poses = dict(zip(robot.link_names, robot.link_poses(np.array([joints]), action)[0, :, 4:], strict=True))
        fingers, thumb = poses["RFinger21_link"] - poses["r_wrist"], poses["RThumb1_link"] - poses["r_wrist"]
        fingers = fingers / np.linalg.norm(fingers)
        thumb = thumb - fingers * (thumb @ fingers)
        thumb = thumb / np.linalg.norm(thumb)
        return thumb, np.cross(thumb, fingers)

    assert thumb_and_palm([1.0, -0.05, 0.7, 0.97], "handshake")[0][2] > 0.95
    assert thumb_and_palm([0.3, -0.4, 1.6, 1.5], "wave")[1][0] > 0.5


def test_mimic_prismatic_and_normalised_axis(small_arm):
    robot = load_robot(str(small_arm), joint_names=("swing",), end_effector="hand")
    q = 0.7
    # the sliding joint rests at its lower limit, 0.1
    hand = np.array([0.4 * np.cos(0.5 + q), 0.4 * np.sin(0.5 + q), 1.0])
    np.testing.assert_allclose(robot.end_effector(np.array([[q]]))[0], hand, atol=1e-6)
    finger = robot.link_poses(np.array([[q]]))[0, robot.link_names.index("finger")]
    turn = 0.5 + q + (-2 * q + 0.25)
    np.testing.assert_allclose(finger[4:], hand * (1.25, 1.25, 1.0), atol=1e-12)
    np.testing.assert_allclose(np.abs(finger[:4]), np.abs([np.cos(turn / 2), 0, 0, np.sin(turn / 2)]), atol=1e-12)


def test_joints_of_the_wrong_width_are_refused():
    with pytest.raises(UserError, match="RShoulderPitch, RShoulderRoll, RElbowYaw, RElbowRoll"):
        load_robot("pepper").link_poses(np.zeros((3, 5)))


# the cache of folded chains


def cache_file(folder: Path) -> Path:
    (file,) = folder.glob("*.npz")
    return file


def test_cache_is_used_and_a_damaged_one_is_rebuilt(small_arm, cache, monkeypatch):
    folds = []
    fold = chain_module._fold
    monkeypatch.setattr(chain_module, "_fold", lambda *args: folds.append(1) or fold(*args))

    def load() -> np.ndarray:
        return load_robot(str(small_arm), ("swing",), "hand").chain.offsets

    first = load()
    np.testing.assert_array_equal(load(), first)
    assert len(folds) == 1
    for damaged in (b"", b"PK\x03\x04 broken", cache_file(cache).read_bytes()[:-200]):
        cache_file(cache).write_bytes(damaged)
        np.testing.assert_array_equal(load(), first)
    np.savez(cache_file(cache), offsets=np.zeros((5, 4, 4)), axes=np.zeros((4, 3)))
    np.testing.assert_array_equal(load(), first)
    assert len(folds) == 5
    np.testing.assert_array_equal(load(), first)
    assert len(folds) == 5, "the rebuilt cache must be used"
    assert [file.suffix for file in cache.iterdir()] == [".npz"], "no temporary file may stay"


def test_cache_follows_the_description(small_arm, cache):
    before = load_robot(str(small_arm), ("swing",), "hand").end_effector(np.zeros((1, 1)))
    small_arm.write_text(ARM.replace('xyz="0.3 0 0"', 'xyz="0.5 0 0"'))
    after = load_robot(str(small_arm), ("swing",), "hand").end_effector(np.zeros((1, 1)))
    assert np.linalg.norm(after - before) == pytest.approx(0.2, abs=1e-6)


def test_cache_that_cannot_be_written_is_no_error(small_arm, tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("a file where the folder should be; a read-only folder does not stop root")
    monkeypatch.setattr(chain_module, "cache_folder", lambda: blocked / "chains")
    assert load_robot(str(small_arm), ("swing",), "hand").chain.n_joints == 1


def test_warm_start_does_not_import_torch():
    load_robot("pepper")
    code = (
        "import sys; from mild_viz.robot.model import load_robot; load_robot('pepper'); print('torch' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=dict(os.environ)
    )
    assert done.stdout.strip() == "False"


# visuals


def test_visuals_of_the_reference_with_its_meshes(shared, caplog):
    robot = load_robot(str(shared(REFERENCES[1])))
    with caplog.at_level(logging.WARNING):
        visuals = robot.visuals
    assert "d435.dae" in caplog.text, "the one mesh that the description names and does not have"
    assert set(robot.link_names) - set(visuals) == {"RealSense_screw_frame"}
    torso = visuals["torso"]
    assert torso.extents == pytest.approx([0.2, 0.3, 0.4], abs=0.15), "metres: the file's scale is applied"
    assert len(np.unique(vertex_colors(torso), axis=0)) > 1, "the file's own materials"
    for mesh in visuals.values():
        lengths = np.linalg.norm(mesh.vertex_normals, axis=1)
        assert np.median(lengths) == pytest.approx(1.0)
        assert len(vertex_colors(mesh)) == len(mesh.vertices)
    assert robot.floor == pytest.approx(0.0, abs=1e-3)


def test_visuals_are_moved_scaled_and_coloured(small_arm):
    visuals = load_robot(str(small_arm), ("swing",), "hand").visuals
    np.testing.assert_allclose(visuals["upper"].bounds, [[0.1, 0.0, 0.0], [2.1, 2.0, 0.0]], atol=1e-7)
    assert vertex_colors(visuals["upper"])[0].tolist() == [178, 178, 178, 255]
    np.testing.assert_allclose(visuals["base"].extents, 0.2)
    assert vertex_colors(visuals["base"])[0].tolist() == [255, 128, 0, 255]


def test_missing_meshes(small_arm, caplog):
    mesh = small_arm.parents[1] / "parts" / "tri.stl"
    mesh.unlink()
    with caplog.at_level(logging.WARNING):
        assert "upper" not in load_robot(str(small_arm), ("swing",), "hand").visuals
    assert "package://parts/tri.stl" in caplog.text
    only_mesh = ARM.replace('<box size="0.2 0.2 0.2"/>', '<mesh filename="gone.stl"/>')
    small_arm.write_text(only_mesh.replace('<sphere radius="0.01"/>', '<mesh filename="gone.stl"/>'))
    with pytest.raises(UserError, match=r"two\.urdf: none of its 3 meshes is there, e\.g\. gone\.stl"):
        _ = load_robot(str(small_arm), ("swing",), "hand").visuals
    mesh.write_bytes(b"\x00" * 40)
    with pytest.raises(UserError, match=r"tri\.stl cannot be read as a mesh"):
        _ = load_robot(str(small_arm), ("swing",), "hand").visuals


def test_package_paths(small_arm):
    mesh = (small_arm.parents[1] / "parts" / "tri.stl").resolve()
    assert resolve_file(small_arm, "package://parts/tri.stl") == mesh
    assert resolve_file(small_arm, "package://renamed/parts/tri.stl") == mesh
    assert resolve_file(small_arm, "../parts/tri.stl") is not None
    assert resolve_file(small_arm, f"file://{mesh}") == mesh
    assert resolve_file(small_arm, "package://parts/other.stl") is None


# bad descriptions


def test_unknown_robot_and_missing_file(tmp_path):
    with pytest.raises(UserError, match="robot 'peper' is unknown; valid: pepper, kobo, panda, yumi, a folder"):
        load_robot("peper")
    with pytest.raises(UserError, match="nothing.urdf is not a file"):
        load_robot(str(tmp_path / "nothing.urdf"))


def test_missing_joint_lists_those_it_has(small_arm):
    with pytest.raises(UserError, match="has no joint 'RShoulderPitch'; it has: swing$"):
        load_robot(str(small_arm), end_effector="hand")
    with pytest.raises(UserError, match="has no joint 'RShoulderPitch'; it has: swing$"):
        load_robot(str(small_arm))  # no r_gripper either, but the joints are what was asked for
    with pytest.raises(UserError, match="has no link 'r_gripper'; it has: base, upper, hand, finger$"):
        load_robot(str(small_arm), ("swing",))


def test_what_the_arm_does_not_need_does_not_stop_it(small_arm):
    # pytorch-kinematics stumbles over each of these; the finger is beyond the end effector
    odd = ARM.replace('<axis xyz="0 0 2"/>', "").replace('scale="2 2 2"', 'scale="2"').replace(' velocity="1"', "")
    odd = odd.replace('name="follow" type="revolute"', 'name="follow" type="floating"')
    small_arm.write_text(odd.replace('<mimic joint="swing" multiplier="-2" offset="0.25"/>', "<!-- no mimic -->"))
    robot = load_robot(str(small_arm), ("swing",), "hand")
    np.testing.assert_array_equal(robot.chain.axes, [[1.0, 0.0, 0.0]])  # a URDF's default
    joints = np.array([[0.7]])
    hand = [0.4 * np.cos(0.5), 0.4 * np.sin(0.5), 1.0]
    np.testing.assert_allclose(robot.end_effector(joints)[0], hand, atol=1e-6)
    np.testing.assert_allclose(
        robot.link_poses(joints)[0, robot.link_names.index("finger"), 4:],
        np.multiply(hand, (1.25, 1.25, 1)),
        atol=1e-12,
    )
    assert set(robot.visuals) == {"base", "upper", "finger"}


def test_other_robots_are_told_which_joints_they_lack(shared):
    for relative, joint in (("robots/panda", "panda_joint1"), ("robots/yumi", "yumi_joint_1_r")):
        urdf = next(shared(relative).rglob("*.urdf"))
        with pytest.raises(UserError, match=f"has no joint 'RShoulderPitch'; it has: .*{joint}"):
            load_robot(str(urdf))


def test_joints_that_cannot_be_controlled(small_arm):
    with pytest.raises(UserError, match="'slide' is prismatic"):
        load_robot(str(small_arm), ("swing", "slide"), "hand")
    with pytest.raises(UserError, match="'follow' is mimic"):
        load_robot(str(small_arm), ("swing", "follow"), "finger")
    with pytest.raises(UserError, match="not in this order between the base and 'RForeArm'"):
        load_robot("pepper", ("RShoulderRoll", "RShoulderPitch"), "RForeArm")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not a valid URDF"),
        ("<robot><link", "not a valid URDF"),
        ("<sdf/>", "the root element is <sdf>"),
        ("<robot name='x'/>", "form no single tree"),
        (ARM.replace('child link="upper"', 'child link="base"'), "the joints form a loop"),
        (ARM.replace('child link="upper"', 'child link="gone"'), "form no single tree"),
        (
            ARM.replace('xyz="0 0 1" rpy', 'xyz="0 zero 1" rpy'),
            "joint swing: xyz of <origin> is '0 zero 1'; expected 3 finite numbers",
        ),
        (ARM.replace('xyz="0 0 1" rpy', 'xyz="0 nan 1" rpy'), "joint swing: xyz of <origin> is '0 nan 1'"),
        (ARM.replace('xyz="0 0 1" rpy', 'xyz="0 inf 1" rpy'), "joint swing: xyz of <origin> is '0 inf 1'"),
        (ARM.replace('xyz="0 0 1" rpy', 'xyz="0 1" rpy'), "joint swing: xyz of <origin> is '0 1'; expected 3"),
        (ARM.replace('rpy="0 0 0.5"', 'rpy="0 0 0.5 1"'), "joint swing: rpy of <origin> is '0 0 0.5 1'; expected 3"),
        (ARM.replace('axis xyz="0 0 2"', 'axis xyz="0 0 0"'), r"joint swing has the axis \[0.0, 0.0, 0.0\]"),
        (ARM.replace('axis xyz="0 0 2"', 'axis xyz="0 2"'), "joint swing: xyz of <axis> is '0 2'; expected 3"),
        (
            ARM.replace('multiplier="-2"', 'multiplier="nan"'),
            "joint follow: multiplier of <mimic> is 'nan'; expected 1 finite number$",
        ),
        (ARM.replace('mimic joint="swing"', 'mimic joint="gone"'), "follow mimics 'gone'; valid.*: swing, slide$"),
        (ARM.replace('mimic joint="swing"', 'mimic joint="follow"'), "follow mimics 'follow'; valid"),
        (ARM.replace("<mimic joint", "<mimic leader"), "follow mimics ''; valid"),
        (
            ARM.replace('scale="2 2 2"', 'scale="2 2"'),
            "link upper: scale of <mesh> is '2 2'; expected 1 or 3 finite numbers other than 0",
        ),
        (ARM.replace('scale="2 2 2"', 'scale="2 0 2"'), "link upper: scale of <mesh> is '2 0 2'"),
        (ARM.replace('filename="package://parts/tri.stl"', ""), "link upper: <mesh> has no filename"),
        (ARM.replace('rgba="1 0.5 0 1"', 'rgba="1 0.5 0"'), "material paint: rgba of <color> is '1 0.5 0'; expected 4"),
        (ARM.replace('sphere radius="0.01"', "sphere"), "link finger: radius of <sphere> is missing; expected 1"),
        (ARM.replace('box size="0.2 0.2 0.2"', 'box size="0.2 0.2"'), "link base: size of <box> is '0.2 0.2'"),
        (ARM.replace('<box size="0.2 0.2 0.2"/>', ""), "not a valid URDF"),
        (ARM.replace('<link name="hand"/>', '<link name="&hand;"/>'), "not a valid URDF.*Entity 'hand' not defined"),
        ('<!DOCTYPE robot SYSTEM "robot.dtd">' + ARM.replace('name="two"', 'name="&two;"'), "declares XML entities"),
        ('<!DOCTYPE robot [<!ENTITY two "two">]>' + ARM, "declares XML entities"),
        (
            ARM.replace('name="swing" type="revolute"', 'name="swing" type="hinge"'),
            "joint swing has the type 'hinge'; va",
        ),
        (ARM.replace('joint name="slide"', 'joint name="swing"'), "2 <joint> have the name 'swing'; expected unique"),
        (ARM.replace('<link name="finger">', "<link>"), "1 <link> have the name None; expected unique names"),
        (ARM.replace('<parent link="upper"/>', ""), "joint slide has no <parent> with a link"),
        (
            ARM.replace('type="prismatic"', 'type="floating"'),
            "joint 'slide', between .* and 'hand', is floating; valid",
        ),
        (ARM.replace('type="prismatic"', 'type="planar"'), "joint 'slide', between .* and 'hand', is planar; valid th"),
        (
            ARM.replace('lower="-1" upper="2"', 'upper="2"'),
            "'swing' is revolute and has the limits -inf to 2.0; expected",
        ),
        (
            ARM.replace('<limit lower="-1" upper="2" effort="1" velocity="1"/>', ""),
            "joint 'swing' is revolute and has the limits -inf to inf; expected a <limit> with a finite lower",
        ),
        (ARM.replace('lower="-1" upper="2"', 'lower="3" upper="2"'), "joint swing has the limits 3.0 to 2.0"),
        (ARM.replace('lower="-1" upper="2"', 'lower="nan" upper="2"'), "joint swing has the limits nan to 2.0"),
    ],
)
def test_broken_descriptions_are_refused(small_arm, content, message):
    small_arm.write_text(content)
    with pytest.raises(UserError, match=message) as caught:
        load_robot(str(small_arm), ("swing",), "hand")
    assert str(small_arm) in str(caught.value)
