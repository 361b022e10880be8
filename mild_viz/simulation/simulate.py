"""Joint impedance control of a commanded trajectory, step by step in MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from mild_viz.errors import UserError
from mild_viz.robot.model import RobotModel
from mild_viz.simulation.model import HAND, build_model, efforts, load_mujoco
from mild_viz.simulation.motion import CompliantMotion
from mild_viz.simulation.settings import HumanHand, Impedance


def simulate(
    robot: RobotModel,
    joints_commanded: Float[np.ndarray, "N J"],
    stiffness: Float[np.ndarray, "N J"],
    target: Float[np.ndarray, "N 3"],
    rate: float,
    impedance: Impedance | None = None,
    hand: HumanHand | None = None,
    grips: tuple[tuple[int, int], ...] = (),
    start: Float[np.ndarray, " J"] | None = None,
) -> CompliantMotion:
    """The arm's motion under the commands [rad] with the human's hand on it.

    Torque of joint i: s_i K_i (q*_i - q_i) + D_i (q*'_i - q'_i) + the weight, clamped to the effort (`Impedance`). The
    human's hand pulls with k (x_h - x - o) + d (x_h' - x') while it holds the robot's (`HumanHand`): x_h is `target`
    [m, base frame], x the end effector, o their difference when the hands met, so that no force arises from it.
    Commands and target are interpolated monotonically (no overshoot, continuous velocity), the stiffness linearly.
    The steps are of equal length and nothing is random: the same arguments give the same bits.

    Args:
        stiffness: Fraction of full stiffness per joint, 0 to 1.
        rate: Commands a second [Hz].
        grips: First and last frame of each grip (`find_grips` makes them of contact); the target is known in them.
        start: Joints at the first command, at rest [rad]; None: as commanded.

    Raises:
        UserError: where MuJoCo is missing or the robot has no inertias (`build_model`), shapes do not fit, commands
            are not finite, or the motion diverges.
    """
    impedance, hand = impedance or Impedance(), hand or HumanHand()
    _check(robot, joints_commanded, stiffness, target, rate)
    commanded = robot.end_effector(joints_commanded)
    n_frames = len(joints_commanded)
    per_frame = int(np.ceil(1.0 / (rate * impedance.timestep) - 1e-9))
    timestep = 1.0 / (rate * per_frame)
    frames, steps = np.arange(n_frames) / rate, np.arange((n_frames - 1) * per_frame + 1) * timestep
    reference = _Reference(
        *_smooth(frames, joints_commanded, steps),
        np.stack([np.interp(steps, frames, column) for column in stiffness.T], axis=1)
        * (efforts(robot) / impedance.saturation),
        *_holding(grips, frames, target, steps, per_frame, hand.grip_time),
    )
    model = build_model(robot, timestep, impedance.gravity_compensation)
    joints, tip, force, peak, stretch, torques, energy = _run(
        model, reference, per_frame, joints_commanded[0] if start is None else start, impedance, hand
    )
    if not np.isfinite(joints).all():
        raise UserError(
            f"the simulated arm diverges at {frames[~np.isfinite(joints).all(1)][0]:.2f} s; a smaller timestep than "
            f"{impedance.timestep} s or a lower stiffness of the human's hand than {hand.stiffness} N/m may help"
        )
    gripped = np.zeros(n_frames, dtype=bool)
    for first, last in grips:
        gripped[first : last + 1] = True
    return CompliantMotion(
        time=frames,
        joints=joints,
        end_effector=tip,
        gripped=gripped,
        hand_force=force,
        force_peak=peak,
        displacement=np.linalg.norm(tip - commanded, axis=1),
        human_displacement=stretch,
        torques=torques,
        energy=energy,
    )


@dataclass(frozen=True, eq=False)
class _Reference:
    """What is wanted at each of S steps."""

    joints: Float[np.ndarray, "S J"]
    velocity: Float[np.ndarray, "S J"]
    gains: Float[np.ndarray, "S J"]
    """Scheduled stiffness [N m/rad]."""
    grip: Float[np.ndarray, " S"]
    """How firmly the hands hold each other, 0 to 1."""
    hand: Float[np.ndarray, "S 3"]
    hand_velocity: Float[np.ndarray, "S 3"]
    met: Bool[np.ndarray, " S"]
    """True at the first step of every grip."""


def _run(
    model: Any,
    reference: _Reference,
    per_frame: int,
    start: Float[np.ndarray, " J"],
    impedance: Impedance,
    hand: HumanHand,
) -> tuple[np.ndarray, ...]:
    """Step through the reference; one row a frame of what `CompliantMotion` holds."""
    mujoco = load_mujoco()
    data, site = mujoco.MjData(model), model.site(HAND).id
    n_steps, n_joints = reference.joints.shape
    n_frames = (n_steps - 1) // per_frame + 1
    joints, torques = np.full((n_frames, n_joints), np.nan), np.zeros((n_frames, n_joints))
    tips, forces = np.zeros((n_frames, 3)), np.zeros((n_frames, 3))
    peaks, stretches, energies = np.zeros(n_frames), np.zeros(n_frames), np.zeros(n_frames)
    inertia, jacobian = np.zeros((n_joints, n_joints)), np.zeros((3, n_joints))
    gain, bias = model.actuator_gainprm, model.actuator_biasprm
    offset, damping, peak = np.zeros(3), np.zeros(n_joints), 0.0
    data.qpos[:] = start
    for step in range(n_steps):
        mujoco.mj_step1(model, data)  # where everything is
        frame, between = divmod(step, per_frame)
        stiffness = reference.gains[step]
        if between == 0:
            mujoco.mj_fullM(model, inertia, data.qM)
        damping = 2.0 * impedance.damping_ratio * np.sqrt(stiffness * inertia.diagonal())
        gain[:, 0], bias[:, 1], bias[:, 2] = stiffness, -stiffness, -damping
        bias[:, 0] = damping * reference.velocity[step]
        data.ctrl[:] = reference.joints[step]
        tip, grip = data.site_xpos[site], reference.grip[step]
        if reference.met[step]:
            offset = reference.hand[step] - tip
        force = stretch = np.zeros(3)
        if grip > 0.0:
            mujoco.mj_jacSite(model, data, jacobian, None, site)
            stretch = reference.hand[step] - tip - offset
            pull = hand.stiffness * stretch + hand.damping * (reference.hand_velocity[step] - jacobian @ data.qvel)
            force = grip * pull
        data.qfrc_applied[:] = jacobian.T @ force
        peak = max(peak, float(np.linalg.norm(force)))
        if between == 0:
            joints[frame], tips[frame], forces[frame], peaks[frame] = data.qpos, tip, force, peak
            stretches[frame] = np.linalg.norm(stretch)
            springs = stiffness @ (reference.joints[step] - data.qpos) ** 2 + grip * hand.stiffness * stretch @ stretch
            energies[frame] = data.energy[1] + 0.5 * springs
            peak = 0.0
        mujoco.mj_step2(model, data)
        if between == 0:
            torques[frame] = data.qfrc_actuator
            if not np.isfinite(data.qpos).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
                break
    return joints, tips, forces, peaks, stretches, torques, energies


def _smooth(
    times: Float[np.ndarray, " N"], values: Float[np.ndarray, "N K"], at: Float[np.ndarray, " S"]
) -> tuple[Float[np.ndarray, "S K"], Float[np.ndarray, "S K"]]:
    """Values and velocities between the frames: monotone cubics, which never leave the range of their neighbours."""
    from scipy.interpolate import PchipInterpolator

    if len(times) == 1:
        return np.repeat(values, len(at), axis=0), np.zeros((len(at), values.shape[1]))
    curve = PchipInterpolator(times, values, axis=0)
    return curve(at), curve.derivative()(at)


def _holding(
    grips: tuple[tuple[int, int], ...],
    frames: Float[np.ndarray, " N"],
    target: Float[np.ndarray, "N 3"],
    steps: Float[np.ndarray, " S"],
    per_frame: int,
    grip_time: float,
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3"], Bool[np.ndarray, " S"]]:
    """Firmness of the grip, the human's hand and its velocity, and the steps at which hands meet."""
    grip, met = np.zeros(len(steps)), np.zeros(len(steps), dtype=bool)
    hand, velocity = np.zeros((len(steps), 3)), np.zeros((len(steps), 3))
    for first, last in grips:
        inside = slice(first * per_frame, last * per_frame + 1)
        now = steps[inside]
        hand[inside], velocity[inside] = _smooth(frames[first : last + 1], target[first : last + 1], now)
        grip[inside] = np.clip(np.minimum(now - now[0], now[-1] - now) / max(grip_time, 1e-9), 0.0, 1.0)
        met[inside.start] = True
    return grip, hand, velocity, met


def _check(
    robot: RobotModel,
    joints: Float[np.ndarray, "N J"],
    stiffness: Float[np.ndarray, "N J"],
    target: Float[np.ndarray, "N 3"],
    rate: float,
) -> None:
    n_frames = len(joints)
    if n_frames < 1 or joints.shape != (n_frames, robot.chain.n_joints) or not np.isfinite(joints).all():
        names = ", ".join(robot.chain.joint_names)
        raise UserError(f"joints have the shape {joints.shape}; expected finite numbers for {names} in every frame")
    if stiffness.shape != joints.shape or target.shape != (n_frames, 3):
        raise UserError(
            f"stiffness and target have the shapes {stiffness.shape} and {target.shape}; "
            f"expected {joints.shape} and {(n_frames, 3)}"
        )
    if not (np.isfinite(stiffness).all() and stiffness.min() >= 0.0 and stiffness.max() <= 1.0):
        raise UserError(f"stiffness goes from {stiffness.min()} to {stiffness.max()}; valid: 0 to 1")
    if not 0.0 < rate < float("inf"):
        raise UserError(f"rate is {rate}; valid: a finite number above 0 Hz")
