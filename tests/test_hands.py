"""Models of two hands: what they read, how a robot's two arms follow them, and the shipped one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mild_viz import streaming
from mild_viz.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from mild_viz.cli import main
from mild_viz.data.windows import human_features
from mild_viz.decoding import HandDecoding, decoding_of
from mild_viz.errors import UserError
from mild_viz.pairs import stack_windows
from mild_viz.paths import default_checkpoint
from mild_viz.pipeline import control, infer
from mild_viz.robot.ik import forward
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.robot.retarget_arm import LARGEST_FRACTION, MAX_RATE
from mild_viz.robot.workspace import ARM_OF, Box, HandMap, hand_map, measure_workspace
from mild_viz.settings import ControlSettings
from mild_viz.trial import ARM_POINTS, HAND_POINTS, Dataset, Trial

TASK_SPACE = ControlSettings(controller="task-space")


@pytest.fixture(scope="module")
def model() -> Checkpoint:
    return load_checkpoint(default_checkpoint("handover-hands"))


@pytest.fixture(scope="module")
def handovers(dataset: Callable[[str], Any]) -> Dataset:
    return dataset("handover-hands")


@pytest.fixture(scope="module")
def trial(handovers: Dataset) -> Trial:
    return handovers.test[0]


@pytest.fixture(scope="module", params=["kobo", "yumi"])
def robot(request: pytest.FixtureRequest) -> RobotModel:
    return load_robot(request.param)


@pytest.fixture(scope="module")
def follow(robot: RobotModel, model: Checkpoint) -> HandMap:
    assert model.workspace is not None
    return hand_map(robot, model.workspace)


def test_a_trial_of_hands_gives_both_wrists_of_both_people(handovers: Dataset, trial: Trial) -> None:
    assert trial.points == HAND_POINTS and trial.human_skeleton is not None and trial.partner_skeleton is not None
    for points, body, arm in (
        (trial.human_points, trial.human_skeleton, trial.human_arm),
        (trial.partner_points, trial.partner_skeleton, trial.partner_arm),
    ):
        assert points is not None and arm is not None and points.shape == (trial.n_frames, 2, 3)
        np.testing.assert_array_equal(points[:, 0], arm[:, 2])
        np.testing.assert_array_equal(points[:, 1], body.positions[:, body.joint_names.index("left_wrist")])
    data = stack_windows(handovers.test[:1], None)
    assert data.human.shape == data.partner.shape == (trial.n_frames - 9, 60)
    np.testing.assert_array_equal(data.human[3], human_features(trial.human_points)[3:8].reshape(-1))
    with pytest.raises(UserError, match="has no skeleton, which right_wrist, left_wrist would be read from"):
        _ = replace(trial, human_skeleton=None).human_points


def test_the_workspace_holds_nine_tenths_of_the_recorded_hands(model: Checkpoint, handovers: Dataset) -> None:
    assert model.workspace is not None and model.points == HAND_POINTS
    assert model.workspace == measure_workspace(handovers.train)
    hands = np.concatenate([np.asarray(trial.partner_points) for trial in handovers.train])
    for index, box in enumerate(model.workspace):
        inside = (hands[:, index] >= box.lower) & (hands[:, index] <= box.upper)
        assert (inside.mean(axis=0) >= 0.9 - 1e-3).all() and (inside.mean(axis=0) < 0.96).all()
    with pytest.raises(UserError, match="no trial shows both hands of a second human"):
        measure_workspace([replace(handovers.test[0], partner_skeleton=None)])


def test_every_corner_and_the_inside_of_the_boxes_is_reached(robot: RobotModel, follow: HandMap) -> None:
    assert ((follow.scale > 0.2) & (follow.scale <= 1.0)).all(), "no axis is stretched: the hands hold one object"
    decoding = HandDecoding(robot, follow, 30.0)
    shares = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 5)] * 3), axis=-1).reshape(-1, 1, 3)
    lower, upper = (np.array([getattr(box, side) for box in follow.workspace]) for side in ("lower", "upper"))
    hands = lower + shares * (upper - lower)
    targets = follow(hands)
    for n in range(len(hands)):  # one by one: no limit of speed between them
        joints = decoding.follow(hands[n : n + 1], decoding.start())
        for index, arm in enumerate(ARM_OF.values()):
            chain = robot.arms[arm]
            assert np.linalg.norm(forward(chain, joints[arm])[0] - targets[n, index]) < 0.01
            assert np.linalg.norm(targets[n, index] - chain.shoulder) <= LARGEST_FRACTION * chain.reach


def test_the_map_is_affine_inside_the_boxes_and_moves_hands_into_them(follow: HandMap) -> None:
    rng = np.random.default_rng(0)
    hands = rng.uniform(-2.0, 2.0, (500, 2, 3))
    mapped = (follow(hands) - follow.offset) / follow.scale
    for index, box in enumerate(follow.workspace):
        inside = ((hands[:, index] >= box.lower) & (hands[:, index] <= box.upper)).all(axis=1)
        np.testing.assert_allclose(mapped[inside, index], hands[inside, index], atol=1e-12)
        assert (mapped[:, index] >= np.array(box.lower) - 1e-9).all()
        assert (mapped[:, index] <= np.array(box.upper) + 1e-9).all()
    assert np.isnan(follow(np.full((1, 2, 3), np.nan))).all()


def test_a_larger_workspace_is_scaled_more_and_a_hopeless_one_refused(robot: RobotModel, follow: HandMap) -> None:
    grown = tuple(Box(*(tuple((1.5 * np.array(c)).tolist()) for c in (b.lower, b.upper))) for b in follow.workspace)
    assert np.prod(hand_map(robot, grown).scale) < np.prod(follow.scale)
    with pytest.raises(UserError, match="reaches less than a fifth"):
        hand_map(robot, (Box((-5.0, -5.0, -5.0), (5.0, 5.0, 5.0)),) * 2)


def test_both_arms_follow_the_decoded_hands(
    model: Checkpoint, robot: RobotModel, follow: HandMap, trial: Trial
) -> None:
    inference = infer(model, trial, "v1", robot)
    rollout = control(inference, model, robot, trial, TASK_SPACE)
    assert inference.decodes == "hands" and inference.error_unit == "m²"
    assert inference.partner_decoded is not None and inference.partner_decoded.shape == (inference.n_windows, 2, 3)
    targets = follow(inference.partner_decoded)
    commanded = {"right": rollout.joints_commanded} | {arm.name: arm.joints_commanded for arm in rollout.other_arms}
    for index, arm in enumerate(ARM_OF.values()):
        chain, joints = robot.arms[arm], commanded[arm]
        assert (joints >= chain.lower).all() and (joints <= chain.upper).all()
        assert (np.abs(np.diff(joints, axis=0)) <= chain.velocity / trial.rate + 1e-9).all()
        asked = inference.joints_decoded if arm == "right" else inference.others_decoded[arm]
        assert np.abs(np.diff(asked, axis=0)).max() <= MAX_RATE / trial.rate + 1e-9
        apart = np.linalg.norm(forward(chain, joints) - targets[:, index], axis=1)
        assert np.quantile(apart[15:], 0.9) < 0.02, "once it has left its rest, the command is at most a frame late"
    left = [name for name in robot.moving_links if "left" in name or name.endswith("_l")]
    poses = dict(zip(robot.link_names, rollout.link_poses.transpose(1, 0, 2), strict=True))
    assert left and max(float(np.ptp(poses[name][:, 4:], axis=0).max()) for name in left) > 0.02, "the left arm moves"


def test_the_stream_moves_both_arms_by_the_same_numbers(model: Checkpoint, robot: RobotModel, trial: Trial) -> None:
    assert trial.human_skeleton is not None
    positions = trial.human_skeleton.positions.copy()
    positions[40:70, 14], positions[90:93] = np.nan, np.nan
    gappy = replace(trial, human_skeleton=replace(trial.human_skeleton, positions=positions))
    rollout = control(infer(model, gappy, "v1", robot), model, robot, gappy, TASK_SPACE)
    stream = streaming.stream_model(model, "v1", trial.action, robot, TASK_SPACE, rollout.T_world_human, trial.rate)
    carry, commands, left = streaming.start(stream), [], []
    for frame in gappy.human_points:
        carry, command = streaming.step(stream, carry, frame)
        if command is not None:
            commands.append(command)
            left.append(carry.others["left"].joints)
    n, (other,) = rollout.inference.n_windows, rollout.other_arms
    for name, whole in (
        ("joints_decoded", rollout.inference.joints_decoded),
        ("joints_commanded", rollout.joints_commanded),
        ("target", rollout.target),
    ):
        np.testing.assert_allclose(np.stack([getattr(one, name) for one in commands[:n]]), whole, atol=1e-9)
    np.testing.assert_allclose(np.stack(left[:n]), other.joints_commanded, atol=1e-9)
    carry, command = streaming.idle(stream, carry, 0.1)
    assert command.joints_commanded.shape == carry.others["left"].joints.shape == (7,)


def test_one_window_at_a_time_moves_both_arms_by_the_same_bits(robot: RobotModel, model: Checkpoint) -> None:
    decoding, rng = decoding_of(model, robot, 30.0), np.random.default_rng(0)
    rows = rng.normal(scale=0.4, size=(40, 60))
    rows[20:23] = np.nan
    whole, carry = decoding.move(rows, decoding.start()), decoding.start()
    for n in range(len(rows)):
        part = decoding.move(rows[n : n + 1], carry)
        carry = part.carry
        np.testing.assert_array_equal(part.joints[0], whole.joints[n])
        np.testing.assert_array_equal(part.others["left"][0], whole.others["left"][n])


def test_the_human_stands_where_hands_meet(model: Checkpoint, trial: Trial) -> None:
    kobo = load_robot("kobo")
    inference = infer(model, trial, "v1", kobo)
    rollout = control(inference, model, kobo, trial, TASK_SPACE)
    assert model.workspace is not None and inference.partner_truth is not None
    true = hand_map(kobo, model.workspace)(inference.partner_truth)[:, 0]
    apart = np.linalg.norm(true - rollout.target, axis=1)
    assert apart.min() < 0.06 and rollout.placement.source.startswith("recorded")


def test_what_does_not_go_with_it_is_refused(model: Checkpoint, trial: Trial, handovers: Dataset) -> None:
    kobo = load_robot("kobo")
    inference = infer(model, trial, "v1", kobo)
    with pytest.raises(UserError, match="controller 'mild-ik' is unknown; valid: task-space"):
        control(inference, model, kobo, trial, ControlSettings(controller="mild-ik"))
    with pytest.raises(UserError, match="reads right_wrist, left_wrist of the human, trial .* gives right_shoulder"):
        infer(model, replace(trial, points=ARM_POINTS), "v1", kobo)
    with pytest.raises(UserError, match="robot 'panda' has no .*left arm"):
        infer(model, trial, "v1", load_robot("panda"))


def test_a_folder_keeps_points_and_workspace(model: Checkpoint, tmp_path: Path) -> None:
    save_checkpoint(model, tmp_path / "copy", "# copy\n")
    loaded = load_checkpoint(tmp_path / "copy")
    assert loaded.points == model.points and loaded.workspace == model.workspace and loaded.decodes == "hands"


def test_the_command_runs_it(tmp_path: Path, handovers: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rollout.npz"
    assert main(["rollout", "--dataset", "handover-hands", "--out", str(out)]) in (0, None), capsys.readouterr().err
    assert "task-space" in capsys.readouterr().out and out.is_file()


def test_a_slow_arm_is_not_asked_to_be_fast(model: Checkpoint, trial: Trial) -> None:
    kobo = load_robot("kobo")
    slow = {name: replace(arm, velocity=np.full(7, 0.5)) for name, arm in kobo.arms.items()}
    decoding = decoding_of(model, replace(kobo, arms=slow), trial.rate)
    truth = decoding.truth(trial).joints
    steps = np.abs(np.diff(truth, axis=0))
    assert 0.4 < steps.max() * trial.rate <= 0.5 + 1e-9


def test_a_robot_that_interacts_with_neither_hand_is_refused(model: Checkpoint) -> None:
    kobo = load_robot("kobo")
    arms = {"middle": kobo.arms["right"], **kobo.arms}
    with pytest.raises(UserError, match="robot 'kobo' interacts with its arm 'middle'; .*right, left; put one of them"):
        decoding_of(model, replace(kobo, arms=arms), 30.0)
