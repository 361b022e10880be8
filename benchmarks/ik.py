"""How good and how fast the inverse kinematics is, against scipy's bounded least squares from 20 starts.

    python benchmarks/ik.py [--problems 1000] [--starts 20] [--robot pepper]

Three kinds of random problems, each with a random prior inside the limits: `near` (the target is within 15 cm
of the prior's hand), `far` (anywhere in reach), `unreachable` (beyond reach). For each it prints the share of
problems in which the objective is within 1e-8 of the best that scipy found, the share with a better optimum
elsewhere, the largest projected gradient, and whether any solution is worse than its prior or leaves the limits.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from jaxtyping import Float

from mild_viz.robot.chain import ArmChain
from mild_viz.robot.ik import forward, jacobian, solve_ik
from mild_viz.robot.kinematics.kernels import kinematics_batch
from mild_viz.robot.model import load_robot

KINDS = ("near", "far", "unreachable")
LAMBDA_X, LAMBDA_Q = 1.0, 0.01


def random_problems(
    chain: ArmChain, kind: str, count: int, random: np.random.Generator
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N J"]]:
    """Targets [m] and priors [rad] of random problems of one kind."""
    priors = random.uniform(chain.lower, chain.upper, (count, chain.n_joints))
    direction = random.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    if kind == "near":
        return forward(chain, priors) + direction * random.uniform(0.0, 0.15, (count, 1)), priors
    if kind == "far":
        return forward(chain, random.uniform(chain.lower, chain.upper, priors.shape)), priors
    return chain.shoulder + direction * chain.reach * random.uniform(1.05, 2.0, (count, 1)), priors


def objective(
    chain: ArmChain,
    joints: Float[np.ndarray, "N J"],
    targets: Float[np.ndarray, "N 3"],
    priors: Float[np.ndarray, "N J"],
) -> Float[np.ndarray, " N"]:
    """Eq. ik-prior-simplified."""
    reach = np.sum((forward(chain, joints) - targets) ** 2, axis=1)
    return LAMBDA_X * reach + LAMBDA_Q * np.sum((joints - priors) ** 2, axis=1)


def projected_gradient(
    chain: ArmChain,
    joints: Float[np.ndarray, "N J"],
    targets: Float[np.ndarray, "N 3"],
    priors: Float[np.ndarray, "N J"],
) -> Float[np.ndarray, " N"]:
    """Largest component of the objective's gradient that does not push against a limit."""
    error = forward(chain, joints) - targets
    gradient = 2.0 * LAMBDA_X * np.einsum("njx,nx->nj", jacobian(chain, joints), error)
    gradient += 2.0 * LAMBDA_Q * (joints - priors)
    held = ((joints <= chain.lower) & (gradient > 0.0)) | ((joints >= chain.upper) & (gradient < 0.0))
    return np.abs(np.where(held, 0.0, gradient)).max(axis=1)


def best_of_scipy(
    chain: ArmChain, target: Float[np.ndarray, "3"], prior: Float[np.ndarray, " J"], starts: int,
    random: np.random.Generator,
) -> float:  # fmt: skip
    """The smallest objective that scipy's bounded trust region finds from the prior and from random starts."""
    from scipy.optimize import least_squares

    def residuals(q: np.ndarray) -> np.ndarray:
        error = kinematics_batch(chain.arm, q[None])[0][0] - target
        return np.concatenate([np.sqrt(LAMBDA_X) * error, np.sqrt(LAMBDA_Q) * (q - prior)])

    def derivative(q: np.ndarray) -> np.ndarray:
        rows = kinematics_batch(chain.arm, q[None])[1][0].T
        return np.concatenate([np.sqrt(LAMBDA_X) * rows, np.sqrt(LAMBDA_Q) * np.eye(chain.n_joints)])

    best = np.inf
    inside = (chain.upper - chain.lower) * 1e-6  # scipy wants a start strictly inside
    for start in [prior, *random.uniform(chain.lower, chain.upper, (starts - 1, chain.n_joints))]:
        begin = np.clip(start, chain.lower + inside, chain.upper - inside)
        found = least_squares(
            residuals,
            begin,
            jac=derivative,  # pyright: ignore[reportArgumentType]  (its stub admits only names)
            bounds=(chain.lower, chain.upper),
            xtol=1e-10,
            ftol=1e-10,
            gtol=1e-9,
        )
        best = min(best, 2.0 * found.cost)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=1000, help="random problems of each kind")
    parser.add_argument("--starts", type=int, default=20, help="starts of scipy per problem")
    parser.add_argument("--robot", default="pepper", help="name or path of the robot's description")
    options = parser.parse_args()
    chain = load_robot(options.robot).chain
    random = np.random.default_rng(0)
    print(f"{'kind':12} {'within 1e-8':>11} {'better elsewhere':>17} {'projected gradient':>19} "
          f"{'worse than prior':>17} {'us/problem':>11} {'scipy us/start':>15} {'ratio':>6}")  # fmt: skip
    for kind in KINDS:
        targets, priors = random_problems(chain, kind, options.problems, random)
        solutions = solve_ik(chain, targets, priors, LAMBDA_X, LAMBDA_Q)
        assert np.all((solutions >= chain.lower) & (solutions <= chain.upper)), "a limit is exceeded"
        reached = objective(chain, solutions, targets, priors)
        best, ours, theirs = np.empty(options.problems), [], []
        for n in range(options.problems):  # interleaved, so that both meet the same load
            begin = time.perf_counter()
            best[n] = best_of_scipy(chain, targets[n], priors[n], options.starts, random)
            theirs.append((time.perf_counter() - begin) / options.starts)
            begin = time.perf_counter()
            solve_ik(chain, targets[n : n + 1], priors[n : n + 1], LAMBDA_X, LAMBDA_Q)
            ours.append(time.perf_counter() - begin)
        batch = np.inf
        for _ in range(5):
            begin = time.perf_counter()
            solve_ik(chain, targets, priors, LAMBDA_X, LAMBDA_Q)
            batch = min(batch, (time.perf_counter() - begin) / options.problems)
        within = np.mean(reached <= best + 1e-8)
        worse = np.sum(reached > objective(chain, priors, targets, priors) + 1e-15)
        gradient = projected_gradient(chain, solutions, targets, priors).max()
        ratio = np.median(theirs) / np.median(ours)
        print(f"{kind:12} {within:11.1%} {1.0 - within:17.1%} {gradient:19.1e} {worse:17d} {1e6 * batch:11.1f} "
              f"{1e6 * np.median(theirs):15.0f} {ratio:6.0f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
