"""One rollout with fixed full stiffness and with its schedule, as it was and with the human alone shaking."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mild_viz.files import write_arrays
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Rollout
from mild_viz.settings import choose
from mild_viz.simulation.grip import find_grips
from mild_viz.simulation.motion import CompliantMotion
from mild_viz.simulation.settings import HumanHand, Impedance
from mild_viz.simulation.simulate import simulate

STIFFNESSES = ("fixed", "schedule")
"""Full stiffness throughout; stiffness as the controller schedules it."""

SCENARIOS = ("commanded", "human-led")
"""The robot is commanded as in the rollout; or its command stands still while the hands hold each other, so that all
of the shaking is the human's, and the arm's giving way is seen alone."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """The same grips under both stiffnesses."""

    scenario: str
    """One of `SCENARIOS`."""
    joints_commanded: Float[np.ndarray, "N J"]
    """What was commanded in this scenario [rad]."""
    grips: tuple[tuple[int, int], ...]
    """First and last frame of each grip."""
    motions: Mapping[str, CompliantMotion]
    """By name in `STIFFNESSES`."""

    @property
    def scheduled(self) -> bool:
        """Whether the stiffness is ever lowered, that is whether the motions differ."""
        fixed, schedule = (self.motions[name] for name in STIFFNESSES)
        return not np.array_equal(fixed.joints, schedule.joints)

    def save(self, path: Path) -> None:
        """Write both motions to an .npz file, atomically: arrays named fixed_* and schedule_*, and the commands."""
        arrays: dict[str, np.ndarray] = {"joints_commanded": self.joints_commanded, "grips": np.array(self.grips)}
        for name, motion in self.motions.items():
            arrays |= {f"{name}_{field}": getattr(motion, field) for field in type(motion).__dataclass_fields__}
        write_arrays(path, arrays)


def compare(
    robot: RobotModel,
    rollout: Rollout,
    scenario: str = "commanded",
    impedance: Impedance | None = None,
    hand: HumanHand | None = None,
) -> Comparison:
    """Simulate a rollout with fixed full stiffness and with its schedule. Raises `UserError` as `simulate` does."""
    choose("scenario", scenario, SCENARIOS)
    rate = rollout.inference.rate
    grips = find_grips(rollout.contact, rollout.end_effector, rollout.target, rate, hand or HumanHand())
    commanded = np.array(rollout.joints_commanded)
    if scenario == "human-led":
        for first, last in grips:
            commanded[first : last + 1] = commanded[first]
    run = partial(simulate, robot, commanded, target=rollout.target, rate=rate, impedance=impedance, hand=hand,
                  grips=grips)  # fmt: skip
    stiffnesses = dict(zip(STIFFNESSES, (np.ones_like(commanded), rollout.stiffness), strict=True))
    return Comparison(
        scenario, commanded, grips, {name: run(stiffness=stiffness) for name, stiffness in stiffnesses.items()}
    )
