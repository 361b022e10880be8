"""A model brings its own robot: commands and page take the one that it was trained for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mild_viz.checkpoint import save_checkpoint
from mild_viz.checkpoint.model import RobotInterface
from mild_viz.dashboard.scene.figure import make_figure
from mild_viz.dashboard.scene.scene import scene_layout
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.robot.robots import ROBOTS, robot_of
from mild_viz.run_options import RunOptions
from tests.models import random_checkpoint, random_hmm, random_vae


def model_for(dataset: str, folder: Path) -> Path:
    """A model with random weights for the robot of a dataset."""
    rng, name = np.random.default_rng(4), robot_of(dataset)
    interface = RobotInterface(name, ROBOTS[name].joint_names, ROBOTS[name].end_effector)
    checkpoint = replace(
        random_checkpoint(variants=("v3.1",)),
        dataset=dataset,
        rate=load_dataset(dataset).test[0].rate,
        robot=interface,
        hmms={action: random_hmm(rng, 6, 10) for action in load_dataset(dataset).actions},
        robot_vaes={"v3.1": random_vae(rng, 5 * len(interface.joint_names))},
        contact_states={},
    )
    save_checkpoint(checkpoint, folder, "random")
    return folder


@pytest.mark.parametrize("name", ["handover", "yumi"])
def test_a_rollout_shows_the_robot_of_the_model(name: str, tmp_path: Path, dataset: Callable[[str], Any]) -> None:
    dataset(name)
    folder = model_for(name, tmp_path / "model")
    rollout, robot = RunOptions(checkpoint=folder, dataset=name, split="test", trial=3, contact_states=(0, 1)).run()
    assert rollout.robot == robot.name == robot_of(name)
    chain = robot.chain
    assert (rollout.joints_commanded >= chain.lower).all() and (rollout.joints_commanded <= chain.upper).all()
    assert np.isfinite(rollout.link_poses).all()
    with pytest.raises(UserError, match="has no joint"):
        RunOptions(checkpoint=folder, dataset=name, robot="pepper").run()


def test_the_scene_is_laid_out_around_one_who_walked(tmp_path: Path, dataset: Callable[[str], Any]) -> None:
    dataset("handover")
    folder = model_for("handover", tmp_path / "model")
    rollout, _ = RunOptions(checkpoint=folder, dataset="handover", split="test", trial=3).run()
    layout = scene_layout(rollout, make_figure(rollout.inference), np.array([[-0.2, -0.1, 0.0], [0.1, 0.1, 0.3]]))
    start, person = rollout.T_world_human[:2, 3], layout.human_top[:2]
    assert np.linalg.norm(start) - np.linalg.norm(person) > 0.5  # came nearer by walking
    np.testing.assert_allclose(layout.forward[:2], person / np.linalg.norm(person))
    farthest = float((layout.walk @ layout.forward).max())
    assert farthest > np.linalg.norm(person) and len(layout.walk) >= 16  # the whole walk, not where it mostly is
    np.testing.assert_allclose(layout.plot_centre[:2] @ layout.forward[:2], farthest + 1.4)
