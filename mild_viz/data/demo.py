"""The built-in demo set: people who wave, shake hands and bump fists, generated from a seed.

Nothing here is recorded. Bodies, timing and amplitudes are drawn so that the numbers resemble a depth camera's
recordings of the same four interactions; what the tracker would add (noise, lost frames) is added last.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mild_viz.data.demo_body import DEMO_BONES, DEMO_JOINTS, Person, body_joints, make_person
from mild_viz.data.demo_motion import RATE, Script, write_script
from mild_viz.data.skeletons import ARM_JOINTS, joint_indices, person_frame, to_frame, to_world
from mild_viz.trial import Dataset, Skeleton, Trial

VERSION = 1
"""Raise it with every change that alters a number: the data's checksum is taken from it and the seed."""

DEMO_ACTIONS = ("wave", "handshake", "rocket", "parachute")

STATURES = np.linspace(1.56, 1.89, 10)
"""Statures of the cast [m], before up to 1 cm of variation."""

DYADS = {
    "train": ((0, 5), (2, 7), (3, 9), (0, 3), (5, 9), (2, 5), (3, 7), (0, 2)),
    "test": ((1, 6), (4, 8)),
}
"""Who meets whom (index into the cast). Nobody of the test split is seen in training."""

LONGEST_GAP = 8
"""Frames for which tracking is lost at most."""


@dataclass(frozen=True)
class Take:
    """One performance as it truly was, before a tracker saw it."""

    action: str
    people: tuple[Person, Person]
    script: Script
    joints: tuple[Float[np.ndarray, "T 20 3"], Float[np.ndarray, "T 20 3"]]
    """`DEMO_JOINTS` of the human and of the partner, in world [m]."""
    touching: tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]
    """The point of each right hand that touches (palm or knuckles), in world [m]."""


def make_cast(seed: int) -> tuple[Person, ...]:
    """The people of the demo set, from short to tall."""
    rng = np.random.default_rng([seed, VERSION])
    return tuple(make_person(rng, float(stature + rng.uniform(-0.01, 0.01))) for stature in STATURES)


def make_takes(seed: int, split: str) -> list[Take]:
    """All performances of a split: every dyad does every action twice, each being the human once."""
    cast = make_cast(seed)
    takes = []
    for a, action in enumerate(DEMO_ACTIONS):
        for d, (first, second) in enumerate(DYADS[split]):
            for swapped in (False, True):
                people = (cast[second], cast[first]) if swapped else (cast[first], cast[second])
                # A stream of its own for each take: one changed script leaves all others as they were.
                rng = np.random.default_rng([seed, VERSION, len(split), a, d, swapped])
                takes.append(perform(rng, action, people))
    return takes


def perform(rng: np.random.Generator, action: str, people: tuple[Person, Person]) -> Take:
    """Draw a script and let both bodies play it."""
    script = write_script(rng, action, people)
    joints, touching = [], []
    for person, stance, arm in zip(people, script.stances, script.arms, strict=True):
        body, hand = body_joints(rng, person, script.times, arm)
        joints.append(to_world(stance.pose(), body))
        touching.append(to_world(stance.pose(), hand))
    return Take(action, people, script, (joints[0], joints[1]), (touching[0], touching[1]))


CORRELATED = 0.0035
"""Standard deviation per axis of slow tracking error of an arm joint [m], so about 6 mm in space."""
WHITE = 0.0012
"""Standard deviation per axis of an arm joint's error that is new in every frame [m], so about 2 mm in space."""
MEMORY = 0.25
"""Time constant of the slow error [s]."""


def joint_noise(rng: np.random.Generator, n_frames: int) -> Float[np.ndarray, "T 2 20 3"]:
    """Tracking error of all `DEMO_JOINTS` of both people [m]; arms err most, the trunk least."""
    level = np.array([1.0 if "elbow" in j or "wrist" in j else 0.7 if "shoulder" in j else 0.45 for j in DEMO_JOINTS])
    level = level[:, None] * rng.uniform(0.8, 1.2, (2, 1, 1))
    slow, white = rng.standard_normal((2, n_frames, 2, len(DEMO_JOINTS), 3))
    keep = np.exp(-1 / (RATE * MEMORY))
    slow[1:] *= np.sqrt(1 - keep**2)
    for n in range(1, n_frames):
        slow[n] += keep * slow[n - 1]
    noise = level * (CORRELATED * slow + WHITE * white)
    # A tracker places the hand on the wrist it found, and it knows one collar only.
    for side in ("left", "right"):
        hand, wrist = joint_indices(DEMO_JOINTS, (f"{side}_hand", f"{side}_wrist"))
        noise[:, :, hand] = noise[:, :, wrist] + 0.4 * noise[:, :, hand]
    left, right = joint_indices(DEMO_JOINTS, ("left_collar", "right_collar"))
    noise[:, :, left] = noise[:, :, right]
    return noise


def lose_frames(rng: np.random.Generator, positions: Float[np.ndarray, "T 20 3"]) -> None:
    """Set short stretches to NaN, in place: in some trials the right arm or the whole body is lost for a moment."""
    n_gaps = int(rng.choice(3, p=[0.60, 0.28, 0.12]))
    arm = joint_indices(DEMO_JOINTS, ("right_elbow", "right_wrist", "right_hand"))
    # One gap per part of the trial, well inside it, so that gaps never join or touch the first frame.
    parts = np.linspace(10, len(positions) - 10, n_gaps + 1).astype(int)
    for low, high in zip(parts[:-1], parts[1:], strict=True):
        length = int(rng.integers(1, LONGEST_GAP + 1))
        begin = int(rng.integers(low, high - LONGEST_GAP - 2))
        lost = arm if rng.uniform() < 0.7 else slice(None)
        positions[begin : begin + length, lost] = np.nan


def track(rng: np.random.Generator, seen: Float[np.ndarray, "T 20 3"]) -> tuple[Skeleton, Float[np.ndarray, "4 4"]]:
    """The tracked joints of one person [m, world] in that person's own frame, with lost frames, and T_world_person."""
    wanted = joint_indices(DEMO_JOINTS, ("left_shoulder", "right_shoulder", "waist", "right_collar"))
    T_world_person = person_frame(*seen[0, wanted])
    positions = to_frame(T_world_person, seen)
    lose_frames(rng, positions)
    return Skeleton(DEMO_JOINTS, DEMO_BONES, positions), T_world_person


def make_demo(seed: int = 0) -> Dataset:
    """Generate the demo set: 16 training and 4 test trials of each action, 30 Hz, the same for the same seed.

    Everyone's positions are in the own frame of their first frame, as in NuiSI; `T_world_human` and
    `T_world_partner` put both into one world frame (origin on the floor between them, human looking along x).

    `Trial.phase` is the human's: rest until the hand leaves, reach until the hands meet, contact until they part,
    return until it hangs again, rest. In a wave, contact is the waving proper: from the first swing to the last.
    """
    splits: dict[str, list[Trial]] = {"train": [], "test": []}
    arm = joint_indices(DEMO_JOINTS, ARM_JOINTS)
    for split, trials in splits.items():
        for index, take in enumerate(make_takes(seed, split)):
            rng = np.random.default_rng([seed, VERSION, len(split), index])
            noise = joint_noise(rng, len(take.script.times))
            human, T_world_human = track(rng, take.joints[0] + noise[:, 0])
            partner, T_world_partner = track(rng, take.joints[1] + noise[:, 1])
            trials.append(
                Trial(
                    dataset="demo",
                    split=split,
                    index=index,
                    action=take.action,
                    rate=RATE,
                    human_arm=human.positions[:, arm],
                    partner_arm=partner.positions[:, arm],
                    human_skeleton=human,
                    partner_skeleton=partner,
                    T_world_human=T_world_human,
                    T_world_partner=T_world_partner,
                    phase=take.script.phase,
                )
            )
    return Dataset(
        name="demo",
        title="Built-in demo: generated people who wave, shake hands and bump fists",
        train=tuple(splits["train"]),
        test=tuple(splits["test"]),
        checksum=hashlib.sha256(f"mild_viz demo set, version {VERSION}, seed {seed}".encode()).hexdigest(),
    )
