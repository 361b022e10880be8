"""Health warnings: each is given where it is due, with the figure, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mild_viz.evaluation import health
from mild_viz.evaluation.calibration import Calibration
from mild_viz.evaluation.segmentation import Segmentation, segmentation
from mild_viz.latent.hmm import HMM
from tests.models import random_hmm
from tests.passes import make_pass

HEALTHY = segmentation([make_pass([0, 1, 2, 3] * 5)])


def hmm_with(covariance: np.ndarray) -> HMM:
    """Four states, the third with this covariance."""
    hmm = random_hmm(np.random.default_rng(0), 4, 4)
    covariances = np.tile(np.eye(4), (4, 1, 1))
    covariances[2] = covariance
    return replace(hmm, emission_covariances=covariances)


def details(warnings: list[health.Warning]) -> list[tuple[str, str]]:
    return [(one.kind, one.detail) for one in warnings]


def test_states_that_are_never_active_are_dead() -> None:
    assert health.dead_states("v1", HEALTHY) == []
    used = segmentation([make_pass([0] * 600 + [1] * 600 + [3])])
    assert details(health.dead_states("v1", used)) == [("dead state", "states 2, 3")]
    rare = segmentation([make_pass([0] * 400 + [1] * 400 + [2] * 5 + [3] * 5)])
    assert health.dead_states("v1", rare) == []


def test_covariances_at_the_floor_or_ill_conditioned_have_collapsed() -> None:
    assert health.collapsed_covariances("v1", "wave", hmm_with(np.eye(4)), 1e-3) == []
    at_floor = hmm_with(np.diag([1.0, 1.0, 1.0, 1.05e-3]))
    assert [one.detail.split(":")[0] for one in health.collapsed_covariances("v1", "wave", at_floor, 1e-3)] == [
        "state 2"
    ]
    assert health.collapsed_covariances("v1", "wave", at_floor, None) == []  # unknown floor
    thin = hmm_with(np.diag([100.0, 1.0, 1.0, 5e-3]))
    (warning,) = health.collapsed_covariances("v1", "wave", thin, 1e-3)
    assert warning.detail == "state 2: eigenvalues differ by a factor of 2e+04"


@pytest.mark.parametrize(
    ("used", "detail"),
    [
        (replace(HEALTHY, entropy=0.9), "its mean entropy is 90% of the largest"),
        (segmentation([make_pass([1] * 30)]), "the active state never changes"),
        (segmentation([make_pass([0] * 98 + [1] * 2)]), "state 0 is active in 98% of the windows"),
    ],
)
def test_an_idle_forward_variable_is_named(used: Segmentation, detail: str) -> None:
    assert details(health.idle_alpha("v1", used)) == [("idle forward variable", detail)]
    assert health.idle_alpha("v1", HEALTHY) == []


def test_disagreement_overconfidence_contact_and_error() -> None:
    assert health.misaligned("v1", HEALTHY) == []
    apart = segmentation([make_pass([0, 1, 2, 3], [3, 3, 3, 3])])
    assert details(health.misaligned("v1", apart)) == [("misaligned encoder", "25%")]
    good = Calibration(10, (0.5, 0.9), 1.0, 1.0, (0.5, 0.9), 1.0, 1.0)
    assert health.overconfident("v1", "wave", good) == []
    assert details(health.overconfident("v1", "wave", replace(good, coverage=(0.1, 0.3)))) == [("overconfident", "30%")]
    assert health.without_contact_state("v1", "wave", frozenset()) == []
    assert health.without_contact_state("v1", "rocket", {2}) == []
    assert len(health.without_contact_state("v1", "rocket", frozenset())) == 1
    assert health.worse_than_constant("v1", "wave", 0.1, 0.2) == []
    assert details(health.worse_than_constant("v1", "wave", 0.3, 0.2)) == [("worse than a constant", "1.5")]


def test_a_warning_reads_as_a_sentence() -> None:
    (warning,) = health.without_contact_state("v3.1", "rocket", frozenset())
    assert str(warning).startswith("v3.1, rocket: no contact state. No contact state is set for an interaction")
