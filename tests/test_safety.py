"""The safety filter: what no observation can break, what it leaves alone, and how it stops, waits and goes home."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mild_viz.checkpoint import load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.pairs import robot_truth
from mild_viz.paths import default_checkpoint
from mild_viz.pipeline import control, infer
from mild_viz.robot.control import rules
from mild_viz.robot.control.controller import ControlCarry, Controller, ControlResult, Frames, make_controller
from mild_viz.robot.control.kernels import LONGEST, RETURN_SPEED, SHORTEST
from mild_viz.robot.control.rules import DEFAULT_RULES
from mild_viz.robot.control.safety import Limits, limits_of
from mild_viz.robot.ik import forward, solve_ik
from mild_viz.robot.model import load_robot
from mild_viz.settings import CONTROLLERS, ControlSettings, Watch
from tests.controllers import RATE, cut, frames, unhindered

ROBOT = load_robot("pepper")
CHAIN, SPEC = ROBOT.chain, ROBOT.spec.safety
LIMITS = limits_of(CHAIN, SPEC)
STATES = 3
HOME = forward(CHAIN, LIMITS.rest[None])


def controller(name: str = "mild", action: str = "handshake", **changes: object) -> Controller:
    chosen = replace(ControlSettings(controller=name, contact_states=frozenset({1}), smoothing=1.0), **changes)
    return make_controller(ROBOT, chosen, DEFAULT_RULES[action], STATES, RATE)


def steps(seconds: np.ndarray) -> list[float]:
    """The time [s] that each command has for its move; 0 where it is a repetition."""
    waited, result = 0.0, []
    for passed in seconds:
        waited += passed if 0.0 < passed < np.inf else 0.0
        dt = min(waited, LONGEST)
        result.append(dt if dt >= SHORTEST else 0.0)
        waited = 0.0 if dt >= SHORTEST else waited
    return result


def check_limits(used: Controller, given: Frames, result: ControlResult) -> None:
    """Positions exactly, velocities and accelerations to rounding, and room to stop from wherever it is."""
    limits = used.limits
    assert np.isfinite(result.joints).all() and np.isfinite(result.stiffness).all()
    assert (result.joints >= limits.lower).all() and (result.joints <= limits.upper).all()
    previous, before = limits.rest, np.zeros(CHAIN.n_joints)
    for joints, dt in zip(result.joints, steps(given.seconds), strict=True):
        if dt == 0.0:
            np.testing.assert_array_equal(joints, previous)
            continue
        velocity = (joints - previous) / dt
        assert (np.abs(velocity) <= limits.velocity + 1e-8).all()
        assert (np.abs(velocity - before) <= limits.acceleration * dt + 1e-8).all()
        stop = joints + velocity * np.abs(velocity) / (2.0 * limits.acceleration)
        assert (stop >= limits.lower - 1e-8).all() and (stop <= limits.upper + 1e-8).all()
        previous, before = joints, velocity
    stiffness = np.concatenate([[1.0], result.stiffness[:, 0]])
    allowed = np.minimum(np.where(np.isfinite(given.seconds), np.maximum(given.seconds, 0.0), 0.0), LONGEST)
    assert (stiffness[1:] >= used.rules.stiffness).all() and (stiffness <= 1.0).all()
    assert (-np.diff(stiffness) <= used.rules.stiffness_fall * allowed + 1e-12).all()
    assert (np.diff(stiffness) <= used.rules.stiffness_rise * allowed + 1e-12).all()


numbers = st.one_of(
    st.floats(-4.0, 4.0), st.floats(-0.1, 0.1), st.floats(), st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e160])
)
times = st.one_of(st.floats(0.0, 0.1), st.just(1.0 / RATE), st.floats(), st.sampled_from([1e-9, 5e-4, 3.0, -1.0]))


@st.composite
def anything(draw: st.DrawFn) -> Frames:
    """Observations and predictions as nobody should send them."""
    n = draw(st.integers(1, 25))

    def array(*shape: int) -> np.ndarray:
        size = int(np.prod(shape))
        return np.array(draw(st.lists(numbers, min_size=size, max_size=size)), dtype=float).reshape(shape)

    return Frames(
        log_alpha=array(n, STATES),
        log_transition=array(n),
        decoded=array(n, CHAIN.n_joints),
        targets=array(n, 3),
        tracked=np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n))),
        seconds=np.array(draw(st.lists(times, min_size=n, max_size=n))),
    )


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(anything(), st.sampled_from(CONTROLLERS), st.sampled_from([1.0, 0.3]))
def test_nothing_breaks_the_limits(given: Frames, name: str, smoothing: float) -> None:
    used = controller(name, smoothing=smoothing)
    check_limits(used, given, used.run(given, used.start()))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(CONTROLLERS))
def test_long_wild_motions_keep_the_limits_too(seed: int, name: str) -> None:
    """From limit to limit at irregular times, with gaps: where the arm is fast, and everything is in the way."""
    rng = np.random.default_rng(seed)
    n = 300
    held = np.repeat(rng.uniform(-3.0, 3.0, (n // 6, 4)), 6, axis=0)
    decoded = np.where(rng.random((n, 1)) < 0.5, held, rng.uniform(-3.0, 3.0, (n, 4)))
    decoded[rng.random(n) < 0.02] = np.nan
    targets = HOME + rng.normal(scale=0.3, size=(n, 3))
    targets[rng.random(n) < 0.2] = np.nan
    log_alpha = np.log(rng.dirichlet(np.ones(STATES), size=n))
    seconds = rng.choice([0.0, 2e-4, 0.002, 1 / 60, 1 / 30, 0.15, 0.7], size=n)
    used, given = controller(name), frames(log_alpha, decoded, targets, seconds=seconds)
    result = used.run(given, used.start())
    check_limits(used, given, result)
    # to the bit the same, observation by observation
    carry = used.start()
    for k in range(0, n, 7):
        part = used.run(cut(given, slice(k, k + 7)), carry)
        carry = part.carry
        np.testing.assert_array_equal(part.joints, result.joints[k : k + 7])
        np.testing.assert_array_equal(part.fired, result.fired[k : k + 7])
    for name in ControlCarry._fields:
        np.testing.assert_array_equal(getattr(carry, name), getattr(result.carry, name))
    # what it made of the motion is within the limits, and passes as it is
    again = frames(log_alpha, result.joints, np.repeat(HOME, n, axis=0), seconds=seconds)
    if name == "mild":
        np.testing.assert_array_equal(used.run(again, used.start()).joints, result.joints)


def test_a_slow_trial_is_the_smoothed_prediction_to_the_bit() -> None:
    """A recorded handshake at a third of its speed, approached from rest."""
    trial = next(trial for trial in load_dataset("demo").test if trial.action == "handshake")
    motion = robot_truth(trial, CHAIN.joint_names)
    motion = np.clip(motion[np.isfinite(motion).all(1)], LIMITS.lower, LIMITS.upper)
    times = np.linspace(0.0, len(motion) - 1.0, 3 * len(motion))
    slow = np.stack([np.interp(times, np.arange(len(motion)), column) for column in motion.T], axis=1)
    approach = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 60))[:, None]
    slow = np.concatenate([LIMITS.rest + approach * (slow[0] - LIMITS.rest), slow])
    expected = [slow[0]]
    for row in slow[1:]:
        expected.append(0.8 * row + (1.0 - 0.8) * expected[-1])
    used = controller(smoothing=0.8)
    result = used.run(still(slow), used.start())
    np.testing.assert_array_equal(result.joints, expected)
    safety = sum(1 << number for number, rule in enumerate(rules.RULES) if rule.safety)
    assert not (result.fired & safety).any() and np.ptp(result.joints, axis=0).max() > 0.7


def still(decoded: np.ndarray, seconds: np.ndarray | None = None) -> Frames:
    """Wanted joints while the human stands there, in a state without contact."""
    n = len(decoded)
    log_alpha = np.log(np.tile([0.98, 0.01, 0.01], (n, 1)))
    return frames(log_alpha, decoded, np.repeat(HOME, n, axis=0), seconds=seconds)


@pytest.mark.parametrize("dt", [0.002, 1 / 60, 1 / 30])
@pytest.mark.parametrize("far", [-0.02, -0.3, -2.5])
def test_a_step_is_followed_in_nearly_the_shortest_time_and_without_overshoot(dt: float, far: float) -> None:
    """Shortest: bang-bang, 2 sqrt(d / a), or d / v + v / a where the largest velocity v is reached."""
    velocity, acceleration = LIMITS.velocity[0], LIMITS.acceleration[0]
    goal = LIMITS.rest + np.array([far, 0.0, 0.0, 0.0])
    used = controller()
    result = used.run(still(np.tile(goal, (2000, 1)), np.full(2000, dt)), used.start())
    path = result.joints[:, 0] - LIMITS.rest[0]
    assert np.diff(path).max() <= 0.0 and path.min() >= far - 1e-15
    assert path[-1] == pytest.approx(far, abs=1e-12)
    distance, top = abs(far), velocity**2 / acceleration
    shortest = 2 * np.sqrt(distance / acceleration) if distance < top else distance / velocity + velocity / acceleration
    arrived = dt * (np.argmax(np.abs(path - far) < 1e-3) + 1)
    assert arrived <= shortest + 3.5 * dt
    np.testing.assert_array_equal(result.joints[:, 1:], np.tile(LIMITS.rest[1:], (2000, 1)))


def test_it_brakes_before_a_limit_whatever_the_times() -> None:
    """At full speed towards a point beyond the limit, then frames that get shorter and shorter."""
    goal = np.tile(LIMITS.rest - np.array([6.0, 0, 0, 0]), (400, 1))
    seconds = np.concatenate([np.full(12, 1 / 30), np.geomspace(1 / 30, 0.0012, 388)])
    used = controller()
    given = still(goal, seconds)
    result = used.run(given, used.start())
    check_limits(used, given, result)
    assert result.joints[-1, 0] == pytest.approx(LIMITS.lower[0], abs=1e-4)
    assert ((result.fired >> rules.MARGIN) & 1).any() and ((result.fired >> rules.VELOCITY) & 1).any()
    assert ((result.fired >> rules.ACCELERATION) & 1)[:2].all()


def test_base_ik_near_full_stretch_no_longer_leaps() -> None:
    """A rocket, whose hand comes and goes at the border of the reach: plain solutions leap, the command does not."""
    model, trial = load_checkpoint(default_checkpoint("demo")), load_dataset("demo").test[10]
    rollout = control(infer(model, trial, "v3.1"), model, ROBOT, trial, ControlSettings(controller="base-ik"))
    n = len(rollout.target)
    free = unhindered(CHAIN, ControlSettings(controller="base-ik"), "rocket", 3)
    given = frames(np.zeros((n, 3)), np.tile(CHAIN.rest, (n, 1)), rollout.target)
    leaping, last = [], np.array(CHAIN.rest)
    for target in rollout.target:  # without the pull to the last command
        last = solve_ik(CHAIN, target[None], last[None], 1.0, 0.0)[0] if np.isfinite(target).all() else last
        leaping.append(last)
    assert np.abs(np.diff(leaping, axis=0)).max() > 0.6
    pulled = free.run(given, free.start()).joints
    assert np.abs(np.diff(pulled, axis=0)).max() < 0.31
    allowed = LIMITS.velocity / trial.rate
    assert (np.abs(np.diff(rollout.joints_commanded, axis=0)) <= allowed + 1e-9).all() and allowed.max() < 0.31
    lag = rollout.hand_distance - np.linalg.norm(forward(CHAIN, pulled) - rollout.target, axis=1)
    assert np.median(lag) < 0.002 and lag[20:].max() < 0.01


# what is seen of the human


def missed(n_before: int, n_missed: int, n_after: int) -> Frames:
    """A slow motion during which the human is not seen for a while; the model goes on as if nothing was."""
    n = n_before + n_missed + n_after
    wave = LIMITS.rest + np.sin(np.arange(n) / 15.0)[:, None] * np.array([-0.4, 0, 0.4, 0.3])
    given = still(wave)
    tracked = given.tracked.copy()
    tracked[n_before : n_before + n_missed] = False
    return given._replace(tracked=tracked)


def fired(result: ControlResult, number: int) -> np.ndarray:
    return np.flatnonzero((result.fired >> number) & 1)


def test_a_lost_human_makes_it_stop_and_then_go_home() -> None:
    used, given = controller(watch=Watch(gone_after=1.49)), missed(50, 150, 60)
    result = used.run(given, used.start())
    check_limits(used, given, result)
    np.testing.assert_array_equal(fired(result, rules.MISSING), np.arange(50, 200))
    # 0.25 s are bridged, 7 frames at 30 Hz; 1.49 s after the last sight, with the 45th frame, it goes home
    np.testing.assert_array_equal(fired(result, rules.STALE), np.arange(57, 94))
    np.testing.assert_array_equal(fired(result, rules.GONE), np.arange(94, 200))
    np.testing.assert_array_equal(result.joints[10:57], given.decoded[10:57])
    moved = np.abs(np.diff(result.joints, axis=0)).max(1)
    assert (moved[60:93] == 0.0).all()
    homeward = moved[93:198] * RATE
    assert 0.9 * RETURN_SPEED < homeward.max() <= RETURN_SPEED + 1e-9
    np.testing.assert_allclose(result.joints[199], LIMITS.rest, atol=1e-9)
    np.testing.assert_allclose(result.joints[230:], given.decoded[230:])  # caught up with


def test_whoever_comes_next_begins_anew() -> None:
    """After contact, with no way back into reaching: when the human was gone, reaching is reaching again."""
    given, used = missed(50, 80, 40), controller()
    log_alpha = given.log_alpha.copy()
    log_alpha[20:50] = np.log([0.01, 0.98, 0.01])
    given = given._replace(log_alpha=log_alpha)
    for gone, stiff in ((80, 1.0), (20, None)):
        tracked = given.tracked.copy()
        tracked[50 + gone : 130] = True
        result = used.run(given._replace(tracked=tracked), used.start())
        assert result.stiffness[49, 0] == used.rules.stiffness
        blocked = fired(result, rules.NO_RETURN)
        assert bool(len(blocked[blocked >= 130])) == (stiff is None)
        assert not result.contact[tracked & (np.arange(170) >= 50)].any()


def test_a_hand_that_leaps_is_not_followed() -> None:
    given = missed(90, 0, 0)
    targets = given.targets.copy()
    targets[40:43] += [0.0, 2.0, 0.0]  # 2 m in 1/30 s, then back
    used = controller()
    result = used.run(given._replace(targets=targets), used.start())
    np.testing.assert_array_equal(fired(result, rules.JUMPED), [40, 41, 42])
    np.testing.assert_array_equal(result.joints[10:40], given.decoded[10:40])
    np.testing.assert_array_equal(result.joints[42], result.joints[41])  # it has stopped
    np.testing.assert_allclose(result.joints[60:], given.decoded[60:])
    # who stays there is believed as soon as a hand can have got there: 2 m at 15 m/s
    targets[40:] = HOME + [0.0, 2.0, 0.0]
    stays = used.run(given._replace(targets=targets), used.start())
    np.testing.assert_array_equal(fired(stays, rules.JUMPED), [40, 41, 42])


def test_numbers_that_are_none_stop_it() -> None:
    given, used = missed(60, 0, 0), controller("mild-ik")
    decoded, log_alpha = given.decoded.copy(), given.log_alpha.copy()
    decoded[30:32, 2], log_alpha[40, 0], log_alpha[41], log_alpha[42, 1] = np.nan, np.nan, -np.inf, np.inf
    result = used.run(given._replace(decoded=decoded, log_alpha=log_alpha), used.start())
    np.testing.assert_array_equal(fired(result, rules.INVALID), [30, 31, 40, 41, 42])
    check_limits(used, given, result)
    base = controller("base-ik")  # needs no decoded joints
    np.testing.assert_array_equal(
        fired(base.run(given._replace(decoded=decoded), base.start()), rules.INVALID), np.array([], dtype=int)
    )


def test_idle_is_a_frame_without_an_observation() -> None:
    used, given = controller(), missed(50, 0, 0)
    carry = used.run(given, used.start()).carry
    path, waited = [carry.joints], 0.0
    for _ in range(240):
        result = used.idle(carry, 1 / 60)
        carry, waited = result.carry, waited + 1 / 60
        assert carry.age == pytest.approx(waited)
        path.append(result.joints[0])
    assert rules.fired_rules(int(result.fired[0]))[-1].name == "gone"
    np.testing.assert_allclose(path[-1], LIMITS.rest, atol=1e-9)
    moved = np.abs(np.diff(path, axis=0)).max(1) * 60.0
    assert (moved[2:89] == 0.0).all() and moved[90:].max() <= RETURN_SPEED + 1e-9


# the limits themselves


def test_limits_are_the_descriptions_less_a_margin() -> None:
    np.testing.assert_allclose(LIMITS.velocity, [7.33998, 9.22756, 7.33998, 9.22756])
    np.testing.assert_allclose(LIMITS.acceleration, 10.0 * LIMITS.velocity)
    np.testing.assert_allclose(LIMITS.lower, CHAIN.lower + SPEC.margin)
    np.testing.assert_allclose(LIMITS.upper, CHAIN.upper - SPEC.margin)
    near = limits_of(replace(CHAIN, rest=CHAIN.lower, velocity=np.full(4, np.inf)), SPEC)
    np.testing.assert_array_equal(near.lower, CHAIN.lower)  # the robot rests there
    np.testing.assert_array_equal(near.velocity, np.full(4, 3.14))
    np.testing.assert_array_equal(limits_of(CHAIN, replace(SPEC, acceleration=5.0)).acceleration, np.full(4, 5.0))
    narrow = limits_of(replace(CHAIN, lower=CHAIN.rest - 0.01, upper=CHAIN.rest + 0.01), SPEC)
    np.testing.assert_allclose(narrow.upper - narrow.lower, 0.01)


def test_limits_that_limit_nothing_are_refused() -> None:
    four = np.ones(4)
    for velocity in (0.0 * four, -four, np.nan * four, np.inf * four):
        with pytest.raises(UserError, match="velocity is .*; valid: a finite number above 0"):
            Limits(-four, four, velocity, four, 0 * four)
    with pytest.raises(UserError, match="rest is"):
        Limits(-four, four, four, four, 2 * four)


def test_watch_refuses_nonsense() -> None:
    with pytest.raises(UserError, match="max_age is 0.0; valid: a finite number above 0"):
        Watch(max_age=0.0)
    with pytest.raises(UserError, match="max_speed is nan"):
        Watch(max_speed=float("nan"))
    with pytest.raises(UserError, match="gone_after is 0.1; valid: max_age, 0.25, or more"):
        Watch(gone_after=0.1)
