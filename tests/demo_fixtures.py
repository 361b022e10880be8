"""The shipped demo model, its robot and a handshake: a plugin of the tests that run the whole chain on them."""

from __future__ import annotations

import pytest

from mild_viz.checkpoint import Checkpoint, load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.paths import default_checkpoint
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.trial import Trial


@pytest.fixture(scope="module")
def model() -> Checkpoint:
    return load_checkpoint(default_checkpoint("demo"))


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot("pepper")


@pytest.fixture(scope="module")
def handshake() -> Trial:
    return next(trial for trial in load_dataset("demo").test if trial.action == "handshake")
