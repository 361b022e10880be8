"""The simulated arm against closed forms and conservation laws, and what the stiffness schedule does to a handshake."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mild_viz.errors import UserError
from mild_viz.robot.kinematics.kernels import kinematics_batch
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.run_options import RunOptions
from mild_viz.simulation.compare import SCENARIOS, Comparison, compare
from mild_viz.simulation.grip import find_grips
from mild_viz.simulation.model import efforts
from mild_viz.simulation.motion import CompliantMotion
from mild_viz.simulation.settings import HumanHand, Impedance
from mild_viz.simulation.simulate import simulate

RATE = 50.0
ROTOR, INERTIA, EFFORT, RADIUS = 0.02, 0.08, 20.0, 0.5
STIFFNESS = EFFORT / 0.5  # with the saturation below [N m/rad]
SOFT = Impedance(saturation=0.5)

ONE_JOINT = f"""<robot name="one"><link name="base"/><link name="bar">
<inertial><origin xyz="0 0 0"/><mass value="2"/>
<inertia ixx="0.05" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="{INERTIA - ROTOR}"/></inertial></link><link name="tip"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="bar"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="{EFFORT}" velocity="10"/></joint>
<joint name="hold" type="fixed"><parent link="bar"/><child link="tip"/><origin xyz="{RADIUS} 0 0"/></joint></robot>"""

ONE_JOINT_SPEC = f"""title = "One"
description = "one.urdf"
arms.only = {{ joints = ["turn"], end_effector = "tip" }}
dynamics.rotor_inertia = {ROTOR}"""


@pytest.fixture(scope="module")
def one_joint(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    """A bar that turns about a vertical axis through its centre of mass: one inertia, and no weight to carry."""
    folder = tmp_path_factory.mktemp("one")
    (folder / "one.urdf").write_text(ONE_JOINT, encoding="utf-8")
    (folder / "robot.toml").write_text(ONE_JOINT_SPEC, encoding="utf-8")
    return load_robot(str(folder))


@pytest.fixture(scope="module")
def pepper() -> RobotModel:
    return load_robot("pepper")


def hold(
    robot: RobotModel, posture: list[float], seconds: float, scale: float = 1.0, **more: object
) -> CompliantMotion:
    """A command that stands still, without contact unless grips are given."""
    n = int(seconds * RATE) + 1
    commands = np.tile(posture, (n, 1))
    settings: dict = {"target": np.full((n, 3), np.nan)} | more
    return simulate(robot, commands, np.full_like(commands, scale), rate=RATE, **settings)


def closed_form(time: np.ndarray, stiffness: float, ratio: float) -> np.ndarray:
    """x(t) of I x'' + 2 ratio sqrt(K I) x' + K x = 0 from x = 1 at rest."""
    omega = np.sqrt(stiffness / INERTIA)
    if ratio == 1.0:
        return (1.0 + omega * time) * np.exp(-omega * time)
    swing = omega * np.sqrt(1.0 - ratio**2)
    return np.exp(-ratio * omega * time) * (
        np.cos(swing * time) + ratio * omega / swing * np.sin(swing * time)
    )  # fmt: skip


@pytest.mark.parametrize("ratio", [1.0, 0.3])
@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_one_joint_answers_as_the_closed_form(one_joint: RobotModel, ratio: float, scale: float) -> None:
    """Error below 1 % of the step at 1 ms, and of first order: half of it at half the timestep."""
    errors = []
    for timestep in (1e-3, 0.5e-3):
        impedance = replace(SOFT, damping_ratio=ratio, timestep=timestep)
        motion = hold(one_joint, [0.0], 1.5, scale, impedance=impedance, start=np.array([0.3]))
        exact = 0.3 * closed_form(motion.time, scale * STIFFNESS, ratio)
        errors.append(np.abs(motion.joints[:, 0] - exact).max())
    assert 0.0 < errors[0] < 0.01 * 0.3
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.1)


def test_torque_never_exceeds_the_effort(one_joint: RobotModel) -> None:
    """Far from its command, the joint accelerates with its whole effort: x = x0 - effort / I t^2 / 2."""
    motion = hold(one_joint, [0.0], 0.4, impedance=replace(SOFT, damping_ratio=0.0), start=np.array([2.5]))
    assert np.abs(motion.torques).max() == EFFORT
    early = motion.time < 0.12
    assert np.allclose(motion.joints[early, 0], 2.5 - 0.5 * EFFORT / INERTIA * motion.time[early] ** 2, atol=0.02)


def test_deflection_under_a_steady_pull_balances_torques(pepper: RobotModel) -> None:
    """At rest, s K (q - q*) = J(q)^T F in every joint: the springs of the joints carry the human's pull."""
    posture, n, scale = [0.3, -0.4, 0.6, 0.8], 201, 0.4
    target = np.tile(pepper.end_effector(np.array([posture])), (n, 1))
    target[:, 0] += 0.03 * np.clip(np.arange(n) / RATE - 0.5, 0.0, 1.0)
    motion = hold(pepper, posture, 4.0, scale, target=target, grips=((5, 200),))
    row = 180  # 1.6 s after the pull stopped growing, before the grip opens
    jacobian = kinematics_batch(pepper.chain.arm, motion.joints[row : row + 1])[1][0]
    spring = scale * efforts(pepper) / Impedance().saturation * (motion.joints[row] - posture)
    assert np.linalg.norm(motion.hand_force[row]) > 1.5
    assert np.allclose(spring, jacobian @ motion.hand_force[row], atol=1e-4)
    assert motion.human_displacement[row] == pytest.approx(
        np.linalg.norm(motion.hand_force[row]) / HumanHand().stiffness, rel=1e-3
    )


def test_energy_is_never_created(pepper: RobotModel) -> None:
    """Released away from its command, and pulled by a hand that stands still, the arm only loses energy."""
    posture, n = [0.3, -0.4, 0.6, 0.8], 101
    start = np.array(posture) + [0.04, -0.03, 0.05, 0.03]
    free = hold(pepper, posture, 2.0, start=start, impedance=Impedance(damping_ratio=0.2))
    full = efforts(pepper) / Impedance().saturation
    assert free.energy[0] == pytest.approx(0.5 * full @ (start - posture) ** 2)
    assert np.all(np.diff(free.energy) < 1e-9) and free.energy[-1] < 1e-3 * free.energy[0]
    still = np.tile(pepper.end_effector(np.array([posture])), (n, 1))
    held = hold(pepper, posture, 2.0, start=start, target=still, grips=((0, n - 1),))
    gripped = held.energy[6:-6]  # while it closes and opens, the grip's firmness changes the spring
    assert np.all(np.diff(gripped) < 1e-9)


def test_gravity_compensation_holds_the_arm(pepper: RobotModel) -> None:
    posture = [0.0, -0.05, 0.0, 0.1]  # nearly straight forward, away from the limits
    held = hold(pepper, posture, 2.0)
    assert np.abs(held.joints - posture).max() < 1e-12
    assert held.torques[-1, 0] == pytest.approx(-2.2, abs=0.1)  # the motors carry the weight
    sagging = hold(pepper, posture, 3.0, impedance=Impedance(gravity_compensation=False))
    spring = efforts(pepper) / Impedance().saturation * (np.array(posture) - sagging.joints[-1])
    assert sagging.torques[-1] == pytest.approx(spring, abs=1e-3)
    assert 0.01 < sagging.displacement[-1] < 0.03  # 2.3 degrees of a 0.35 m long arm
    assert sagging.end_effector[-1, 2] < held.end_effector[-1, 2]


def test_without_inertia_lag_the_command_is_followed(pepper: RobotModel) -> None:
    """A slow motion is followed to a millimetre at full stiffness."""
    time = np.arange(201) / RATE
    commands = np.array([0.3, -0.4, 0.6, 0.8]) + 0.1 * np.sin(0.5 * np.pi * time)[:, None]
    motion = simulate(pepper, commands, np.ones_like(commands), np.full((201, 3), np.nan), RATE)
    assert motion.displacement.max() < 0.005
    assert not motion.gripped.any() and motion.force_peak.max() == 0.0
    assert motion.summary().force_peak == 0.0


def test_grips_begin_where_hands_meet_and_outlast_short_gaps() -> None:
    n = 100
    target = np.zeros((n, 3))
    hand = np.zeros((n, 3))
    hand[:, 0] = np.abs(np.arange(n) - 30) / 100.0  # nearest at 30
    contact = np.zeros(n, dtype=bool)
    contact[10:40] = contact[44:60] = True
    assert find_grips(contact, hand, target, 30.0, HumanHand()) == ((25, 59),)
    assert find_grips(contact, hand, target, 30.0, HumanHand(patience=0.0)) == ((25, 39), (44, 59))
    assert find_grips(contact, hand + [0, 1, 0], target, 30.0, HumanHand()) == ((30, 59),)  # never near: nearest
    target[50] = np.nan
    assert find_grips(contact, hand, target, 30.0, HumanHand(patience=0.0)) == ((25, 39), (44, 49), (51, 59))
    assert find_grips(np.zeros(n, dtype=bool), hand, target, 30.0, HumanHand()) == ()


@pytest.fixture(scope="module")
def handshakes() -> dict[tuple[int, str], Comparison]:
    """The demo set's test handshakes under both stiffnesses."""
    runs = {trial: RunOptions(dataset="demo", trial=trial).run() for trial in (4, 7)}
    return {
        (trial, scenario): compare(robot, rollout, scenario)
        for trial, (rollout, robot) in runs.items()
        for scenario in SCENARIOS
    }


def test_the_schedule_softens_a_handshake(handshakes: dict[tuple[int, str], Comparison]) -> None:
    for (_, scenario), comparison in handshakes.items():
        fixed, schedule = (comparison.motions[name].summary() for name in ("fixed", "schedule"))
        assert comparison.scheduled
        assert schedule.force_peak < fixed.force_peak
        assert schedule.force_rms < 0.9 * fixed.force_rms
        assert schedule.displacement_peak > fixed.displacement_peak
        assert schedule.human_displacement_peak < fixed.human_displacement_peak
        assert 2.0 < fixed.force_rms < fixed.force_peak < 60.0  # a handshake, neither a breath nor a blow
        if scenario == "human-led":
            first, last = comparison.grips[0]
            assert np.all(comparison.joints_commanded[first:last] == comparison.joints_commanded[first])


def test_no_force_jumps(handshakes: dict[tuple[int, str], Comparison]) -> None:
    for comparison in handshakes.values():
        for motion in comparison.motions.values():
            first, last = comparison.grips[0]
            assert motion.force[first] == motion.force[last] == 0.0
            assert np.abs(np.diff(motion.force)).max() < 8.0  # within a thirtieth of a second
            assert np.all(motion.force_peak >= motion.force)


def test_simulation_is_deterministic(handshakes: dict[tuple[int, str], Comparison], tmp_path: Path) -> None:
    rollout, robot = RunOptions(dataset="demo", trial=4).run()
    again, before = compare(robot, rollout), handshakes[4, "commanded"]
    for name, motion in again.motions.items():
        for field in type(motion).__dataclass_fields__:
            assert getattr(motion, field).tobytes() == getattr(before.motions[name], field).tobytes()
    again.save(tmp_path / "motion.npz")
    with np.load(tmp_path / "motion.npz") as arrays:
        assert np.array_equal(arrays["schedule_joints"], again.motions["schedule"].joints)
        assert np.array_equal(arrays["fixed_hand_force"], again.motions["fixed"].hand_force)


def test_bad_input_is_refused(pepper: RobotModel) -> None:
    good = np.zeros((5, 4))
    target = np.zeros((5, 3))
    with pytest.raises(UserError, match="stiffness goes from 1.5 to 1.5; valid: 0 to 1"):
        simulate(pepper, good, good + 1.5, target, RATE)
    with pytest.raises(UserError, match="expected finite numbers for RShoulderPitch"):
        simulate(pepper, good * np.nan, good, target, RATE)
    with pytest.raises(UserError, match="rate is 0.0"):
        simulate(pepper, good, good, target, 0.0)
    with pytest.raises(UserError, match="stiffness is -1.0; valid: a finite number above 0"):
        HumanHand(stiffness=-1.0)
    with pytest.raises(UserError, match="timestep is 0.0"):
        Impedance(timestep=0.0)
    rollout, robot = RunOptions(dataset="demo", trial=4).run()
    with pytest.raises(UserError, match="scenario 'both' is unknown; valid: commanded, human-led"):
        compare(robot, rollout, "both")
