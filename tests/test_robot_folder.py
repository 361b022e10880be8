"""A robot is a folder: what robot.toml may say, and that a made-up arm works without a line of code."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mild_viz.dashboard.catalog import Catalog
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.paths import checkpoints
from mild_viz.robot.ik import forward, solve_ik
from mild_viz.robot.model import load_robot
from mild_viz.robot.retarget_arm import MAX_RATE, retarget_arm
from mild_viz.robot.robots import ROBOTS, find_robot
from mild_viz.robot.spec import read_spec
from mild_viz.run_options import RunOptions

LINKS = (("waist", "0 0 0.4", "0 0 1"), ("lift", "0 0 0.1", "0 1 0"), ("twist", "0.15 0 0", "1 0 0"),
         ("bend", "0.2 0 0", "0 1 0"), ("roll", "0.15 0 0", "1 0 0"))  # fmt: skip


def urdf() -> str:
    """A five-joint arm of balls, with a finger that slides."""
    parts, parent = ['<robot name="crane"><link name="foot"/>'], "foot"
    for name, xyz, axis in LINKS:
        parts.append(
            f'<link name="{name}_link"><visual><geometry><sphere radius="0.04"/></geometry></visual></link>'
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/>'
            f'<origin xyz="{xyz}"/><axis xyz="{axis}"/><limit lower="-2" upper="2" effort="10" velocity="3"/></joint>'
        )
        parent = f"{name}_link"
    parts.append(
        f'<link name="finger"/><joint name="slide" type="prismatic"><parent link="{parent}"/><child link="finger"/>'
        '<origin xyz="0.1 0 0"/><axis xyz="0 1 0"/><limit lower="0" upper="0.05" effort="1" velocity="1"/></joint>'
    )
    return "".join(parts) + "</robot>"


SPEC = """
title = "Crane"
description = "crane.urdf"
[arms.only]
joints = ["waist", "lift", "twist", "bend", "roll"]
end_effector = "roll_link"
tip_offset = [0.2, 0.0, 0.05]
elbow = "bend"
[rest]
bend = 1.0
slide = 0.01
[hands]
handshake = { slide = 0.04 }
[safety]
margin = 0.05
acceleration = 8.0
[dynamics]
rotor_inertia = 0.03
"""


@pytest.fixture
def crane(tmp_path: Path) -> Path:
    folder = tmp_path / "crane"
    folder.mkdir()
    (folder / "crane.urdf").write_text(urdf())
    (folder / "robot.toml").write_text(SPEC)
    return folder


def test_a_folder_is_a_robot(crane: Path) -> None:
    robot = load_robot(str(crane))
    assert (robot.name, robot.title, list(robot.arms)) == ("crane", "Crane", ["only"])
    np.testing.assert_array_equal(robot.chain.rest, [0.0, 0.0, 0.0, 1.0, 0.0])
    np.testing.assert_array_equal(robot.chain.velocity, np.full(5, 3.0))
    assert (robot.spec.safety.margin, robot.spec.safety.acceleration) == (0.05, 8.0)
    assert robot.spec.dynamics.rotor_inertia == 0.03
    # stretched out, the tip is beyond the last joint by its offset
    hand = robot.end_effector(np.zeros((1, 5)))[0]
    np.testing.assert_allclose(hand, [0.15 + 0.2 + 0.15 + 0.2, 0.0, 0.5 + 0.05], atol=1e-9)
    poses = dict(zip(robot.link_names, robot.link_poses(np.zeros((1, 5)), "handshake")[0], strict=True))
    np.testing.assert_allclose(poses["roll_link"][4:], [0.5, 0.0, 0.5], atol=1e-9)


def test_its_kinematics_and_retargeting_work_without_code(crane: Path) -> None:
    chain = load_robot(str(crane)).chain
    target = np.array([[0.45, 0.1, 0.6]])
    joints = solve_ik(chain, target, chain.rest[None], 1.0, 1e-8)
    np.testing.assert_allclose(forward(chain, joints), target, atol=1e-4)
    trial = next(trial for trial in load_dataset("demo").test if trial.action == "handshake")
    assert trial.partner_arm is not None
    moved = retarget_arm(chain, trial.partner_arm, trial.rate)
    known = np.logical_and.reduce(np.isfinite(moved), axis=1)
    assert known.sum() > 30
    assert (moved[known] >= chain.lower).all() and (moved[known] <= chain.upper).all()
    steps = np.abs(np.diff(moved, axis=0))[known[1:] & known[:-1]]
    assert 0.01 < steps.max() <= MAX_RATE / trial.rate + 1e-9


def test_the_whole_pipeline_drives_it_without_code(crane: Path) -> None:
    """The shipped model of a second human moves it, from a recording to the drawn links."""
    states = tuple(range(6))  # every frame is adapted by inverse kinematics
    run = RunOptions(
        checkpoint=checkpoints() / "nuisi-human", trial=4, robot=str(crane), contact_states=states,
        placement=(0.9, 0.0, 0.5),
    )  # fmt: skip
    rollout, robot = run.run()
    assert (rollout.robot, robot.title, rollout.contact.all()) == ("crane", "Crane", True)
    commanded = rollout.joints_commanded
    assert (commanded >= robot.chain.lower).all() and (commanded <= robot.chain.upper).all()
    np.testing.assert_allclose(forward(robot.chain, commanded), rollout.end_effector, atol=1e-9)
    assert np.nanmin(rollout.hand_distance) < 0.03  # by its tip, 0.2 m from the origin of the link
    assert np.isfinite(rollout.link_poses).all()
    assert np.ptp(rollout.link_poses[:, robot.link_names.index("roll_link"), 4:], axis=0).max() > 0.05


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (('title = "Crane"', 'titel = "Crane"'), "unknown key 'titel'; did you mean 'title'"),
        (('title = "Crane"', ""), "title is missing"),
        (("crane.urdf", "crain.urdf"), "is no URDF file"),
        (("crane.urdf", "robot.toml"), "is no URDF file"),
        (('"waist", "lift"', '"lift", "lift"'), "names one twice"),
        (('"waist", "lift"', '"lift", "waist"'), "not in this order"),
        (('"roll_link"', '"gripper"'), "no link 'gripper'"),
        (('elbow = "bend"', 'elbow = "knee"'), "elbow 'knee' is unknown"),
        (("bend = 1.0", "bent = 1.0"), "rest: there is no joint 'bent'"),
        (("slide = 0.04", "slid = 0.04"), "hands.handshake: there is no joint 'slid'"),
        (("handshake =", "handshaking ="), "action 'handshaking' is unknown"),
        (("bend = 1.0", 'bend = "up"'), "rest.bend is 'up', expected a finite number"),
        (("inertia = 0.03", "inertia = -0.03"), "valid: a finite number of 0 or more kg m^2"),
        (("margin = 0.05", "margin = -0.05"), "valid: a margin of 0 to 0.5 rad"),
        (("[safety]", "[stiffness]\nlowest = 0.9\nhighest = 0.4\n[safety]"), "0 <= lowest <= highest <= 1"),
        (('elbow = "bend"', 'retarget = "angles"'), "retarget 'angles' is unknown; valid: position, pepper-angles"),
        (('elbow = "bend"', 'mirror_of = "right"'), "mirror_of 'right' is unknown"),
        (('elbow = "bend"', "mirror_signs = [1.0]"), "mirror_signs without mirror_of"),
        (("[rest]", "[arms.only.position]\nlift = true\n[rest]"), "arms.only.position.lift is True"),
        (("[rest]", "[arms.only.position]\nlevel_wight = 1\n[rest]"), "did you mean 'level_weight'"),
        (("[rest]", "[arms.only.position]\nlevel_weight = -1\n[rest]"), "a weight below 0"),
        (("[rest]", "[arms.only.position]\njoint_weights = [1]\n[rest]"), "expected 5, or none"),
        (("[rest]", "[arms.only.position]\nelbow_weight = 1\n[rest]"), "lean or rise, with it"),
        (("[arms.only]", "[arms.only"), "is not valid TOML"),
    ],
)
def test_a_wrong_entry_is_named(crane: Path, edit: tuple[str, str], message: str) -> None:
    file = crane / "robot.toml"
    assert edit[0] in file.read_text()
    file.write_text(file.read_text().replace(*edit))
    with pytest.raises(UserError, match="robot.toml|crane.urdf") as caught:
        load_robot(str(crane))
    assert message in str(caught.value)


def test_the_chooser_of_the_page_has_it_by_its_title(crane: Path) -> None:
    assert Catalog(load_robot(str(crane))).robot_titles["crane"] == "Crane"
    file = crane / "robot.toml"
    file.write_text(file.read_text().replace('"Crane"', '"Panda"'))
    assert Catalog(load_robot(str(crane))).robot_titles["crane"] == "Panda (crane)"  # no two of one title


def test_what_is_no_robot_is_refused(tmp_path: Path) -> None:
    for name in ("robby", str(tmp_path), str(tmp_path / "none.urdf")):
        with pytest.raises(UserError, match="robot '.*(pepper, .*panda|is not a file)"):
            find_robot(name)


@pytest.mark.parametrize("name", list(ROBOTS))
def test_every_shipped_folder_loads_with_all_its_arms(name: str) -> None:
    robot = load_robot(name)
    assert read_spec(robot.urdf.parent).title == robot.title
    assert list(robot.arms) == list(ROBOTS[name].arms)
    for chain, arm in zip(robot.arms.values(), ROBOTS[name].arms.values(), strict=True):
        assert chain.joint_names == arm.joints
        assert np.isfinite(chain.velocity).all() and (chain.velocity > 0.5).all()
        assert (chain.rest > chain.lower).all() and (chain.rest < chain.upper).all()


def mirrored(points: Any) -> Any:
    return points * (1.0, -1.0, 1.0)


@pytest.mark.parametrize("name", [name for name in ROBOTS if len(ROBOTS[name].arms) == 2])
def test_the_mirrored_arm_has_its_hand_at_the_mirrored_place(name: str) -> None:
    robot = load_robot(name)
    left = robot.spec.arms["left"]
    assert left.mirror_of == "right"
    chains = robot.arms
    joints = np.random.default_rng(0).uniform(chains["right"].lower, chains["right"].upper, (200, len(left.joints)))
    hands = forward(chains["right"], joints), forward(chains["left"], joints * left.mirror_signs)
    # YuMi's own numbers are mirrored to a few millimetres only: its two mounting angles differ by up to .003 rad
    np.testing.assert_allclose(hands[1], mirrored(hands[0]), atol=1e-6 if name != "yumi" else 5e-3)


def test_another_arm_moves_when_it_is_told_to() -> None:
    robot = load_robot("pepper")
    rest = robot.chain.rest[None]
    left = robot.arms["left"]
    raised = np.array([[0.0, 0.3, -1.0, -0.5]])
    poses = [robot.link_poses(rest, others=others)[0] for others in (None, {"left": left.rest[None]}, {"left": raised})]
    np.testing.assert_array_equal(poses[0], poses[1])
    moved = {
        link for link, a, b in zip(robot.link_names, poses[0], poses[2], strict=True) if np.abs(a - b).max() > 1e-3
    }
    assert "l_wrist" in moved and not any(link.startswith(("R", "r_")) for link in moved)
    with pytest.raises(UserError, match="no other arm 'middle'; valid: left"):
        robot.link_poses(rest, others={"middle": raised})
