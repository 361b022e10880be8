"""What `robot.toml` says about a robot: its description, arms, resting posture, hands, retargeting and limits.

A robot is a folder with this file and the description that it names; adding one takes no code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, get_type_hints

from mild_viz.errors import UserError
from mild_viz.robot.position_rule import PositionRule
from mild_viz.settings import choose
from mild_viz.toml_config import check_keys, converted, read_toml
from mild_viz.trial import ACTIONS

SPEC = "robot.toml"

RETARGETING = ("position", "pepper-angles")
"""How a person's arm becomes the robot's joints: by the place of hand and elbow (any arm), or by the angles of the
person's arm, as Pepper's arm is built for."""


@dataclass(frozen=True)
class ArmSpec:
    """One arm that can be controlled."""

    name: str
    joints: tuple[str, ...]
    """In the order of the recordings."""
    end_effector: str
    """Link whose origin, moved by `tip_offset`, meets the human's hand."""
    tip_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """In the end effector's frame [m]."""
    elbow: str | None = None
    """Joint whose origin is the elbow; None: the arm's elbow is nowhere in particular."""
    retarget: str = "position"
    """One of `RETARGETING`."""
    position: PositionRule = PositionRule()
    """How hand and elbow are held where `retarget` is position."""
    mirror_of: str | None = None
    """The arm that this one mirrors, joint by joint."""
    mirror_signs: tuple[float, ...] = ()
    """What each joint's angle is multiplied by, to be the mirror image of the other arm's joint."""


@dataclass(frozen=True)
class StiffnessSpec:
    """Range of the joint stiffness that a controller may ask for, as fractions of full stiffness."""

    lowest: float = 0.0
    highest: float = 1.0
    rate: float = 10.0
    """Fastest change [1/s]."""


@dataclass(frozen=True)
class SafetySpec:
    """What the safety filter keeps to, beside the description's limits of position and velocity."""

    margin: float = 0.01
    """Distance that a command keeps from the limits of position [rad]."""
    acceleration: float | None = None
    """Largest acceleration of every joint [rad/s^2]; None: what gets it to its largest speed in
    `control.safety.RISE_TIME`."""


@dataclass(frozen=True)
class DynamicsSpec:
    """What the simulation knows of a robot beside its description's masses and efforts."""

    rotor_inertia: float = 0.0
    """Inertia of a motor's rotor as its joint feels it, through the gears [kg m^2]; the same for every joint."""


@dataclass(frozen=True, eq=False)
class RobotSpec:
    """A robot as its folder describes it. The first arm is the one that interacts unless said otherwise."""

    name: str
    title: str
    """Its name as its maker writes it."""
    urdf: Path
    arms: Mapping[str, ArmSpec]
    rest: Mapping[str, float] = field(default_factory=dict)
    """Where joints rest [rad or m]; those not named at 0."""
    hands: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Per action, where joints beyond the arms stand instead [rad or m]; they must not move an end effector."""
    stiffness: StiffnessSpec = StiffnessSpec()
    safety: SafetySpec = SafetySpec()
    robot_descriptions: str | None = None
    """Module of the package of that name that has the manufacturer's description."""
    dynamics: DynamicsSpec = DynamicsSpec()
    file: Path | None = None
    """The robot.toml; None for a bare description."""

    @cached_property
    def main(self) -> ArmSpec:
        """The arm that interacts unless said otherwise."""
        return next(iter(self.arms.values()))

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self.main.joints

    @property
    def end_effector(self) -> str:
        return self.main.end_effector


KEYS = (
    "title", "description", "rest", "hands", "arms", "stiffness", "safety", "dynamics", "robot_descriptions",
)  # fmt: skip
ARM_KEYS: dict[str, Any] = {
    name: hint for name, hint in get_type_hints(ArmSpec).items() if name not in ("name", "position")
}


def read_spec(folder: Path) -> RobotSpec:
    """The robot of a folder with a `robot.toml`.

    Raises:
        UserError: naming the file and the key, what was found and what would be valid. Whether the description has
            these joints and links is found out when the robot is loaded.
    """
    file = Path(folder) / SPEC
    table = read_toml(file)
    check_keys(table, KEYS, str(file))
    for key in ("title", "description", "arms"):
        if key not in table:
            raise UserError(f"{file}: {key} is missing; expected title, description (a .urdf file beside it) and arms")
    description = file.parent / converted(table["description"], str, f"{file}: description")
    if description.suffix.lower() != ".urdf" or not description.is_file():
        raise UserError(f"{file}: description: {description} is no URDF file; expected one, relative to {file.parent}")
    arms = {
        name: _arm(name, arm, f"{file}: arms.{name}") for name, arm in _table(table["arms"], f"{file}: arms").items()
    }
    if not arms:
        raise UserError(f"{file}: arms is empty; expected one table [arms.NAME] or more")
    for arm in arms.values():
        _check_mirror(arm, arms, f"{file}: arms.{arm.name}")
    hands = _table(table.get("hands", {}), f"{file}: hands")
    for action in hands:
        choose(f"{file}: hands: action", action, ACTIONS)
    return RobotSpec(
        name=file.parent.resolve().name,
        title=converted(table["title"], str, f"{file}: title"),
        urdf=description,
        arms=arms,
        rest=_values(table.get("rest", {}), f"{file}: rest"),
        hands={action: _values(hand, f"{file}: hands.{action}") for action, hand in hands.items()},
        stiffness=_stiffness(table.get("stiffness", {}), f"{file}: stiffness"),
        safety=_safety(table.get("safety", {}), f"{file}: safety"),
        robot_descriptions=_module(table, f"{file}: robot_descriptions"),
        dynamics=_dynamics(table.get("dynamics", {}), f"{file}: dynamics"),
        file=file,
    )


def _table(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise UserError(f"{where} is {value!r}, expected a table")
    return value


def _values(value: Any, where: str) -> dict[str, float]:
    return {name: converted(number, float, f"{where}.{name}") for name, number in _table(value, where).items()}


def _fields(value: Any, hints: Mapping[str, Any], where: str) -> dict[str, Any]:
    check_keys(_table(value, where), hints, where)
    return {key: converted(entry, hints[key], f"{where}.{key}") for key, entry in value.items()}


def _arm(name: str, value: Any, where: str) -> ArmSpec:
    table = _table(value, where)
    position = _fields(table.get("position", {}), get_type_hints(PositionRule), f"{where}.position")
    fields = _fields({key: entry for key, entry in table.items() if key != "position"}, ARM_KEYS, where)
    for key in ("joints", "end_effector"):
        if not fields.get(key):
            raise UserError(f"{where}: {key} is missing; expected joints = [...] and end_effector = a link")
    arm = ArmSpec(name, **fields, position=PositionRule(**position))
    if len(set(arm.joints)) < len(arm.joints):
        raise UserError(f"{where}: joints names one twice: {', '.join(arm.joints)}")
    if arm.elbow is not None:
        choose(f"{where}: elbow", arm.elbow, arm.joints)
    choose(f"{where}: retarget", arm.retarget, RETARGETING)
    _check_position(arm, f"{where}.position")
    return arm


def _check_position(arm: ArmSpec, where: str) -> None:
    rule = arm.position
    if min(rule.level_weight, rule.elbow_weight, *rule.joint_weights) < 0.0 or not any(rule.tool_axis):
        raise UserError(f"{where} has a weight below 0, or a tool_axis of length 0; expected weights of at least 0")
    if len(rule.joint_weights) not in (0, len(arm.joints)):
        raise UserError(f"{where}: joint_weights is {list(rule.joint_weights)}; expected {len(arm.joints)}, or none")
    if rule.elbow_weight > 0.0 and (arm.elbow is None or not (rule.lean or rule.rise)):
        raise UserError(f"{where}: elbow_weight is set; expected elbow of the arm, and lean or rise, with it")


def _check_mirror(arm: ArmSpec, arms: Mapping[str, ArmSpec], where: str) -> None:
    if arm.mirror_of is None:
        if arm.mirror_signs:
            raise UserError(f"{where}: mirror_signs without mirror_of; expected both or none")
        return
    choose(f"{where}: mirror_of", arm.mirror_of, [name for name in arms if name != arm.name])
    n_joints = len(arms[arm.mirror_of].joints)
    if not len(arm.mirror_signs) == len(arm.joints) == n_joints or any(abs(sign) != 1.0 for sign in arm.mirror_signs):
        raise UserError(
            f"{where}: mirror_signs is {list(arm.mirror_signs)}; expected 1 or -1 for each of {n_joints} joints"
        )


def _module(table: Mapping[str, Any], where: str) -> str | None:
    name = converted(table["robot_descriptions"], str, where) if "robot_descriptions" in table else None
    if name is not None and not name.isidentifier():
        raise UserError(f"{where} is {name!r}; expected the name of a module, such as panda_description")
    return name


def _stiffness(value: Any, where: str) -> StiffnessSpec:
    spec = StiffnessSpec(**_fields(value, get_type_hints(StiffnessSpec), where))
    if not 0.0 <= spec.lowest <= spec.highest <= 1.0:
        raise UserError(f"{where} is {spec.lowest} to {spec.highest}; valid: 0 <= lowest <= highest <= 1")
    if not spec.rate > 0.0:
        raise UserError(f"{where}: rate is {spec.rate}; valid: above 0 a second")
    return spec


def _safety(value: Any, where: str) -> SafetySpec:
    spec = SafetySpec(**_fields(value, get_type_hints(SafetySpec), where))
    if not (0.0 <= spec.margin <= 0.5 and (spec.acceleration is None or spec.acceleration > 0.0)):
        raise UserError(f"{where}: margin is {spec.margin}, acceleration {spec.acceleration}; valid: a margin of 0 to "
                        "0.5 rad, an acceleration above 0 rad/s^2")  # fmt: skip
    return spec


def _dynamics(value: Any, where: str) -> DynamicsSpec:
    spec = DynamicsSpec(**_fields(value, get_type_hints(DynamicsSpec), where))
    if not 0.0 <= spec.rotor_inertia < float("inf"):
        raise UserError(f"{where}: rotor_inertia is {spec.rotor_inertia}; valid: a finite number of 0 or more kg m^2")
    return spec
