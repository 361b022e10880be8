"""Inverse kinematics with a joint prior, against scipy's bounded least squares and by its properties."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mild_viz.robot.ik import forward, solve_ik
from mild_viz.robot.model import load_robot

CHAIN = load_robot("pepper").chain
STARTS = 20
"""Of scipy; benchmarks/ik.py does the same with 1,000 problems of each kind."""


def load_benchmark():
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "ik.py"
    spec = importlib.util.spec_from_file_location("benchmark_ik", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


benchmark = load_benchmark()


def solved(kind: str, count: int):
    random = np.random.default_rng(7)
    targets, priors = benchmark.random_problems(CHAIN, kind, count, random)
    return targets, priors, solve_ik(CHAIN, targets, priors), random


@pytest.mark.parametrize(("kind", "count", "least"), [("near", 100, 0.99), ("far", 20, 0.7), ("unreachable", 10, 0.5)])
def test_against_scipy_from_many_starts(kind, count, least):
    targets, priors, solutions, random = solved(kind, count)
    best = np.array([benchmark.best_of_scipy(CHAIN, targets[n], priors[n], STARTS, random) for n in range(count)])
    reached = benchmark.objective(CHAIN, solutions, targets, priors)
    assert np.all(reached >= best - 1e-8), "scipy's best of 20 cannot be worse by more than its own tolerance"
    assert np.mean(reached <= best + 1e-8) >= least


@pytest.mark.parametrize("kind", benchmark.KINDS)
def test_stationary_within_limits_and_no_worse_than_the_prior(kind):
    targets, priors, solutions, _ = solved(kind, 5000)
    assert np.all((solutions >= CHAIN.lower) & (solutions <= CHAIN.upper))
    assert benchmark.projected_gradient(CHAIN, solutions, targets, priors).max() < 1e-6
    before = benchmark.objective(CHAIN, priors, targets, priors)
    assert np.all(benchmark.objective(CHAIN, solutions, targets, priors) <= before)


def test_weights_trade_reach_against_the_prior():
    targets, priors, _, _ = solved("near", 200)
    distances, strays = [], []
    for lambda_q in (1e-4, 1e-2, 1.0, 100.0):
        solutions = solve_ik(CHAIN, targets, priors, 1.0, lambda_q)
        distances.append(np.linalg.norm(forward(CHAIN, solutions) - targets, axis=1).mean())
        strays.append(np.linalg.norm(solutions - priors, axis=1).mean())
    assert distances == sorted(distances) and strays == sorted(strays, reverse=True)
    assert distances[0] < 0.03 and strays[-1] < 1e-3
    np.testing.assert_array_equal(solve_ik(CHAIN, targets, priors, 0.0, 0.01), priors)
    np.testing.assert_array_equal(solve_ik(CHAIN, targets, priors, 0.0, 0.0), priors)


def test_reachable_target_at_the_prior_stays():
    priors = np.random.default_rng(3).uniform(CHAIN.lower, CHAIN.upper, (100, 4))
    np.testing.assert_allclose(solve_ik(CHAIN, forward(CHAIN, priors), priors), priors, atol=1e-9)


def test_rows_are_independent_of_each_other():
    targets, priors, solutions, _ = solved("far", 50)
    rows = [solve_ik(CHAIN, targets[n : n + 1], priors[n : n + 1])[0] for n in range(50)]
    np.testing.assert_array_equal(solutions, rows)


def test_missing_target_gives_the_prior_within_limits():
    priors = np.array([[0.5, -0.5, 0.5, 0.5], [9.0, 9.0, -9.0, -9.0]])
    targets = np.array([[np.nan, 0.0, 0.0], [0.0, np.nan, np.nan]])
    np.testing.assert_array_equal(solve_ik(CHAIN, targets, priors), np.clip(priors, CHAIN.lower, CHAIN.upper))


def test_inputs_are_not_changed_and_may_be_read_only():
    targets, priors, solutions, _ = solved("near", 10)
    for array in (targets, priors):
        array.flags.writeable = False
    np.testing.assert_array_equal(solve_ik(CHAIN, targets, priors), solutions)
    np.testing.assert_array_equal(solve_ik(CHAIN, np.asfortranarray(targets), priors[:, ::-1][:, ::-1]), solutions)


coordinate = st.floats(-3.0, 3.0)
angle = st.floats(-10.0, 10.0)
weight = st.floats(0.0, 1e3)


@settings(max_examples=300, deadline=None)
@given(
    st.tuples(coordinate, coordinate, coordinate), st.tuples(angle, angle, angle, angle), weight, weight
)  # fmt: skip
def test_whatever_the_input_limits_hold_and_the_objective_does_not_grow(target, prior, lambda_x, lambda_q):
    targets, priors = np.array([target]), np.array([prior])
    solution = solve_ik(CHAIN, targets, priors, lambda_x, lambda_q)
    assert np.all((solution >= CHAIN.lower) & (solution <= CHAIN.upper))

    def objective(q: np.ndarray) -> float:
        reach = np.sum((forward(CHAIN, q) - targets) ** 2)
        return float(lambda_x * reach + lambda_q * np.sum((q - priors) ** 2))

    begin = objective(np.clip(priors, CHAIN.lower, CHAIN.upper))
    assert objective(solution) <= begin * (1.0 + 1e-12) + 1e-15
