"""Controllers for tests: one that nothing holds back, so that what is asked of it is seen as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mild_viz.robot.chain import ArmChain
from mild_viz.robot.control.controller import Controller, Frames
from mild_viz.robot.control.rules import DEFAULT_RULES
from mild_viz.robot.control.safety import Limits
from mild_viz.robot.spec import StiffnessSpec
from mild_viz.settings import ControlSettings, Watch

RATE = 30.0
LOW = DEFAULT_RULES["handshake"].stiffness
"""Stiffness in the contact of a handshake."""


def wide_limits(chain: ArmChain) -> Limits:
    """The joint limits alone: any speed is admitted."""
    anything = np.full(chain.n_joints, 1e9)
    return Limits(np.array(chain.lower), np.array(chain.upper), anything, 1e12 * anything, np.array(chain.rest))


def unhindered(chain: ArmChain, settings: ControlSettings, action: str, n_states: int) -> Controller:
    """The rules of an action, with nothing that takes time: no rates, and nobody is ever gone."""
    rules = replace(DEFAULT_RULES[action], stiffness_fall=1e3, stiffness_rise=1e3)
    settings = replace(settings, watch=Watch(1e9, 1e9, 1e9))
    return Controller(chain, settings, rules, n_states, RATE, wide_limits(chain), StiffnessSpec(rate=1e3))


def frames(
    log_alpha: np.ndarray,
    decoded: np.ndarray,
    targets: np.ndarray,
    log_transition: np.ndarray | None = None,
    seconds: np.ndarray | None = None,
) -> Frames:
    """Frames at 30 Hz, tracked wherever there is a target."""
    n = len(decoded)
    return Frames(
        log_alpha=log_alpha,
        log_transition=np.full(n, -np.inf) if log_transition is None else log_transition,
        decoded=decoded,
        targets=targets,
        tracked=np.asarray(np.isfinite(targets).all(axis=1)),
        seconds=np.full(n, 1.0 / RATE) if seconds is None else seconds,
    )


def cut(whole: Frames, rows: slice) -> Frames:
    """Some of the frames."""
    return Frames(*(array[rows] for array in whole))
