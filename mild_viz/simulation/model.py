"""The controlled arm as MuJoCo takes it: kinematics and inertia from the robot's description, all else fixed."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.robot.chain import quaternions
from mild_viz.robot.model import RobotModel

GRAVITY = 9.81
"""Along -z of the robot's base frame [m/s^2]."""

HAND = "hand"
"""Name of the site at the end effector."""


def load_mujoco() -> Any:
    """The package, imported when it is first needed. `UserError` naming the extra where it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise UserError(
            "simulating compliance needs the package mujoco, which is not installed; "
            "install it with: pip install 'mild-viz[sim]'"
        ) from error
    return mujoco


def efforts(robot: RobotModel) -> Float[np.ndarray, " J"]:
    """Largest torque of every controlled joint [N m], as the description's <limit effort> says.

    `UserError` where a joint states none: there is no full stiffness to derive from it.
    """
    stated = {joint.name: joint.limit for joint in robot.description.urdf.robot.joints}
    found = []
    for name in robot.chain.joint_names:
        effort = getattr(stated[name], "effort", None)
        if effort is None or not 0.0 < float(effort) < float("inf"):
            raise UserError(
                f"{robot.urdf}: joint '{name}' has the effort {effort}; expected a <limit> with an effort above 0 N m, "
                "from which the simulation derives stiffness and torque limits"
            )
        found.append(float(effort))
    return np.array(found)


def build_model(robot: RobotModel, timestep: float, gravity_compensation: bool) -> Any:
    """The `mujoco.MjModel` of `robot.chain` on its base: a hinge per controlled joint, all others fixed at rest.

    Each hinge has the description's limits of position and torque, the rotor's inertia of `robot.toml`, and one
    actuator whose torque is gain * ctrl + bias[0] + bias[1] * angle + bias[2] * velocity, all 0 until they are set.
    With gravity compensation the joints' torques carry the arm's weight, within the same limits.
    The site `HAND` is the end effector.

    Raises:
        UserError: where MuJoCo is not installed; where a link that moves alone weighs nothing (naming it, and the
            robots that have inertias), or a mass, an inertia or an effort is no positive number.
    """
    mujoco = load_mujoco()
    torques = efforts(robot)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = timestep
    spec.option.gravity = [0.0, 0.0, -GRAVITY]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY

    inertials = {link.name: link.inertial for link in robot.description.urdf.robot.links}
    values = robot.description.values(dict(robot.spec.rest))
    names, bodies = robot.chain.joint_names, {robot.description.root: spec.worldbody}
    weighs: dict[str, bool] = {}  # by controlled joint: whether anything that it carries up to the next one does
    carrier: dict[str, str | None] = {robot.description.root: None}
    for joint in robot.description.joints:
        controlled = joint.name in names
        pose = joint.origin if controlled else joint.motion(values[joint.name])
        body = bodies[joint.parent].add_body(
            name=joint.child, pos=pose[:3, 3], quat=quaternions(pose[None, :3, :3])[0],
            gravcomp=float(gravity_compensation),
        )  # fmt: skip
        bodies[joint.child] = body
        carrier[joint.child] = joint.name if controlled else carrier[joint.parent]
        if controlled:
            torque = torques[names.index(joint.name)]
            hinge = body.add_joint(name=joint.name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=joint.axis)
            hinge.range, hinge.limited = [joint.lower, joint.upper], bool(np.isfinite(joint.upper - joint.lower))
            hinge.actfrcrange, hinge.actfrclimited = [-torque, torque], True
            hinge.actgravcomp, hinge.armature = True, robot.spec.dynamics.rotor_inertia
            weighs[joint.name] = False
        mover = carrier[joint.child]
        if mover is not None and inertials.get(joint.child) is not None:
            _weigh(body, inertials[joint.child], f"{robot.urdf}: link '{joint.child}'")
            weighs[mover] = True
    for name, heavy in weighs.items():
        if not heavy:
            raise UserError(
                f"{robot.urdf}: nothing that joint '{name}' moves has an <inertial>; the simulation needs the mass of "
                "every moving link; of the robots that ship, pepper has them"
            )
    for name in names:
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0] = 0.0
    bodies[robot.chain.end_effector].add_site(name=HAND, pos=robot.spec.main.tip_offset)
    return spec.compile()


def _weigh(body: Any, inertial: Any, where: str) -> None:
    """Give a body the mass, centre and moments of a description's <inertial>."""
    mass, matrix = inertial.mass, inertial.inertia
    if mass is None or not 0.0 < float(mass) < float("inf"):
        raise UserError(f"{where} has the mass {mass}; expected a number above 0 kg")
    moments = np.zeros(0) if matrix is None else np.linalg.eigvalsh(np.asarray(matrix, dtype=np.float64))
    if moments.size != 3 or not (np.isfinite(moments).all() and moments[0] > 0.0):
        raise UserError(f"{where} has the inertia {matrix}; expected a positive definite matrix [kg m^2]")
    origin = np.eye(4) if inertial.origin is None else np.asarray(inertial.origin, dtype=np.float64)
    turned = origin[:3, :3] @ np.asarray(matrix) @ origin[:3, :3].T
    body.explicitinertial, body.mass, body.ipos = True, float(mass), origin[:3, 3]
    body.fullinertia = [turned[0, 0], turned[1, 1], turned[2, 2], turned[0, 1], turned[0, 2], turned[1, 2]]
