"""The rules of contact as data, and the rules that can be seen to fire.

The kernels know the rules by their numbers here: after a change of those, remove __pycache__ of this folder.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

from mild_viz.errors import UserError
from mild_viz.settings import choose
from mild_viz.trial import ACTIONS

(
    IN_CONTACT, CROSSED, NO_RETURN, BY_IK, IN_DOUBT, OUT_OF_REACH, SOFT, RAMPING, MARGIN, VELOCITY, ACCELERATION,
    MISSING, JUMPED, STALE, INVALID, GONE,
) = range(16)  # fmt: skip
"""Numbers of the rules: bit i of `fired` is `RULES[i]`."""


class Rule(NamedTuple):
    """A rule that can fire in a frame."""

    name: str
    text: str
    """What it means that it fired, in one sentence for the page."""
    safety: bool = False
    """Whether it is the safety filter that stepped in."""


RULES = (
    Rule("contact", "The most likely state is a contact state."),
    Rule("transition", "The transition state is more likely than reaching, so contact has begun."),
    Rule("no return", "The most likely state belongs to reaching, which is over; the next most likely state counts."),
    Rule("ik", "Inverse kinematics draws the hand to the human's."),
    Rule("doubt", "The most likely state is no contact state, but so uncertain that inverse kinematics is applied."),
    Rule("out of reach", "The joint limits keep the hand from the human's; it goes as near as it can."),
    Rule("soft", "The joints give way: their stiffness is lowered."),
    Rule("ramp", "The stiffness is on its way to another value."),
    Rule("limit", "A joint is held away from its limit, or brakes before it.", True),
    Rule("velocity", "A joint moves at its largest velocity, slower than wanted.", True),
    Rule("acceleration", "A joint changes its velocity as fast as it may, slower than wanted.", True),
    Rule("missing", "The human's arm is not seen, or not all of it.", True),
    Rule("jump", "The human's hand jumped farther than a hand moves; the robot stops where it is.", True),
    Rule("stale", "The human has not been seen for too long; the robot stops where it is.", True),
    Rule("invalid", "The model's numbers are not usable; the robot stops where it is.", True),
    Rule("gone", "The human is gone; the robot returns to its resting posture.", True),
)
"""Every rule, in the order of their numbers."""


def fired_rules(mask: int) -> tuple[Rule, ...]:
    """The rules whose bits are set in one frame's mask."""
    return tuple(rule for number, rule in enumerate(RULES) if (int(mask) >> number) & 1)


IK_WHEN = ("contact", "crossed")
"""When IK adapts the decoded joints: in contact states (Algorithm vae-HMM-test), or from the first contact on."""


@dataclass(frozen=True)
class ContactRules:
    """How a robot behaves in the contact of one action: what config.json of a checkpoint says in `contact_rules`.

    Sec. IK adaptation and stiffness modulation of the paper.
    """

    compliant: bool = False
    """Whether the stiffness is lowered in contact."""
    stiffness: float = 0.4
    """Fraction of full joint stiffness in contact, where compliant.

    Our choice: the paper says that the stiffness is lowered, and gives no value (the authors' controller lowers the
    effort of one joint from 0.5 to 0.15). It is low enough that a hand moves Pepper's arm, and high enough that the
    arm does not sink under its own weight.
    """
    stiffness_fall: float = 3.0
    """How fast the stiffness falls [1/s]: within 0.2 s, before a hand that arrives has shaken."""
    stiffness_rise: float = 0.6
    """How fast the stiffness rises again [1/s]: 1 s, so that no hand is pulled along. The authors' controller rises
    by 0.01 of 0.5 with every frame, at 30 Hz as fast as this."""
    no_back_transition: bool = False
    """Whether the states seen before the first contact are over for the stiffness, once there was contact."""
    transition_state: bool = False
    """Whether the transition state, where the model has one, says that contact has begun."""
    ik: str = "contact"
    """When IK adapts the decoded joints, one of `IK_WHEN`."""
    ik_doubt: float = 0.0
    """A state below this probability does not keep IK from being applied, even if it is no contact state."""

    def __post_init__(self) -> None:
        choose("ik", self.ik, IK_WHEN)
        for name in ("stiffness", "ik_doubt", "stiffness_fall", "stiffness_rise"):
            low, high = (0.0, 1.0) if name in ("stiffness", "ik_doubt") else (1e-3, 1e3)
            if not low <= getattr(self, name) <= high:
                raise UserError(f"{name} is {getattr(self, name)}; valid: {low:g} to {high:g}")


PLAIN = ContactRules()
"""Contact without compliance: IK in the contact states, and nothing else."""

DEFAULT_RULES: Mapping[str, ContactRules] = {
    "wave": PLAIN,
    # "the robot must be compliant with the human's motion when in contact"
    "handshake": ContactRules(compliant=True, no_back_transition=True, transition_state=True),
    "rocket": PLAIN,
    "parachute": PLAIN,
    "handover": PLAIN,
}
"""The rules of each action where a checkpoint says nothing else, and those that training writes.

The authors' own ROS controller departs from the paper's Algorithm vae-HMM-test, which governs here. There a handshake
is adapted by IK from the transition on ("ik": "crossed"), and a rocket also in the first and the last state where they
are less likely than 0.6 ("ik_doubt": 0.6): both can be said in config.json.
"""


def parse_contact_rules(value: Any, actions: tuple[str, ...], where: str) -> dict[str, ContactRules]:
    """The rules of each action, as config.json holds them; what is not said of an action is its default.

    Raises:
        UserError: naming the action and the field, what was found, and what would be valid.
    """
    if type(value) is not dict:
        raise UserError(f"{where} is {reprlib.repr(value)}, expected an object {{...}} of rules by action")
    return {
        choose(f"{where}: action", action, actions): _parse(row, action, f"{where}: {action}")
        for action, row in value.items()
    }


def _parse(row: Any, action: str, where: str) -> ContactRules:
    if type(row) is not dict:
        raise UserError(f"{where} is {reprlib.repr(row)}, expected an object {{...}}")
    default = DEFAULT_RULES[action]
    fields = {}
    for name, value in row.items():
        meant = asdict(default).get(name)
        if meant is None:
            raise UserError(f"{where}: {reprlib.repr(name)} is unknown; valid: {', '.join(asdict(default))}")
        number = type(meant) is float and type(value) in (float, int) and abs(value) < 1e300
        if not number and type(value) is not type(meant):
            expected = {bool: "true or false", float: "a number", str: "a text"}[type(meant)]
            raise UserError(f"{where}.{name} is {reprlib.repr(value)}, expected {expected}")
        fields[name] = float(value) if number else value
    try:
        return replace(default, **fields)
    except UserError as error:
        raise UserError(f"{where}.{error}") from None


def rules_as_json(rules: Mapping[str, ContactRules]) -> dict[str, dict[str, Any]]:
    """The rules by action as JSON holds them."""
    return {action: asdict(row) for action, row in rules.items()}


assert len(RULES) == GONE + 1 and set(DEFAULT_RULES) == set(ACTIONS)
