"""Distances in metres, against forward kinematics and geometry that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mild_viz.checkpoint import load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.evaluation.distances import COMPARED, contact_distance, hand_error
from mild_viz.evaluation.passes import run_passes
from mild_viz.paths import default_checkpoint
from mild_viz.pipeline import control, infer
from mild_viz.robot.contact import contact_frames
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.settings import ControlSettings
from tests.passes import make_pass

PLANAR = """<robot name="planar">
  <link name="base"/><link name="upper"/><link name="fore"/><link name="hand"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0.3 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="wrist" type="fixed"><parent link="fore"/><child link="hand"/><origin xyz="0.2 0 0"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def planar(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    """Two links of 0.3 and 0.2 m in a plane."""
    file = tmp_path_factory.mktemp("robot") / "planar.urdf"
    file.write_text(PLANAR)
    return load_robot(str(file), ("shoulder", "elbow"), "hand")


def test_hand_error_is_that_of_known_kinematics(planar: RobotModel) -> None:
    truth, predicted = np.zeros((4, 10)), np.zeros((4, 10))
    predicted[1, 0] = np.pi / 2  # the whole arm turns: the hand moves from (.5, 0) to (0, .5)
    predicted[2, 1] = np.pi / 2  # the forearm turns: from (.5, 0) to (.3, .2)
    predicted[:, 2:] = 1.0  # later frames of the window do not count
    truth[3] = np.nan
    measured = hand_error([make_pass([0] * 4, predicted=predicted, truth=truth)], planar)
    assert measured is not None and measured.n_windows == 3
    distances = np.array([0.0, 0.5 * np.sqrt(2), 0.2 * np.sqrt(2)])
    assert measured.mean == pytest.approx(distances.mean())
    assert measured.std == pytest.approx(distances.std())
    assert measured.median == pytest.approx(0.2 * np.sqrt(2))


def test_between_humans_it_is_the_wrists_distance() -> None:
    truth, predicted = np.zeros((2, 90)), np.zeros((2, 90))
    predicted[0, 6:9] = (0.03, 0.0, 0.04)
    predicted[1, :6] = 1.0  # shoulder and elbow
    predicted[1, 9:] = 1.0  # velocities, and later frames
    measured = hand_error([make_pass([0, 0], predicted=predicted, truth=truth, human_human=True)], None)
    assert measured is not None
    assert measured.mean == pytest.approx(0.025) and measured.worst == pytest.approx(0.045)


def test_a_robot_is_needed_where_the_model_drives_one() -> None:
    with pytest.raises(UserError, match="description of the robot"):
        hand_error([make_pass([0])], None)
    assert hand_error([make_pass([0], truth=np.full((1, 20), np.nan))], None) is None


def test_distance_in_contact_is_that_of_the_rollouts() -> None:
    model, source, robot = load_checkpoint(default_checkpoint("demo")), load_dataset("demo"), load_robot("pepper")
    variant = "v3.1"
    trial = next(trial for trial in source.test if trial.action == "handshake")
    measured = contact_distance(model, robot, variant, [trial])
    assert measured is not None
    inference = infer(model, trial, variant)
    touching = contact_frames(trial)[4 : 4 + inference.n_windows]
    for controller in COMPARED:
        rollout = control(inference, model, robot, trial, ControlSettings(controller=controller))
        expected = rollout.hand_distance[touching & np.isfinite(rollout.hand_distance)]
        assert measured.controllers[controller] == pytest.approx(expected.mean())
        assert measured.n_frames == len(expected) > 20
    assert measured.controllers["mild-ik"] < 0.5 * measured.controllers["mild"]
    assert measured.truth is not None and 0.0 < measured.truth < 0.1
    assert contact_distance(model, robot, variant, [replace(trial, phase=np.zeros(trial.n_frames, int))]) is None


def test_hand_error_of_a_perfect_prediction_is_zero(planar: RobotModel) -> None:
    model, source = load_checkpoint(default_checkpoint("demo")), load_dataset("demo")
    (one,) = run_passes(model, model.variants[0], source.test[:1])
    robot = load_robot("pepper")
    perfect, real = hand_error([replace(one, predicted=one.truth)], robot), hand_error([one], robot)
    assert perfect is not None and real is not None
    assert perfect.mean == pytest.approx(0.0, abs=1e-12) and real.mean > 0.01
