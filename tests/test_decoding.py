"""What models of a second human do on robots: the arm that they decode, retargeted frame by frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mild_viz import streaming
from mild_viz.checkpoint import Checkpoint, load_checkpoint
from mild_viz.cli import main
from mild_viz.data.load import load_dataset
from mild_viz.data.windows import human_windows
from mild_viz.decoding import decoding_of, open_robot
from mild_viz.errors import UserError
from mild_viz.evaluation.metrics import window_errors
from mild_viz.pairs import robot_truth
from mild_viz.paths import checkpoints
from mild_viz.pipeline import control, infer
from mild_viz.prediction import predict
from mild_viz.robot.model import load_robot
from mild_viz.robot.retarget import retarget_pepper
from mild_viz.robot.retarget_arm import MAX_RATE, retarget_arm
from mild_viz.settings import ControlSettings
from mild_viz.trial import Trial

ROBOTS = ("pepper", "panda", "yumi")


@pytest.fixture(scope="module")
def model() -> Checkpoint:
    return load_checkpoint(checkpoints() / "nuisi-human")


@pytest.fixture(scope="module")
def trial() -> Trial:
    return next(trial for trial in load_dataset("nuisi").test if trial.action == "handshake")


def arm_by_hand(model: Checkpoint, trial: Trial, variant: str) -> np.ndarray:
    """The second human's arm in the first predicted frame of every window."""
    n = trial.n_frames - 9
    decoded = predict(model, variant, trial.action, human_windows(trial.human_arm)[:n]).decoded
    return decoded.reshape(n, 5, 2, 3, 3)[:, 0, 0]


@pytest.mark.parametrize("name", ROBOTS)
def test_a_model_of_a_second_human_moves_any_robot(model: Checkpoint, trial: Trial, name: str) -> None:
    robot = load_robot(name)
    inference = infer(model, trial, "v4", robot)
    arm = arm_by_hand(model, trial, "v4")
    np.testing.assert_array_equal(inference.partner_decoded, arm)
    assert trial.partner_arm is not None and inference.partner_truth is not None
    np.testing.assert_array_equal(inference.partner_truth[3], trial.partner_arm[3 + 5])
    np.testing.assert_array_equal(inference.joints_truth, robot_truth(trial, robot.chain.joint_names)[5:-4])
    assert inference.joint_names == robot.chain.joint_names and inference.decodes == "arm"
    expected = retarget_pepper(arm)
    if name != "pepper":
        upper, fore = np.linalg.norm(arm[:, 1] - arm[:, 0], axis=1), np.linalg.norm(arm[:, 2] - arm[:, 1], axis=1)
        expected = retarget_arm(robot.chain, arm, trial.rate, length=upper + fore)
        assert np.abs(np.diff(inference.joints_decoded, axis=0)).max() <= MAX_RATE / trial.rate + 1e-12
    np.testing.assert_array_equal(inference.joints_decoded, expected)
    assert (inference.joints_decoded >= robot.chain.lower).all() and (
        inference.joints_decoded <= robot.chain.upper
    ).all()
    # as near to the retargeted truth as models of joints are: a resting robot is much farther
    error = np.nanmean((inference.joints_decoded - inference.joints_truth) ** 2)
    assert error < 0.2 * np.nanmean((robot.chain.rest - inference.joints_truth) ** 2)


def test_the_error_is_that_of_the_evaluation_in_square_metres(model: Checkpoint, trial: Trial) -> None:
    inference = infer(model, trial, "v1", load_robot("panda"))
    assert trial.partner_arm is not None and inference.error_unit == "m²"
    n = inference.n_windows
    decoded = predict(model, "v1", trial.action, human_windows(trial.human_arm)[:n]).decoded
    in_cm = window_errors(decoded, human_windows(trial.partner_arm)[5:], True)
    np.testing.assert_allclose(100.0 * inference.window_error, in_cm, rtol=1e-12)


def test_without_a_robot_it_moves_the_one_of_its_dataset(model: Checkpoint, trial: Trial) -> None:
    assert infer(model, trial, "v1").joint_names == load_robot("pepper").chain.joint_names
    assert open_robot(load_checkpoint(checkpoints() / "handover-human")).name == "panda"


def test_without_a_second_human_the_truth_is_unknown(model: Checkpoint, trial: Trial) -> None:
    alone = replace(trial, partner_arm=None, partner_skeleton=None)
    known, unknown = (infer(model, one, "v1", load_robot("panda")) for one in (trial, alone))
    np.testing.assert_array_equal(unknown.joints_decoded, known.joints_decoded)
    assert np.isnan(unknown.joints_truth).all() and np.isnan(unknown.window_error).all()


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("variant", ["v1", "v4"])
def test_the_stream_gives_the_same_numbers(model: Checkpoint, trial: Trial, name: str, variant: str) -> None:
    arm = trial.human_arm.copy()
    arm[60:90], arm[130:134] = np.nan, np.nan  # a gap that is not bridged, and one that is
    trial, robot = replace(trial, human_arm=arm), load_robot(name)
    settings = ControlSettings(contact_states=frozenset({2, 3}))
    rollout = control(infer(model, trial, variant, robot), model, robot, trial, settings)
    stream = streaming.stream_model(model, variant, trial.action, robot, settings, rollout.T_world_human, trial.rate)
    carry, commands = streaming.start(stream), []
    for frame in arm:
        carry, command = streaming.step(stream, carry, frame)
        if command is not None:
            commands.append(command)
    decoded, joints, stiffness = (
        np.stack([getattr(command, field) for command in commands[: rollout.inference.n_windows]])
        for field in ("joints_decoded", "joints_commanded", "stiffness")
    )
    # inputs that differ by the rounding of a matrix product move a joint that costs almost nothing by micro-radians
    np.testing.assert_allclose(decoded, rollout.inference.joints_decoded, atol=1e-5)
    np.testing.assert_allclose(joints, rollout.joints_commanded, atol=1e-5)
    np.testing.assert_array_equal(stiffness, rollout.stiffness)


@pytest.mark.parametrize("name", ROBOTS)
def test_one_window_at_a_time_moves_the_robot_by_the_same_bits(model: Checkpoint, name: str) -> None:
    decoding = decoding_of(model, load_robot(name), 30.0)
    rng = np.random.default_rng(0)
    rows = rng.normal(scale=0.4, size=(50, 90))
    rows[20:23] = np.nan
    whole, carry = decoding.move(rows, decoding.start()), decoding.start()
    for n in range(len(rows)):
        part = decoding.move(rows[n : n + 1], carry)
        carry = part.carry
        np.testing.assert_array_equal(part.joints[0], whole.joints[n])
    np.testing.assert_array_equal(carry, whole.carry)


def test_a_model_of_joints_drives_its_own_robot_only(trial: Trial) -> None:
    pepper = load_checkpoint(checkpoints() / "nuisi-pepper")
    with pytest.raises(UserError, match="model 'nuisi-pepper' drives the joints RShoulderPitch.*robot 'panda'"):
        infer(pepper, trial, "v3.1", load_robot("panda"))


def test_the_command_runs_it(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rollout.npz"
    command = ["rollout", "--checkpoint", str(checkpoints() / "nuisi-human"), "--dataset", "nuisi", "--variant", "v4"]
    assert main([*command, "--robot", "yumi", "--out", str(out)]) in (0, None), capsys.readouterr().err
    with np.load(out) as arrays:
        assert arrays["joints_commanded"].shape[1] == 7 and np.isfinite(arrays["joints_commanded"]).all()
