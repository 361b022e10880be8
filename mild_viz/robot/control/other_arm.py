"""A robot's other arms: at rest, mirroring the one that interacts, following the human's left hand, or as decoded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mild_viz.data.windows import fill_gaps, max_gap
from mild_viz.errors import UserError
from mild_viz.robot.contact import in_frame
from mild_viz.robot.control.controller import Controller, Frames, make_controller
from mild_viz.robot.ik import forward
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import OtherArm
from mild_viz.settings import OTHER_ARM
from mild_viz.trial import Skeleton

LEFT_HAND = "left_wrist"
"""What the other arm meets of the human, as the interacting one meets the right wrist."""


def mirrored(robot: RobotModel, name: str, joints: Float[np.ndarray, "N J"]) -> Float[np.ndarray, "N K"]:
    """The interacting arm's joints [rad] as the mirror image that another arm makes of them, within its limits.

    Raises:
        UserError: if robot.toml does not say how that arm mirrors the interacting one.
    """
    signs = mirror_signs(robot, name)
    if not signs:
        raise UserError(
            f"robot {robot.name}: nothing says how arm '{name}' mirrors '{robot.spec.main.name}'; valid for it: rest, "
            "base-ik, or mirror_of and mirror_signs in its robot.toml"
        )
    return np.clip(joints * np.array(signs), robot.arms[name].lower, robot.arms[name].upper)


def mirror_signs(robot: RobotModel, name: str) -> tuple[float, ...]:
    """What each joint of the interacting arm is multiplied by, to be another arm's; empty where nothing says so."""
    main, other = robot.spec.main, robot.spec.arms[name]
    signs = ()
    if other.mirror_of == main.name:
        signs = other.mirror_signs
    elif main.mirror_of == name:  # signs are their own inverse
        signs = main.mirror_signs
    return signs if len(signs) == robot.chain.n_joints else ()


def other_arm_options(robot: RobotModel, skeleton: Skeleton | None) -> tuple[str, ...]:
    """Those of `OTHER_ARM` that this robot's other arms can do with this human; none where it has one arm."""
    others = list(robot.arms)[1:]
    if not others:
        return ()
    mirrors = all(mirror_signs(robot, one) for one in others)
    seen = bool(np.isfinite(_left_wrist(skeleton, 1)).any())
    needs = {"rest": (False, False), "mild": (True, False), "base-ik": (False, True), "mild-ik": (True, True)}
    return tuple(name for name in OTHER_ARM if (mirrors or not needs[name][0]) and (seen or not needs[name][1]))


def move_other_arms(
    robot: RobotModel,
    controller: Controller,
    frames: Frames,
    skeleton: Skeleton | None,
    T_world_human: Float[np.ndarray, "4 4"],
    others_decoded: Mapping[str, Float[np.ndarray, "N _"]],
) -> tuple[OtherArm, ...]:
    """What the other arms do while `controller` moves the interacting one; nothing where they rest.

    They follow the same states, contact rules and kind of limits. Only with IK do they need the human's left hand.
    Where the model decodes their joints (`others_decoded`, by name), they do as the interacting one does.

    Raises:
        UserError: if the robot has no other arm, or no rule to mirror by, or the left hand was not recorded; or if the
            model decodes the other arms' joints and the settings ask for something else.
    """
    chosen = controller.settings.other_arm
    if others_decoded:
        if chosen != "rest":
            raise UserError(f"other_arm is {chosen}; valid for a model that moves all arms itself: rest (as it says)")
        chosen = controller.settings.controller
    if chosen == "rest":
        return ()
    if len(robot.arms) == 1:
        raise UserError(f"robot {robot.name} has one arm; valid for the other arm: rest")
    hand = _left_hand(skeleton, controller.rate, T_world_human, len(frames.decoded))
    to_hand = chosen in ("base-ik", "mild-ik")
    if to_hand and not np.isfinite(hand).any():
        raise UserError(
            f"the human's left hand was not recorded, which {chosen} needs; valid for the other arm: rest, mild"
        )
    settings = replace(controller.settings, controller=chosen)
    arms = []
    for name, chain in list(robot.arms.items())[1:]:
        if others_decoded and name not in others_decoded:
            continue  # it rests, as in a stream
        if others_decoded:
            decoded = others_decoded[name]
        elif chosen == "base-ik":
            decoded = np.tile(chain.rest, (len(hand), 1))
        else:
            decoded = mirrored(robot, name, frames.decoded)
        own = make_controller(robot, settings, controller.rules, controller.n_states, controller.rate, name)
        seen = frames._replace(decoded=decoded)
        if to_hand:
            seen = seen._replace(targets=hand)
        result = own.run(seen, own.start())
        end_effector = forward(chain, result.joints)
        arms.append(
            OtherArm(
                name=name,
                controller=chosen,
                joint_names=chain.joint_names,
                joints_decoded=decoded,
                joints_commanded=result.joints,
                end_effector=end_effector,
                target=hand,
                hand_distance=np.linalg.norm(end_effector - hand, axis=1),
                stiffness=result.stiffness,
                fired=result.fired,
            )
        )
    return tuple(arms)


def _left_hand(
    skeleton: Skeleton | None, rate: float, T_world_human: Float[np.ndarray, "4 4"], n: int
) -> Float[np.ndarray, "N 3"]:
    """The human's left wrist [m], short gaps bridged as those of the right one are; NaN where it is not known."""
    return in_frame(T_world_human, fill_gaps(_left_wrist(skeleton, n), max_gap(rate)))


def _left_wrist(skeleton: Skeleton | None, n: int) -> Float[np.ndarray, "_ 3"]:
    """As recorded, in the human's frame [m]; n rows of NaN where no skeleton has it."""
    if skeleton is None or LEFT_HAND not in skeleton.joint_names:
        return np.full((n, 3), np.nan)
    return skeleton.positions[:, skeleton.joint_names.index(LEFT_HAND)]
