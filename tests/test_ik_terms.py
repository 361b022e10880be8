"""Optional terms of inverse kinematics: derivatives, optima, the border of reach, velocity boxes, limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from mild_viz.errors import UserError
from mild_viz.robot.chain import ArmChain
from mild_viz.robot.ik import forward, solve_ik, unreachable
from mild_viz.robot.kernels import ik_scratch
from mild_viz.robot.kinematics.kernels import arm_forward
from mild_viz.robot.model import load_robot
from mild_viz.robot.objective.kernels import derivatives
from mild_viz.robot.objective.terms import IKTerms, upper_arm

PEPPER, PANDA, YUMI = (load_robot(name).chain for name in ("pepper", "panda", "yumi"))
ELBOWS = {PEPPER.joint_names: "RElbowYaw", PANDA.joint_names: "panda_joint4", YUMI.joint_names: "yumi_joint_3_r"}
FORWARD, DOWN = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
Z = np.array([0.0, 0.0, 1.0])


def some_terms(chain: ArmChain, kind: str) -> IKTerms:
    elbow = ELBOWS[chain.joint_names]
    weights = np.linspace(0.5, 2.0, chain.n_joints)
    level = {"orientation_weight": 0.05, "tool_axis": Z, "tool_direction": np.array([0.8, -0.6, 0.0])}
    turned = Rotation.from_euler("xyz", [0.3, 1.2, -0.4]).as_matrix()
    return {
        "plain": IKTerms(),
        "axis": IKTerms(**level),
        "rotation": IKTerms(orientation_weight=0.05, orientation=turned),
        "elbow": IKTerms(elbow_weight=0.1, elbow_joint=elbow, elbow_direction=np.array([0.3, -0.6, -0.9])),
        "weights": IKTerms(joint_weights=weights),
        "all": IKTerms(**level, elbow_weight=0.1, elbow_joint=elbow, elbow_direction=DOWN, joint_weights=weights),
    }[kind]


KINDS = ("plain", "axis", "rotation", "elbow", "weights", "all")


def pose(chain: ArmChain, q: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Origins of the joints and the end's pose, from the chain's matrices: not by the kernels."""
    T, origins = np.eye(4), []
    for offset, axis, angle in zip(chain.offsets[:-1], chain.axes, q, strict=True):
        T = T @ offset
        origins.append(T[:3, 3])
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
        T = T @ turn
    return origins, T @ chain.offsets[-1]


def value(chain, q, target, prior, lambda_x, lambda_q, terms: IKTerms) -> float:
    """The objective as the docstring of `IKTerms` writes it."""
    origins, T = pose(chain, q)
    weights = np.ones(chain.n_joints) if terms.joint_weights is None else terms.joint_weights
    total = lambda_x * np.sum((target - T[:3, 3]) ** 2) + lambda_q * np.sum(weights * (prior - q) ** 2)
    if terms.orientation is not None:
        total += terms.orientation_weight / 2.0 * np.sum((T[:3, :3] - terms.orientation) ** 2)
    elif terms.tool_axis is not None and terms.tool_direction is not None:
        total += terms.orientation_weight * np.sum((T[:3, :3] @ terms.tool_axis - terms.tool_direction) ** 2)
    if terms.elbow_joint is not None and terms.elbow_direction is not None:
        number, length = upper_arm(chain, terms.elbow_joint)
        u = terms.elbow_direction / np.linalg.norm(terms.elbow_direction)
        total += terms.elbow_weight * np.sum(((origins[number] - chain.shoulder) / length - u) ** 2)
    return float(total)


def halves(chain, q, target, prior, lambda_x, lambda_q, terms: IKTerms) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and Hessian by the kernel."""
    vectors, points, frames, squares, _ = ik_scratch(chain.n_joints)
    row = terms.packed(chain, 1)[0]
    rotation = arm_forward(chain.arm, q, frames[0], frames[1], points[0])
    derivatives(frames, points[0], rotation, target, q, prior, lambda_x, lambda_q, row, vectors[0], squares[0])
    return 2.0 * vectors[0], 2.0 * squares[0]


def problems(chain: ArmChain, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    priors = rng.uniform(chain.lower, chain.upper, (count, chain.n_joints))
    return forward(chain, priors) + rng.normal(scale=0.1, size=(count, 3)), priors


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("chain", [PEPPER, PANDA, YUMI], ids=["pepper", "panda", "yumi"])
def test_derivatives_equal_finite_differences(chain: ArmChain, kind: str) -> None:
    terms = some_terms(chain, kind)
    for target, prior in zip(*problems(chain, 4), strict=True):
        q = np.clip(prior + 0.3, chain.lower, chain.upper)
        given_ = (target, prior, 1.3, 0.02, terms)
        gradient, hessian = halves(chain, q, *given_)
        steps = 1e-5 * np.eye(chain.n_joints)
        slope = [(value(chain, q + s, *given_) - value(chain, q - s, *given_)) / 2e-5 for s in steps]
        np.testing.assert_allclose(gradient, slope, atol=1e-8)
        bend = [(halves(chain, q + s, *given_)[0] - halves(chain, q - s, *given_)[0]) / 2e-5 for s in steps]
        np.testing.assert_allclose(hessian, bend, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("chain", [PEPPER, PANDA, YUMI], ids=["pepper", "panda", "yumi"])
def test_as_good_as_scipy_from_the_same_start_and_never_worse_than_it(chain: ArmChain, kind: str) -> None:
    terms, count = some_terms(chain, kind), 12
    targets, priors = problems(chain, count, 1)
    solutions = solve_ik(chain, targets, priors, 1.0, 0.01, terms=terms)
    assert (solutions >= chain.lower).all() and (solutions <= chain.upper).all()
    no_worse = 0
    for target, prior, q in zip(targets, priors, solutions, strict=True):
        ours = value(chain, q, target, prior, 1.0, 0.01, terms)
        assert ours <= value(chain, prior, target, prior, 1.0, 0.01, terms) + 1e-15
        gradient, _ = halves(chain, q, target, prior, 1.0, 0.01, terms)
        held = ((q <= chain.lower) & (gradient > 0.0)) | ((q >= chain.upper) & (gradient < 0.0))
        assert np.abs(np.where(held, 0.0, gradient)).max() < 1e-8
        found = minimize(
            lambda x: value(chain, x, target, prior, 1.0, 0.01, terms),  # noqa: B023
            prior,
            jac=lambda x: halves(chain, x, target, prior, 1.0, 0.01, terms)[0],  # noqa: B023
            method="L-BFGS-B",
            bounds=list(zip(chain.lower, chain.upper, strict=True)),
            options={"ftol": 0.0, "gtol": 1e-9},
        )
        no_worse += ours <= found.fun + 1e-8
    assert no_worse >= count - 2  # another start of the same descent may end in another optimum


def test_the_hand_is_held_level_at_little_cost_of_its_place() -> None:
    targets = np.array([[0.5, 0.0, 0.5], [0.6, -0.2, 0.4], [0.4, 0.3, 0.7]])
    priors = np.tile(PANDA.rest, (3, 1))
    level = IKTerms(orientation_weight=0.05, tool_axis=Z, tool_direction=FORWARD)
    for terms, least, most in ((None, 0.3, 2.0), (level, 0.0, 0.05)):
        joints = solve_ik(PANDA, targets, priors, 1.0, 1e-4, terms=terms)
        tilt = [np.arccos(np.clip(pose(PANDA, q)[1][0, 2], -1.0, 1.0)) for q in joints]
        assert least < np.median(tilt) < most
        assert np.linalg.norm(forward(PANDA, joints) - targets, axis=1).max() < 2e-3


def test_the_elbow_swivels_to_the_wanted_side_while_the_hand_stays() -> None:
    target = np.array([[0.5, 0.0, 0.5]])
    elbows = []
    for side in (-1.0, 1.0):
        terms = IKTerms(elbow_weight=0.05, elbow_joint="panda_joint4", elbow_direction=np.array([0.0, side, 0.5]))
        joints = solve_ik(PANDA, target, PANDA.rest[None], 1.0, 1e-4, terms=terms)
        assert np.linalg.norm(forward(PANDA, joints) - target) < 5e-3
        elbows.append(pose(PANDA, joints[0])[0][3][1])
    assert elbows[0] < -0.15 and elbows[1] > 0.15


def test_a_joint_that_costs_more_moves_less() -> None:
    target, weights = np.array([[0.5, -0.3, 0.5]]), np.ones(7)
    moved = []
    for weights[0] in (0.1, 1.0, 100.0):
        terms = IKTerms(joint_weights=weights.copy())
        moved.append(abs(solve_ik(PANDA, target, PANDA.rest[None], 1.0, 1e-2, terms=terms)[0, 0] - PANDA.rest[0]))
    assert moved[0] > moved[1] > 10.0 * moved[2]


def test_terms_that_say_nothing_leave_the_same_bits() -> None:
    targets, priors = problems(PANDA, 50)
    plain = solve_ik(PANDA, targets, priors)
    nothing = IKTerms(
        orientation_weight=0.3, tool_axis=Z, tool_direction=np.full((50, 3), np.nan), elbow_weight=0.3,
        elbow_joint="panda_joint4", elbow_direction=np.full((50, 3), np.nan), joint_weights=np.ones(7), max_step=np.inf,
    )  # fmt: skip
    np.testing.assert_array_equal(solve_ik(PANDA, targets, priors, terms=nothing), plain)


def test_a_direction_of_each_row_counts_in_that_row() -> None:
    targets, priors = problems(PANDA, 6)
    towards = np.random.default_rng(1).normal(size=(6, 3))
    joints = solve_ik(
        PANDA, targets, priors, terms=IKTerms(orientation_weight=0.1, tool_axis=Z, tool_direction=towards)
    )
    for n in range(6):
        alone = IKTerms(orientation_weight=0.1, tool_axis=Z, tool_direction=towards[n])
        np.testing.assert_array_equal(solve_ik(PANDA, targets[n : n + 1], priors[n : n + 1], terms=alone)[0], joints[n])


def out_and_back(chain: ArmChain, along: tuple[float, float, float]) -> np.ndarray:
    """Targets from the resting hand to 1.3 times the reach and back, 2 mm a frame."""
    hand = forward(chain, chain.rest[None])[0]
    far = chain.shoulder + 1.3 * chain.reach * np.array(along) / np.linalg.norm(along)
    out = hand + np.linspace(0.0, 1.0, int(np.linalg.norm(far - hand) / 0.002))[:, None] * (far - hand)
    return np.concatenate([out, out[::-1]])


@pytest.mark.parametrize("along", [(1.0, 0.0, 0.0), (1.0, -0.4, 0.3), (0.7, -0.7, -0.3)])
@pytest.mark.parametrize("chain", [PEPPER, PANDA, YUMI], ids=["pepper", "panda", "yumi"])
def test_through_the_border_of_reach_and_back_without_oscillation(chain: ArmChain, along) -> None:
    targets = out_and_back(chain, along)
    joints = solve_ik(chain, targets, np.tile(chain.rest, (len(targets), 1)), 1.0, 1e-3)
    steps = np.diff(joints, axis=0)
    assert np.abs(steps).max() < 0.04  # rad, for 2 mm of the target
    np.testing.assert_allclose(joints, joints[::-1], atol=1e-6)  # the way back is the way out
    flags, half = unreachable(chain, targets, joints), len(targets) // 2
    assert not flags[0] and flags[half] and np.abs(np.diff(flags.astype(int))).sum() == 2  # one border, met twice
    distance = np.linalg.norm(forward(chain, joints) - targets, axis=1)
    assert (np.diff(distance[:half])[flags[: half - 1]] > 0.0).all()  # it stays at the border, as near as can be
    assert np.linalg.norm(targets[~flags] - chain.shoulder, axis=1).max() <= chain.reach + 1e-3
    back = (steps[1:] * steps[:-1] < 0.0) & (np.abs(steps[1:]) > 1e-4) & (np.abs(steps[:-1]) > 1e-4)
    assert back.sum(0).max() <= 4  # each joint turns round where its path does, not from frame to frame


@pytest.mark.parametrize("chain", [PEPPER, PANDA, YUMI], ids=["pepper", "panda", "yumi"])
def test_following_from_the_last_solution_does_not_jump_either(chain: ArmChain) -> None:
    """Where the prior is the last solution, a small lambda_q is what holds the arm still at the border."""
    step, last, turns = 0.07, np.array(chain.rest), np.zeros(chain.n_joints)
    before = np.zeros(chain.n_joints)
    for target in out_and_back(chain, (1.0, -0.4, 0.3)):
        terms = IKTerms(max_step=step, previous=last)
        now = solve_ik(chain, target[None], last[None], 1.0, 1e-3, terms=terms)[0]
        assert np.abs(now - last).max() <= step + 1e-12
        turns += ((now - last) * before < 0.0) & (np.abs(now - last) > 1e-3) & (np.abs(before) > 1e-3)
        before, last = now - last, now
    assert turns.max() <= 3


def test_the_flag_tells_reach_from_prior() -> None:
    rng = np.random.default_rng(3)
    truth = rng.uniform(PANDA.lower, PANDA.upper, (300, 7))
    near = solve_ik(PANDA, forward(PANDA, truth), truth + 0.1 * rng.normal(size=truth.shape), 1.0, 1.0)
    assert np.linalg.norm(forward(PANDA, near) - forward(PANDA, truth), axis=1).max() > 0.01  # held back by the prior
    assert unreachable(PANDA, forward(PANDA, truth), near).mean() < 0.01
    away = rng.normal(size=(300, 3))
    away *= (PANDA.reach + 0.002) / np.linalg.norm(away, axis=1, keepdims=True)
    assert unreachable(PANDA, PANDA.shoulder + away, near).all()
    assert unreachable(PANDA, PANDA.shoulder + away, near, tolerance=10.0).sum() == 0
    assert not unreachable(PANDA, np.full((300, 3), np.nan), near).any()


def test_velocity_boxes_hold_in_a_sequence_and_give_way_to_limits() -> None:
    targets, priors = problems(PANDA, 200, 5)
    step = np.linspace(0.01, 0.2, 7)
    outside = PANDA.upper + 1.0
    joints = solve_ik(PANDA, targets, priors, terms=IKTerms(max_step=step, previous=outside))
    np.testing.assert_array_equal(joints[0], PANDA.upper)  # limits first: it comes back inside at once
    assert (np.abs(np.diff(joints, axis=0)) <= step + 1e-12).all()
    assert (joints >= PANDA.lower).all() and (joints <= PANDA.upper).all()
    priors[50] = np.nan
    gap = solve_ik(PANDA, targets, priors, terms=IKTerms(max_step=step))
    np.testing.assert_array_equal(gap[51], solve_ik(PANDA, targets[51:52], priors[51:52])[0])  # it begins anew


number = st.floats(-10.0, 10.0)
vector = st.tuples(number, number, number)
weight = st.floats(0.0, 1e3)


@settings(max_examples=200, deadline=None)
@given(vector, st.lists(number, min_size=7, max_size=7), st.lists(number, min_size=7, max_size=7), weight, weight,
       weight, weight, vector, vector, st.floats(0.0, 1.0))  # fmt: skip
def test_whatever_the_terms_limits_and_boxes_hold_and_the_objective_does_not_grow(
    target, prior, previous, lambda_x, lambda_q, lambda_r, lambda_e, tool, elbow, step
) -> None:
    tool, elbow = (np.array(v) / np.linalg.norm(v) if np.linalg.norm(v) > 1e-3 else DOWN for v in (tool, elbow))
    terms = IKTerms(
        orientation_weight=lambda_r, tool_axis=Z, tool_direction=tool, elbow_weight=lambda_e,
        elbow_joint="yumi_joint_3_r", elbow_direction=elbow, max_step=step, previous=np.array(previous),
    )  # fmt: skip
    low = np.clip(np.array(previous) - step, YUMI.lower, YUMI.upper)
    high = np.clip(np.array(previous) + step, YUMI.lower, YUMI.upper)
    target, prior = np.array(target), np.array(prior)
    q = solve_ik(YUMI, target[None], prior[None], lambda_x, lambda_q, terms=terms)[0]
    assert (q >= low).all() and (q <= high).all()
    begin = value(YUMI, np.clip(prior, low, high), target, prior, lambda_x, lambda_q, terms)
    assert value(YUMI, q, target, prior, lambda_x, lambda_q, terms) <= begin * (1.0 + 1e-9) + 1e-12


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"orientation_weight": -1.0}, "orientation_weight is -1.0; expected a finite number"),
        ({"orientation_weight": 1.0}, "expected either orientation, or tool_axis and tool_direction"),
        ({"elbow_weight": 1.0}, "expected elbow_joint and elbow_direction"),
        ({"joint_weights": -np.ones(7)}, "joint_weights is .*; expected numbers of at least 0"),
        ({"previous": np.zeros(7)}, "previous is set without max_step"),
        ({"joint_weights": np.ones(4)}, "joint_weights has the shape"),
        ({"max_step": np.ones(4)}, "max_step has the shape"),
        ({"elbow_weight": 1.0, "elbow_joint": "knee", "elbow_direction": DOWN}, "elbow_joint 'knee' is unknown; valid"),
        ({"elbow_weight": 1.0, "elbow_joint": "panda_joint2", "elbow_direction": DOWN}, "lies in the shoulder"),
        (
            {"orientation_weight": 1.0, "tool_axis": Z, "tool_direction": np.ones((3, 3))},
            "3 rows; expected one for all",
        ),
        ({"orientation_weight": 1.0, "tool_axis": Z, "tool_direction": np.zeros(3)}, "a vector of length 0"),
    ],
)
def test_terms_that_do_not_fit_are_refused(fields: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        solve_ik(PANDA, np.zeros((2, 3)), np.tile(PANDA.rest, (2, 1)), terms=IKTerms(**fields))
