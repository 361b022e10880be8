"""From decoded joints to the command: contact rules, IK, smoothing, stiffness and the safety filter, frame by frame.

One compiled loop with a carry serves both the whole trial and one observation at a time, so that both
give the same bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mild_viz.errors import UserError
from mild_viz.robot.chain import ArmChain, kernel_array
from mild_viz.robot.control.rules import ContactRules
from mild_viz.robot.control.safety import Limits, limits_of
from mild_viz.robot.control.stiffness import stiffness_schedule
from mild_viz.robot.model import RobotModel
from mild_viz.robot.spec import StiffnessSpec
from mild_viz.settings import CONTROLLERS, ControlSettings

MAX_STATES = 62
"""States that fit into a bit mask."""


class ControlCarry(NamedTuple):
    """What the controller remembers between frames; the slots are named in `kernels`."""

    motion: Float[np.ndarray, "3 J"]
    """The previous command [rad], its velocity [rad/s], and the joints that were wanted [rad]."""
    hand: Float[np.ndarray, "3"]
    """Where the human's hand was last seen [m]; NaN before."""
    clock: Float[np.ndarray, "4"]
    flags: Int[np.ndarray, "4"]

    @property
    def joints(self) -> Float[np.ndarray, " J"]:
        """The previous command; the resting joints before the first one."""
        return self.motion[0]

    @property
    def age(self) -> float:
        """Time since an observation that was one to go by [s]."""
        return float(self.clock[0])

    def dismissed(self) -> ControlCarry:
        """As if the human had been gone for ever: the arm returns to rest until the next observation."""
        return self._replace(clock=np.concatenate([[np.inf], self.clock[1:]]))

    def paused(self, before: ControlCarry) -> ControlCarry:
        """What was learnt of the human since `before`, with the arm as it was then: no command was sent meanwhile."""
        return self._replace(motion=before.motion, clock=before.clock)


class Frames(NamedTuple):
    """What N frames give the controller."""

    log_alpha: Float[np.ndarray, "N S"]
    """The human-only forward variable."""
    log_transition: Float[np.ndarray, " N"]
    """log probability of the transition state; -inf where there is none."""
    decoded: Float[np.ndarray, "N J"]
    """Decoded joints [rad]."""
    targets: Float[np.ndarray, "N 3"]
    """The human's hand [m]; NaN where it is not known."""
    tracked: Bool[np.ndarray, " N"]
    """Whether the human was seen in this very frame."""
    seconds: Float[np.ndarray, " N"]
    """Time since the frame before [s]."""


class ControlResult(NamedTuple):
    """Commands for N frames."""

    joints: Float[np.ndarray, "N J"]
    """Commanded joints [rad], within the limits of the safety filter."""
    contact: Bool[np.ndarray, " N"]
    """Whether the most likely state is a contact state: this gates the IK (Algorithm vae-HMM-test)."""
    stiffness: Float[np.ndarray, "N J"]
    """Fraction of full joint stiffness."""
    fired: Int[np.ndarray, " N"]
    """Bit masks of the rules that fired: bit i is `rules.RULES[i]`."""
    carry: ControlCarry


@dataclass(frozen=True, eq=False)
class Controller:
    """What does not change between frames: the arm, its limits, and how it is controlled.

    Controllers: `mild` sends the decoded joints; `mild-ik` adapts them by IK in the contact states, with
    the decoded joints as prior (Algorithm vae-HMM-test); `base-ik` follows the hand at every frame by IK
    without the model, from the previous command on, which a weight of 1e-3 lambda_x keeps it near, so that it does not
    leap at the border of reach (Eq. ik-plain). A NaN target means no IK in that frame. IK
    goes no farther in a frame than the joints' velocity limits admit.

    The wanted joints are smoothed by a weighted moving average; the safety filter makes the command of them.
    Where the rules say so, the stiffness is lowered in contact, and the state that decides on this never returns
    to one that was active before the first contact (no back-transition to reaching). The transition state then
    decides on the stiffness too: contact begins when either a contact state or it is more likely than the state of
    reaching, and while no contact state has been active yet, it counts as one (Sec. IK adaptation and stiffness
    modulation). The IK is gated by the most likely state alone, as Algorithm vae-HMM-test says, unless the rules
    say otherwise.
    """

    chain: ArmChain
    settings: ControlSettings
    """With the contact states filled in."""
    rules: ContactRules
    n_states: int
    rate: float
    """Observations a second [Hz]."""
    limits: Limits
    stiffness: StiffnessSpec = StiffnessSpec()

    @cached_property
    def packed(self) -> tuple[Int[np.ndarray, "5"], Float[np.ndarray, "12"], Float[np.ndarray, "5 J"]]:
        """Choices, numbers and limits as `kernels` takes them; `UserError` for a contact state that does not exist."""
        settings, rules, limits, watch = self.settings, self.rules, self.limits, self.settings.watch
        schedule = stiffness_schedule(rules, settings.stiffness, self.stiffness)
        choices = np.array(
            [
                CONTROLLERS.index(settings.controller),
                state_mask(settings.contact_states or frozenset(), self.n_states),
                schedule.contact < schedule.free,
                rules.no_back_transition,
                rules.ik == "crossed",
            ],
            dtype=np.int64,
        )
        numbers = np.array(
            [
                *(settings.lambda_x, settings.lambda_q, settings.smoothing, rules.ik_doubt),
                *schedule,
                *(watch.max_age, watch.max_speed, watch.gone_after, 1.0 / self.rate),
            ]
        )
        rows = (limits.lower, limits.upper, limits.velocity, limits.acceleration, limits.rest)
        return choices, numbers, np.stack(rows)

    def start(self) -> ControlCarry:
        """The carry before the first frame: the arm rests, at full stiffness."""
        motion = np.stack([self.limits.rest, np.zeros(self.chain.n_joints), self.limits.rest])
        clock = np.array([0.0, 0.0, 0.0, self.stiffness.highest])
        return ControlCarry(motion, np.full(3, np.nan), clock, np.zeros(4, dtype=np.int64))

    def run(self, frames: Frames, carry: ControlCarry) -> ControlResult:
        """Commands for N frames. The given carry is not changed; go on from the result's."""
        from mild_viz.robot.control.kernels import control_loop

        motion, hand, clock, flags = (array.copy() for array in carry)
        commands, contact, stiffness, fired = control_loop(
            self.chain.arm,
            *self.packed,
            kernel_array(frames.log_alpha),
            kernel_array(frames.log_transition),
            kernel_array(frames.decoded),
            kernel_array(frames.targets),
            np.require(frames.tracked, dtype=np.bool_, requirements=["C", "W"]),
            kernel_array(frames.seconds),
            motion,
            hand,
            clock,
            flags,
        )
        spread = np.repeat(stiffness[:, None], self.chain.n_joints, axis=1)
        return ControlResult(commands, contact, spread, fired, ControlCarry(motion, hand, clock, flags))

    def idle(self, carry: ControlCarry, seconds: float) -> ControlResult:
        """One command without an observation, `seconds` after the last one: the arm stops, and later returns to rest.

        To send when an observation is overdue. The stiffness stays what it was to be until the human is gone.
        """
        nothing = Frames(
            log_alpha=np.full((1, self.n_states), np.nan),
            log_transition=np.full(1, -np.inf),
            decoded=np.full((1, self.chain.n_joints), np.nan),
            targets=np.full((1, 3), np.nan),
            tracked=np.zeros(1, dtype=bool),
            seconds=np.array([seconds], dtype=float),
        )
        return self.run(nothing, carry)


def make_controller(
    robot: RobotModel,
    settings: ControlSettings,
    rules: ContactRules,
    n_states: int,
    rate: float,
    arm: str | None = None,
) -> Controller:
    """The controller of one of a robot's arms, with the robot's own limits. Default: the arm that interacts."""
    chain = robot.chain if arm is None else robot.arms[arm]
    limits = limits_of(chain, robot.spec.safety)
    return Controller(chain, settings, rules, n_states, rate, limits, robot.spec.stiffness)


def state_mask(states: frozenset[int], n_states: int) -> int:
    """Bit mask of a set of HMM states. Raises `UserError` for a state that the model does not have."""
    unknown = sorted(state for state in states if not 0 <= state < n_states)
    if unknown:
        raise UserError(f"contact state {unknown[0]} is unknown; valid: 0 to {n_states - 1}")
    if n_states > MAX_STATES:
        raise UserError(f"the model has {n_states} states; the controller takes up to {MAX_STATES}")
    return sum(1 << state for state in states)
