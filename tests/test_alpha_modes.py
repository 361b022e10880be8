"""The three forward variables of an inference, each against a filter that is written out here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mild_viz.checkpoint import Checkpoint, load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.data.windows import human_windows, windows
from mild_viz.latent.hmm import HMM, log_emission
from mild_viz.pairs import robot_truth
from mild_viz.paths import default_checkpoint
from mild_viz.pipeline import infer
from mild_viz.trial import Trial
from tests.models import random_checkpoint

LOST = slice(60, 110)
"""Frames without the partner: longer than a gap that is filled."""


def filtered(hmm: HMM, likelihood: np.ndarray) -> np.ndarray:
    """p(state at n given the observations up to n), by Eq. hmm-h in probabilities."""
    alpha = np.empty(likelihood.shape)
    predicted = hmm.initial_probs
    for n, row in enumerate(likelihood):
        joint = predicted * np.exp(row - row.max())
        alpha[n] = joint / joint.sum()
        predicted = alpha[n] @ hmm.transition_matrix
    return alpha


def latents(model: Checkpoint, trial: Trial, variant: str) -> tuple[np.ndarray, np.ndarray]:
    """Posterior means of the human's and of the true robot's windows, row by row."""
    robot = windows(robot_truth(trial, model.for_robot().joint_names))[5:]
    human = human_windows(trial.human_arm)[: len(robot)]
    return model.human_vae.encode(human)[0], model.members(variant)[0].robot_vae.encode(robot)[0]


@pytest.fixture(scope="module", params=["demo", "random"])
def model(request: pytest.FixtureRequest) -> Checkpoint:
    return load_checkpoint(default_checkpoint("demo")) if request.param == "demo" else random_checkpoint(3)


@pytest.fixture(scope="module")
def trial() -> Trial:
    return next(trial for trial in load_dataset("demo").test if trial.action == "handshake")


@pytest.mark.parametrize("variant", ["v1", "v3.2"])
def test_each_mode_has_its_own_evidence(model: Checkpoint, trial: Trial, variant: str) -> None:
    inference = infer(model, trial, variant)
    human, robot = latents(model, trial, variant)
    hmm = model.hmm(trial.action)
    human_hmm = hmm.marginal(slice(0, 5))
    expected = {
        "human": filtered(human_hmm, log_emission(human_hmm, human)),
        "joint": filtered(hmm, log_emission(hmm, np.concatenate([human, robot], axis=1))),
        "unobserved": filtered(hmm, np.zeros((len(human), hmm.n_states))),
    }
    for mode, alpha in expected.items():
        np.testing.assert_allclose(np.exp(inference.log_alpha(mode)), alpha, atol=1e-9, err_msg=mode)
    for mode in ("joint", "unobserved"):  # the modes can be told apart here
        assert np.abs(expected[mode] - expected["human"]).max() > 0.1


def test_where_the_partner_is_lost_the_human_alone_says_something(model: Checkpoint, trial: Trial) -> None:
    assert trial.partner_arm is not None
    partner = trial.partner_arm.copy()
    partner[LOST] = np.nan
    gappy = replace(trial, partner_arm=partner, robot_joints=None, robot_joint_names=())
    inference = infer(model, gappy, "v3.1")
    lost = np.isnan(inference.robot_latent_truth).any(1)
    assert 20 < lost.sum() < 60 and inference.observed.all()
    human, _ = latents(model, trial, "v3.1")
    hmm = model.hmm(trial.action)
    human_hmm = hmm.marginal(slice(0, 5))
    human_likelihood = log_emission(human_hmm, human)
    joint = log_emission(hmm, np.concatenate([human, inference.robot_latent_truth], axis=1))
    assert (joint[lost] == 0.0).all()
    silent = filtered(hmm, joint)
    joint[lost] = human_likelihood[lost]
    expected = filtered(hmm, joint)
    np.testing.assert_allclose(np.exp(inference.log_alpha_joint), expected, atol=1e-9)
    assert np.abs(expected - silent)[lost].max() > 0.1  # a filter that only predicts would differ
