"""Controllers compared on one trial: the figures against what they are defined as."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mild_viz.checkpoint import load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.evaluation.controllers import controller_figures
from mild_viz.paths import default_checkpoint
from mild_viz.pipeline import control, infer
from mild_viz.robot.ik import forward
from mild_viz.robot.model import load_robot
from mild_viz.settings import CONTROLLERS_OF, ControlSettings


def test_figures_are_what_they_are_defined_as() -> None:
    checkpoint, robot = load_checkpoint(default_checkpoint("demo")), load_robot("pepper")
    trial = next(trial for trial in load_dataset("demo").test if trial.action == "handshake")
    inference, settings = infer(checkpoint, trial, "v3.1"), ControlSettings(lambda_x=2.0, lambda_q=0.05)
    rollouts = [
        control(inference, checkpoint, robot, trial, replace(settings, controller=name))
        for name in CONTROLLERS_OF["joints"]
    ]
    figures = [controller_figures(rollout, robot.chain, 2.0, 0.05) for rollout in rollouts]
    assert tuple(one.controller for one in figures) == CONTROLLERS_OF["joints"]
    for rollout, one in zip(rollouts, figures, strict=True):
        assert rollout.inference is inference
        rows = [
            n for n in range(inference.n_windows)
            if rollout.contact[n] and inference.tracked[n] and np.isfinite(rollout.target[n]).all()
        ]  # fmt: skip
        assert one.n_contact == len(rows) > 20
        costs, distances, margins = [], [], []
        for n in rows:
            q = rollout.joints_commanded[n]
            error = float(np.linalg.norm(rollout.target[n] - forward(robot.chain, q[None])[0]))
            stray = float(np.sum((inference.joints_decoded[n] - q) ** 2))
            costs.append(2.0 * error**2 + 0.05 * stray)
            distances.append(error)
        for q in rollout.joints_commanded:
            margins += [*(q - robot.chain.lower), *(robot.chain.upper - q)]
        assert one.mean_distance == pytest.approx(np.mean(distances), abs=1e-9)
        assert one.smallest_distance == pytest.approx(min(distances), abs=1e-9)
        assert one.ik_cost == pytest.approx(np.mean(costs), abs=1e-9)
        assert one.limit_margin == pytest.approx(min(margins), abs=1e-12)
    base_ik, mild, mild_ik = figures
    # what the controllers are for: IK comes nearer than the decoded joints, and costs least with the prior
    assert mild_ik.mean_distance < mild.mean_distance and mild_ik.ik_cost < min(base_ik.ik_cost, mild.ik_cost)


def test_without_contact_the_figures_of_contact_are_unknown() -> None:
    checkpoint, robot = load_checkpoint(default_checkpoint("demo")), load_robot("pepper")
    trial = next(trial for trial in load_dataset("demo").test if trial.action == "wave")
    inference = infer(checkpoint, trial, "v3.1")
    settings = ControlSettings(contact_states=frozenset())
    rollout = control(inference, checkpoint, robot, trial, replace(settings, controller="mild"))
    figures = controller_figures(rollout, robot.chain, 1.0, 0.01)
    assert figures.n_contact == 0 and np.isnan([figures.mean_distance, figures.ik_cost]).all()
    assert figures.limit_margin >= 0.0
