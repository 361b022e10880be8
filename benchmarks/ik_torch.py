"""How much faster the inverse kinematics is than bounded Levenberg-Marquardt in torch, one arm, cold from its prior.

    OMP_NUM_THREADS=1 python benchmarks/ik_torch.py [--robot panda] [--kind near] [--problems 200]

The reference is written as one would write it with the library: pytorch-kinematics gives pose and Jacobian from one
pass, in float64; Gauss-Newton with a damping per problem, limits by an active set, batched over problems; both stop
at the same projected gradient. Both solve the same problems from the same priors in one process, in turn. For one
problem at a time (what a robot does) and for all at once, it prints the ratio of the medians and the objective that
ours has more than the reference's: at most 1e-8 wherever both descend into the same optimum.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import time

import numpy as np
import pytorch_kinematics as pk
import torch
from ik import KINDS, LAMBDA_Q, LAMBDA_X, objective, random_problems

from mild_viz.robot.ik import solve_ik
from mild_viz.robot.kernels import MAX_ITERATIONS, TOLERANCE
from mild_viz.robot.model import RobotModel, load_robot

SAME = 1e-3
"""Solutions that differ by less than this in every joint are in the same optimum [rad]."""


class TorchIK:
    """Bounded Levenberg-Marquardt of Eq. ik-prior-simplified for B problems at once."""

    def __init__(self, robot: RobotModel, tolerance: float) -> None:
        chain, description = robot.chain, robot.description
        with contextlib.redirect_stderr(io.StringIO()):  # the parser tells of every attribute that it does not know
            serial = pk.build_serial_chain_from_urdf(
                description.path.read_bytes(), chain.end_effector, description.root
            )
        self.serial = serial.to(dtype=torch.float64)
        names = self.serial.get_joint_parameter_names()
        values = description.values(dict(robot.spec.rest))
        self.resting = torch.tensor([values[name] for name in names], dtype=torch.float64)
        self.columns = [names.index(name) for name in chain.joint_names]
        self.lower, self.upper = torch.tensor(chain.lower), torch.tensor(chain.upper)
        self.tolerance = tolerance

    def kinematics(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions (B, 3) and Jacobians (B, 3, J)."""
        full = q
        if len(self.resting) > q.shape[1]:
            full = self.resting.repeat(len(q), 1)
            full[:, self.columns] = q
        jacobian, pose = self.serial.jacobian(full, ret_eef_pose=True)
        return pose[:, :3, 3], jacobian[:, :3, self.columns]

    @torch.no_grad()
    def solve(self, targets: torch.Tensor, priors: torch.Tensor) -> torch.Tensor:
        """Solutions (B, J); problems that are done leave the batch."""
        q = torch.clamp(priors, self.lower, self.upper)
        solutions, left = q.clone(), torch.arange(len(q))
        identity = torch.eye(q.shape[1], dtype=q.dtype)
        damping = torch.zeros(len(q), dtype=q.dtype)
        position, jacobian = self.kinematics(q)
        cost = self._cost(position, targets, q, priors)
        for _ in range(MAX_ITERATIONS):
            error = position - targets
            gradient = LAMBDA_X * torch.einsum("bxj,bx->bj", jacobian, error) + LAMBDA_Q * (q - priors)
            held = ((q <= self.lower) & (gradient > 0.0)) | ((q >= self.upper) & (gradient < 0.0))
            going = (torch.where(held, 0.0, 2.0 * gradient.abs()).amax(dim=1) > self.tolerance) & (damping < 1e6)
            if not going.all():
                solutions[left] = q
                if not going.any():
                    return solutions
                kept = (left, targets, priors, q, position, jacobian, cost, damping, gradient, held)
                left, targets, priors, q, position, jacobian, cost, damping, gradient, held = (x[going] for x in kept)
            free = (~held).to(q.dtype)
            hessian = LAMBDA_X * jacobian.transpose(1, 2) @ jacobian + (LAMBDA_Q + damping[:, None, None]) * identity
            system = free[:, :, None] * free[:, None, :] * hessian + torch.diag_embed(1.0 - free)
            step = torch.cholesky_solve(-(free * gradient)[:, :, None], torch.linalg.cholesky(system))[:, :, 0]
            candidate = torch.clamp(q + step, self.lower, self.upper)
            moved, bent = self.kinematics(candidate)
            new_cost = self._cost(moved, targets, candidate, priors)
            better = new_cost <= cost
            q, position = (torch.where(better[:, None], *pair) for pair in ((candidate, q), (moved, position)))
            jacobian, cost = torch.where(better[:, None, None], bent, jacobian), torch.where(better, new_cost, cost)
            damping = torch.where(better, damping / 10.0, torch.clamp(damping * 10.0, min=1e-3))
        solutions[left] = q
        return solutions

    @staticmethod
    def _cost(position: torch.Tensor, targets: torch.Tensor, q: torch.Tensor, priors: torch.Tensor) -> torch.Tensor:
        return LAMBDA_X * ((position - targets) ** 2).sum(1) + LAMBDA_Q * ((q - priors) ** 2).sum(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="panda", help="name or path of the robot's description")
    parser.add_argument("--kind", default="near", choices=KINDS, help="kind of random problems, as in ik.py")
    parser.add_argument("--problems", type=int, default=200, help="random problems")
    parser.add_argument("--repeats", type=int, default=5, help="repeats of all problems at once")
    options = parser.parse_args()
    torch.set_num_threads(1)
    robot = load_robot(options.robot)
    targets, priors = random_problems(robot.chain, options.kind, options.problems, np.random.default_rng(0))
    wanted, starts = torch.from_numpy(targets), torch.from_numpy(priors)
    solve_ik(robot.chain, targets[:1], priors[:1], LAMBDA_X, LAMBDA_Q)  # compiled, as after a robot's start
    print(f"{options.robot}, {options.problems} problems '{options.kind}', both from their priors, one thread")
    for tolerance in (TOLERANCE, 1e-6):
        reference = TorchIK(robot, tolerance)
        reference.solve(wanted[:2], starts[:2])
        ours, theirs = np.empty_like(priors), np.empty_like(priors)
        times = np.empty((options.problems, 2))
        for n in range(options.problems):  # interleaved, so that both meet the same load
            begin = time.perf_counter()
            ours[n] = solve_ik(robot.chain, targets[n : n + 1], priors[n : n + 1], LAMBDA_X, LAMBDA_Q)[0]
            middle = time.perf_counter()
            theirs[n] = reference.solve(wanted[n : n + 1], starts[n : n + 1]).numpy()[0]
            times[n] = middle - begin, time.perf_counter() - middle
        whole = np.empty((options.repeats, 2))
        for n in range(options.repeats):
            begin = time.perf_counter()
            solve_ik(robot.chain, targets, priors, LAMBDA_X, LAMBDA_Q)
            middle = time.perf_counter()
            reference.solve(wanted, starts)
            whole[n] = middle - begin, time.perf_counter() - middle
        excess = objective(robot.chain, ours, targets, priors) - objective(robot.chain, theirs, targets, priors)
        same = np.abs(ours - theirs).max(axis=1) < SAME
        single, batch = np.median(times, axis=0), np.median(whole, axis=0) / options.problems
        print(
            f"reference stops at a projected gradient of {tolerance:g}\n"
            f"  one at a time   ours {1e6 * single[0]:7.1f} us   torch {1e6 * single[1]:9.1f} us   "
            f"{single[1] / single[0]:7.0f} times faster\n"
            f"  all at once     ours {1e6 * batch[0]:7.1f} us   torch {1e6 * batch[1]:9.1f} us   "
            f"{batch[1] / batch[0]:7.0f} times faster, each\n"
            f"  objective, ours less torch's: at most {excess[same].max():.1e} in the same optimum "
            f"({same.mean():.1%} of the problems); elsewhere ours is lower in {np.sum(excess[~same] < -1e-8)}, "
            f"higher in {np.sum(excess[~same] > 1e-8)}"
        )


if __name__ == "__main__":
    main()
