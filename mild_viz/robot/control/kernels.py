"""Compiled control loop: contact rules, IK, smoothing, stiffness, and last the safety filter.

It works on plain float64 and int64 arrays with named slots; an arm is laid out as `kinematics.kernels` says. The typed
wrapper is `controller`. It calls `robot/kernels.py` and takes the numbers of `rules`: after a change of those, remove
__pycache__ here.
"""

import math

import numpy as np
from numba import njit

from mild_viz.robot.control import rules
from mild_viz.robot.kernels import copy_into, ik_scratch, limit_step, solve_ik_one, unreachable_one
from mild_viz.robot.kinematics.kernels import LOWER, UPPER
from mild_viz.robot.objective.kernels import plain_terms

BASE_IK, MILD, MILD_IK = 0, 1, 2
"""Controllers, in the order of `settings.CONTROLLERS`."""

FOLLOWING = 1e-3
"""Pull of base-ik to its last command, as a share of lambda_x: without, an arm leaps at the border of its reach."""

CONTROLLER, CONTACT_STATES, COMPLIANT, NO_RETURN, IK_CROSSED = 0, 1, 2, 3, 4
"""Slots of the choices, whole numbers; contact states are a bit mask."""

LAMBDA_X, LAMBDA_Q, SMOOTHING, DOUBT, FREE, SOFT, FALL, RISE, MAX_AGE, MAX_SPEED, GONE_AFTER, PERIOD = range(12)
"""Slots of the numbers."""

LOW, HIGH, VELOCITY, ACCELERATION, REST = 0, 1, 2, 3, 4
"""Rows of the limits: positions with their margin [rad], velocity [rad/s], acceleration [rad/s^2], resting joints."""

JOINTS, MOVING, DESIRED = 0, 1, 2
"""Rows of the carried motion: the last command, its velocity, the last joints before the safety filter."""

AGE, UNSEEN, PENDING, STIFFNESS = 0, 1, 2, 3
"""Slots of the carried clock: time since an observation that is usable, since one that gave the hand's place, since the
last command that moved [s]; the stiffness that was sent last."""

STARTED, PROGRESS, VISITED, GIVING = 0, 1, 2, 3
"""Slots of the carried flags: joints were wanted; how far the interaction went; bit mask of the states seen before
contact; the stiffness is to be low."""

REACHING, CROSSING, TOUCHING = 0, 1, 2
"""How far an interaction went: before contact; the transition state was entered; a contact state was active."""

FOLLOW, HOLD, RETURN = 0, 1, 2
"""What the robot does: what is wanted, stop where it is, go back to the resting posture."""

SHORTEST, LONGEST = 1e-3, 0.2
"""Commands are at least this far apart [s], else the last one is repeated; and a pause is not longer than this: however
long ago the last command was sent, the robot receives the next one at once."""

RETURN_SPEED = 1.0
"""Largest speed on the way back to rest [rad/s]: nobody is there to be met, and nobody is to be startled."""

REACHED = 1e-3
"""The human's hand counts as reached at this distance [m]; see `ik.unreachable`."""

SLACK = 1e-9
"""What is within this of a limit [rad or rad/s] passes, and fires no rule: rounding."""


@njit(cache=True, fastmath=False)
def _finite(values):
    count = 0
    for i in range(values.shape[0]):
        count += math.isfinite(values[i])
    return count == values.shape[0]


@njit(cache=True, fastmath=False)
def _argmax(values, excluded):
    """Index of the largest value whose bit is not set in `excluded`; the first one where they are equal."""
    best = -1
    for i in range(values.shape[0]):
        if (excluded >> i) & 1 == 0 and (best < 0 or values[i] > values[best]):
            best = i
    return best


@njit(cache=True, fastmath=False)
def _active(log_alpha):
    """The most likely state; -1 where this is no distribution over states."""
    for i in range(log_alpha.shape[0]):
        if not log_alpha[i] < math.inf:  # NaN, too
            return -1
    best = _argmax(log_alpha, 0)
    return best if log_alpha[best] > -math.inf else -1


@njit(cache=True, fastmath=False)
def _exceeds(log_transition, log_alpha):
    """Whether the transition state is more likely than a state, for which it leaves 1 - P(tau) (TransitionState)."""
    share = math.exp(log_transition) if log_transition <= 0.0 else 0.0  # not NaN, and no more than certain
    return share > (1.0 - share) * math.exp(log_alpha)


@njit(cache=True, fastmath=False)
def brake_speed(room, accel, dt):
    """Largest speed [rad/s] of a step of `dt` [s] after which the joint can still stop within `room` [rad] from before.

    The step takes v dt, and stopping takes less than v^2 / (2 a) afterwards, however long the steps are that follow:
    their sum is a lower sum of the integral under the falling velocity. So v dt + v^2 / (2 a) = room.
    """
    if not 0.0 < room < math.inf:
        return 0.0 if room <= 0.0 else math.inf
    change = accel * dt
    return 2.0 * accel * room / (math.sqrt(change * change + 2.0 * accel * room) + change)


@njit(cache=True, fastmath=False)
def _track(q, v, before, wanted, cap, low, high, speed, accel, dt):
    """One joint's next command, and the bits of the limits that it met.

    Follows a motion that was at `before` and is at `wanted` now. The lag behind it is caught up at the speed from which
    the joint stops at the motion, relative to it: as fast as the acceleration admits, and without overshoot where the
    motion rests. Where nothing is in the way, the command is `wanted` itself, to the bit. Never faster than `cap`.
    """
    lag, change, bits = before - q, accel * dt, 0
    exact = abs(lag) <= change * dt
    if exact:
        goal = (wanted - q) / dt
    else:
        catching = brake_speed(abs(lag), accel, dt)
        goal = (wanted - before) / dt + (catching if lag > 0.0 else -catching)
    if abs(goal) > cap:
        goal, exact = (cap if goal > 0.0 else -cap), False
    down, up = -brake_speed(q - low, accel, dt), brake_speed(high - q, accel, dt)
    if goal > up + SLACK or goal < down - SLACK or wanted < low - SLACK or wanted > high + SLACK:
        bits |= 1 << rules.MARGIN
    if abs(goal) > speed + SLACK:
        bits |= 1 << rules.VELOCITY
    limited = min(max(goal, -speed), speed)
    if abs(limited - v) > change + SLACK:
        bits |= 1 << rules.ACCELERATION
    # with what the carried velocity admits, because that always leaves a way to stop
    limited = min(max(limited, v - change), v + change)
    limited = min(max(limited, down), up)
    command = wanted if exact and abs(limited - goal) <= SLACK else q + limited * dt
    return min(max(command, low), high), bits


@njit(cache=True, fastmath=False)
def _protect(mode, wanted, limits, motion, dt, command):
    """The safety filter: the command (J,) within limits, velocity and acceleration; returns the bits that fired."""
    bits = 0
    for i in range(command.shape[0]):
        q, v = motion[JOINTS, i], motion[MOVING, i]
        low, high, speed, accel = limits[LOW, i], limits[HIGH, i], limits[VELOCITY, i], limits[ACCELERATION, i]
        if mode == FOLLOW:
            command[i], fired = _track(q, v, motion[DESIRED, i], wanted[i], math.inf, low, high, speed, accel, dt)
            bits |= fired
            motion[DESIRED, i] = wanted[i]
        elif mode == HOLD:
            slower = max(abs(v) - accel * dt, 0.0)
            command[i] = min(max(q + math.copysign(slower, v) * dt, low), high)
            motion[DESIRED, i] = command[i]
        else:
            rest = limits[REST, i]
            command[i], fired = _track(q, v, rest, rest, min(RETURN_SPEED, speed), low, high, speed, accel, dt)
            motion[DESIRED, i] = command[i]
        motion[MOVING, i] = (command[i] - q) / dt
        motion[JOINTS, i] = command[i]
    return bits


@njit(cache=True, fastmath=False)
def _watch(numbers, tracked, target, seconds, hand, clock):
    """Judge one observation: its bits, and whether it is one to go by. Moves the clock, and remembers the hand."""
    clock[AGE] += seconds
    clock[UNSEEN] += seconds
    if not tracked or not _finite(target):
        return 1 << rules.MISSING, True
    if _finite(hand):
        apart = 0.0
        for i in range(3):
            apart += (target[i] - hand[i]) ** 2
        if not math.sqrt(apart) <= numbers[MAX_SPEED] * max(clock[UNSEEN], numbers[PERIOD]):
            return 1 << rules.JUMPED, False
    copy_into(target, hand)
    clock[AGE] = clock[UNSEEN] = 0.0
    return 0, True


@njit(cache=True, fastmath=False)
def _segment(choices, active, log_alpha, log_transition, flags):
    """Move the flags on by one frame, and return its bits. Here a segment is a state that decides on the stiffness.

    It never returns to a state seen before the first contact; until a contact state was active, the transition state
    is one more candidate, and counts as contact.
    """
    bits, states = 0, choices[CONTACT_STATES]
    if (states >> active) & 1 == 1:
        flags[PROGRESS] = TOUCHING
        bits |= 1 << rules.IN_CONTACT
    elif flags[PROGRESS] == REACHING:
        flags[VISITED] |= 1 << active
        if states != 0 and _exceeds(log_transition, log_alpha[active]):
            flags[PROGRESS] = CROSSING
    flags[GIVING] = 0
    if flags[PROGRESS] != REACHING:
        segment = _argmax(log_alpha, flags[VISITED] if choices[NO_RETURN] == 1 else 0)
        if segment != active:
            bits |= 1 << rules.NO_RETURN
        if flags[PROGRESS] == CROSSING and segment >= 0 and _exceeds(log_transition, log_alpha[segment]):
            bits |= 1 << rules.CROSSED
            flags[GIVING] = 1
        elif segment >= 0 and (states >> segment) & 1 == 1:
            flags[GIVING] = 1
    return bits


@njit(cache=True, fastmath=False)
def _ramp(choices, numbers, seconds, clock, flags):
    """Move the stiffness towards what it is to be, at most at its rate; returns the bits of the rules at work."""
    giving = choices[COMPLIANT] == 1 and flags[GIVING] == 1
    goal = numbers[SOFT] if giving else numbers[FREE]
    low, high = clock[STIFFNESS] - numbers[FALL] * seconds, clock[STIFFNESS] + numbers[RISE] * seconds
    level = min(max(goal, low), high)
    clock[STIFFNESS] = goal if abs(level - goal) <= SLACK else level
    return (1 << rules.SOFT if giving else 0) | (1 << rules.RAMPING if clock[STIFFNESS] != goal else 0)


@njit(cache=True, fastmath=False)
def control_loop(
    arm, choices, numbers, limits, log_alpha, log_transition, decoded, targets, tracked, seconds,
    motion, hand, clock, flags,
):  # fmt: skip
    """Algorithm vae-HMM-test from the decoded joints on, over N frames; `motion`, `hand`, `clock`, `flags` carry over.

    Returns commands (N, J), the contact flag (N,), the stiffness (N,), and the rules that fired (N,), as bit masks.
    `seconds` (N,) is the time since the frame before. Slots: see above.
    """
    n, size = decoded.shape
    scratch, terms = ik_scratch(size), plain_terms(size)
    spare, wanted, steps, narrowed = np.empty(size), np.empty(size), np.empty(size), arm.copy()
    commands, contact, stiffness, fired = np.empty((n, size)), np.zeros(n, np.bool_), np.ones(n), np.zeros(n, np.int64)
    controller, smoothing = choices[CONTROLLER], numbers[SMOOTHING]
    for k in range(n):
        passed = seconds[k] if 0.0 < seconds[k] < math.inf else 0.0
        target, active = targets[k], _active(log_alpha[k])
        bits, plausible = _watch(numbers, tracked[k], target, passed, hand, clock)
        clock[PENDING] += passed
        dt = min(clock[PENDING], LONGEST)
        gone = clock[AGE] > numbers[GONE_AFTER]
        if active >= 0 and not gone:
            bits |= _segment(choices, active, log_alpha[k], log_transition[k], flags)
            contact[k] = (choices[CONTACT_STATES] >> active) & 1 == 1

        mode = FOLLOW
        if gone:  # whoever comes next begins anew
            mode, bits = RETURN, bits | (1 << rules.GONE)
            flags[PROGRESS], flags[VISITED], flags[GIVING] = REACHING, 0, 0
        elif clock[AGE] > numbers[MAX_AGE]:
            mode, bits = HOLD, bits | (1 << rules.STALE)
        elif not plausible:
            mode = HOLD
        elif active < 0 or (controller != BASE_IK and not _finite(decoded[k])):
            mode, bits = HOLD, bits | (1 << rules.INVALID if tracked[k] else 0)

        if mode == FOLLOW:
            crossed = choices[IK_CROSSED] == 1 and flags[PROGRESS] != REACHING
            doubt = choices[CONTACT_STATES] != 0 and math.exp(log_alpha[k, active]) < numbers[DOUBT]
            adapt = controller == BASE_IK or (controller == MILD_IK and (contact[k] or crossed or doubt))
            prior, weight = decoded[k], numbers[LAMBDA_Q]
            if controller == BASE_IK:
                prior, weight = motion[JOINTS], FOLLOWING * numbers[LAMBDA_X]
            if adapt and _finite(target):
                for i in range(size):
                    steps[i] = limits[VELOCITY, i] * dt
                limit_step(arm, motion[JOINTS], steps, narrowed)
                solve_ik_one(narrowed, target, prior, numbers[LAMBDA_X], weight, terms, -1.0, wanted, scratch)
                bits |= 1 << rules.BY_IK
                if controller == MILD_IK and doubt and not (contact[k] or crossed):
                    bits |= 1 << rules.IN_DOUBT
                if unreachable_one(arm, target, wanted, REACHED, spare, scratch):
                    bits |= 1 << rules.OUT_OF_REACH
            else:
                copy_into(prior, wanted)
            if not _finite(wanted):  # numbers so large that the solver could not work with them
                mode, bits = HOLD, bits | (1 << rules.INVALID)
        if mode == FOLLOW:
            for i in range(size):
                inside = min(max(wanted[i], arm[i, LOWER]), arm[i, UPPER])
                if flags[STARTED] == 1:
                    inside = smoothing * inside + (1.0 - smoothing) * motion[DESIRED, i]
                wanted[i] = min(max(inside, arm[i, LOWER]), arm[i, UPPER])
            flags[STARTED] = 1

        if dt < SHORTEST:
            copy_into(motion[JOINTS], commands[k])
        else:
            clock[PENDING] = 0.0
            bits |= _protect(mode, wanted, limits, motion, dt, commands[k])
        stiffness_bits = _ramp(choices, numbers, min(passed, LONGEST), clock, flags)
        stiffness[k], fired[k] = clock[STIFFNESS], bits | stiffness_bits
    return commands, contact, stiffness, fired
