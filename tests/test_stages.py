"""Both training stages on made windows: the prior, its weight, the sampling; and choices by held-out error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from mild_viz.evaluation.baselines import BASELINES, NEIGHBOURS, RIDGE_STRENGTHS, Examples, fit_nearest, fit_ridge
from mild_viz.latent.hmm import HMM, unobserved_forward
from mild_viz.pairs import Windows
from mild_viz.training import human_stage
from mild_viz.training import run as training_run
from mild_viz.training.human_stage import HumanModel, StatePriors, train_human_stage
from mild_viz.training.options import TrainingOptions
from mild_viz.training.outcome import choose_seed
from mild_viz.training.robot_stage import conditional_factors, train_robot_stage
from tests.models import random_hmm, random_vae

D = 2
N_STATES = 3
TWO = ("wave", "handshake")


def options(beta: float, epochs: int, seeds: int = 1) -> TrainingOptions:
    return TrainingOptions(
        seeds=seeds, latent_size=D, n_states=N_STATES, human_epochs=epochs, robot_epochs=epochs, batch_size=64,
        peak_learning_rate=2e-2, beta=beta, em_iterations=1, final_em_iterations=1,
    )  # fmt: skip


def silent(*_: Any) -> None:
    pass


def made_windows(human_at: float = 2.0, partner_at: float = -2.0, size: int = 4) -> Windows:
    """Four trials of 80 rows, two an action, whose human and partner windows lie in different places."""
    rng = np.random.default_rng(0)
    human, partner = rng.normal(size=(2, 320, size))
    return Windows(
        human + human_at, partner + partner_at, np.repeat(np.arange(4), 80), np.tile(np.arange(80), 4), TWO * 2
    )


def hmm_at(human_mean: float, robot_mean: float, variance: float) -> HMM:
    """All states alike: the human's latents around one place, the partner's around another."""
    mean = np.repeat([human_mean, robot_mean], D)
    return HMM(
        np.full(N_STATES, 1 / N_STATES),
        np.full((N_STATES, N_STATES), 1 / N_STATES),
        np.tile(mean, (N_STATES, 1)),
        np.tile(variance * np.eye(2 * D), (N_STATES, 1, 1)),
    )


# the prior


@pytest.mark.parametrize("agent", [slice(0, D), slice(D, 2 * D)], ids=["human", "partner"])
def test_state_priors_are_the_marginals_of_the_asked_agent(agent: slice) -> None:
    rng = np.random.default_rng(1)
    data = made_windows()
    models = [{action: random_hmm(rng, N_STATES, 2 * D) for action in TWO} for _ in range(2)]
    rows = torch.tensor([0, 5, 79, 80, 83, 200, 319])
    mean = torch.tensor(rng.normal(size=(2, len(rows), D)), dtype=torch.float32)
    log_std = torch.tensor(0.3 * rng.normal(size=(2, len(rows), D)), dtype=torch.float32)
    ours = StatePriors(models, data, agent).kl(mean, log_std, rows)
    for m, hmms in enumerate(models):
        for b, row in enumerate(rows.tolist()):
            hmm, step = hmms[data.actions[data.trial[row]]], int(data.step[row])
            state = int(unobserved_forward(hmm, step + 1)[step].argmax())
            prior = torch.distributions.MultivariateNormal(
                torch.tensor(hmm.emission_means[state, agent], dtype=torch.float32),
                torch.tensor(hmm.emission_covariances[state, agent, agent], dtype=torch.float32),
            )
            posterior = torch.distributions.MultivariateNormal(mean[m, b], torch.diag(torch.exp(2 * log_std[m, b])))
            expected = torch.distributions.kl_divergence(posterior, prior)
            torch.testing.assert_close(ours[m, b], expected, atol=1e-4, rtol=1e-4)


def test_beta_weighs_the_first_epochs_standard_normal_prior() -> None:
    data = made_windows()
    spread = {}
    for beta in (0.0, 100.0):
        # One epoch of many small batches: no EM takes place within it.
        vae = train_human_stage(data, replace(options(beta, epochs=1), batch_size=2), silent)[0].vae
        mean, std = vae.encode(np.concatenate([data.human, data.partner]))
        spread[beta] = float(np.sqrt((mean**2).mean()))
        if beta:
            np.testing.assert_allclose(std, 1.0, atol=0.15)
        else:
            assert np.median(std) < 0.5  # nothing holds the posterior wide
    assert spread[100.0] < 0.2 and spread[0.0] > 0.5


def test_each_human_is_pulled_to_the_own_block_of_the_hmm(monkeypatch: pytest.MonkeyPatch) -> None:
    data = made_windows()
    hmm = hmm_at(1.0, -1.0, 0.1)
    monkeypatch.setattr(human_stage, "fit_hmms", lambda *_: dict.fromkeys(TWO, hmm))
    vae = train_human_stage(data, options(100.0, epochs=40), silent)[0].vae
    for windows, place in ((data.human, 1.0), (data.partner, -1.0)):
        mean, std = vae.encode(windows)
        np.testing.assert_allclose(mean.mean(0), place, atol=0.2)
        np.testing.assert_allclose(np.median(std), np.sqrt(0.1), atol=0.1)


def trained_robots(hmms: Sequence[HMM], data: Windows, variants: Sequence[str], beta: float, epochs: int) -> list[Any]:
    rng = np.random.default_rng(2)
    vaes = [random_vae(rng, data.human.shape[1], latent=D) for _ in hmms]
    humans = [HumanModel(vae, dict.fromkeys(TWO, hmm), vae) for vae, hmm in zip(vaes, hmms, strict=True)]
    return train_robot_stage(data, humans, variants, options(beta, epochs), silent)


def test_the_robot_is_pulled_to_the_partners_block_as_beta_says() -> None:
    data = made_windows()
    hmm = hmm_at(1.0, -1.0, 0.1)
    (held,) = trained_robots([hmm], data, ("v1", "v3.1"), 100.0, epochs=40)
    (free,) = trained_robots([hmm], data, ("v1",), 0.0, epochs=40)
    for variant in ("v1", "v3.1"):
        mean, std = held[variant].encode(data.partner)
        np.testing.assert_allclose(mean.mean(0), -1.0, atol=0.2)
        assert mean.std(0).max() < 0.2
        np.testing.assert_allclose(np.median(std), np.sqrt(0.1), atol=0.1)
    mean, std = free["v1"].encode(data.partner)
    assert mean.std(0).min() > 0.5 and np.median(std) < 0.5 * np.sqrt(0.1)


# sampling


def test_decoders_are_trained_on_samples_and_not_on_their_centre_alone() -> None:
    """Wide samples that say nothing of the partner: a decoder that saw them answers with the mean everywhere."""
    rng = np.random.default_rng(3)
    made = made_windows()
    data = Windows(np.zeros_like(made.human), made.partner, made.trial, made.step, made.actions)
    vae = random_vae(rng, data.human.shape[1], latent=D)
    at = vae.encode(data.human[:1])[0][0]

    def hmm(cross: float, robot: float) -> HMM:
        covariance = np.block([[np.eye(D), cross * np.eye(D)], [cross * np.eye(D), robot * np.eye(D)]])
        base = hmm_at(0.0, 0.0, 1.0)
        means = np.tile(np.concatenate([at, np.zeros(D)]), (N_STATES, 1))
        return HMM(base.initial_probs, base.transition_matrix, means, np.tile(covariance, (N_STATES, 1, 1)))

    # v2 spreads the human's posterior by the gain, v3 samples the conditional distribution.
    humans = {"v2.1": HumanModel(vae, dict.fromkeys(TWO, hmm(10.0, 101.0)), vae)}
    humans["v3.1"] = HumanModel(vae, dict.fromkeys(TWO, hmm(0.0, 100.0)), vae)
    robots = train_robot_stage(data, list(humans.values()), ("v1", *humans), options(5e-3, epochs=60), silent)
    for (variant, human), robot in zip(humans.items(), robots, strict=True):
        centre, factor = conditional_factors(human, data, training_run.VARIANTS[variant])
        samples = centre + (factor @ rng.normal(size=(len(centre), D, 1)))[..., 0]
        assert np.abs(samples - centre).std() > 3.0
        variance = ((data.partner - data.partner.mean(0)) ** 2).mean()
        errors = {name: ((robot[name].decode(samples) - data.partner) ** 2).mean() for name in ("v1", variant)}
        assert errors[variant] < 1.5 * variance and errors["v1"] > 3 * variance, (variant, errors, variance)


# choices


def test_v1_does_not_decide_which_seed_is_kept() -> None:
    errors = [{"v1": 0.9, "v2.1": 0.05, "v3.1": 0.04}, {"v1": 0.1, "v2.1": 0.06, "v3.1": 0.05}]
    errors.append({"v1": 0.5, "v2.1": 0.02, "v3.1": 0.06})
    assert choose_seed(errors) == 2  # means of v2.1 and v3.1: .045, .055, .04
    assert choose_seed([{"v1": error["v1"]} for error in errors]) == 1  # with v1 alone, it is all there is
    assert choose_seed([]) == choose_seed([{}, {}]) == 0  # nothing was held out


def pairs_of(human: np.ndarray, partner: np.ndarray, n_trials: int) -> Examples:
    n = len(human) // n_trials
    return Examples(human, partner, np.tile(np.arange(n), n_trials), np.repeat(np.arange(n_trials), n))


def unrelated() -> Examples:
    """Partners that the human says nothing of. Every row is there twice: only leaving a whole trial out shows it."""
    rng = np.random.default_rng(4)
    return pairs_of(
        np.repeat(rng.normal(size=(120, 8)), 2, axis=0), np.repeat(rng.normal(size=(120, 2)), 2, axis=0), n_trials=4
    )


def test_the_number_of_neighbours_is_chosen_by_leaving_trials_out() -> None:
    places = np.tile(np.arange(60.0), 4)[:, None]  # every trial visits the same places; neighbours disagree
    exact = pairs_of(places, (-1.0) ** places, n_trials=4)
    np.testing.assert_allclose(BASELINES["knn"](exact)(exact), exact.partner)
    train = unrelated()
    best = fit_nearest(train, NEIGHBOURS[-1])(train)
    np.testing.assert_allclose(BASELINES["knn"](train)(train), best)
    assert np.abs(best - fit_nearest(train, NEIGHBOURS[len(NEIGHBOURS) // 2])(train)).max() > 0.1


def test_the_strength_of_the_ridge_is_chosen_by_leaving_trials_out() -> None:
    rng = np.random.default_rng(5)
    x = rng.normal(size=(240, 8))
    for train, strength in (
        (pairs_of(x, x @ rng.normal(size=(8, 2)), 4), RIDGE_STRENGTHS[0]),
        (unrelated(), RIDGE_STRENGTHS[-1]),
    ):
        expected = fit_ridge(train, strength)(train)
        np.testing.assert_allclose(BASELINES["ridge"](train)(train), expected)
        middle = fit_ridge(train, RIDGE_STRENGTHS[len(RIDGE_STRENGTHS) // 2])(train)
        assert np.abs(expected - middle).max() > 1e-3
