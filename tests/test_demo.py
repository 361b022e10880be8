"""The built-in demo set: bodies, meetings, phases, tracking faults, and the shape of its movements."""

from __future__ import annotations

import time
from itertools import pairwise

import numpy as np
import pytest

from mild_viz.data.demo import (
    DEMO_ACTIONS,
    DYADS,
    LONGEST_GAP,
    Take,
    joint_noise,
    make_cast,
    make_demo,
    make_takes,
)
from mild_viz.data.demo_body import DEMO_BONES, DEMO_JOINTS, GRIP, two_link
from mild_viz.data.demo_motion import CONTACT, REACH, REST, RETURN, minimum_jerk, swings
from mild_viz.data.skeletons import ARM_JOINTS, NUITRACK_JOINTS, joint_indices, to_world
from mild_viz.trial import CONTACT_ACTIONS, Dataset, Trial

ARM = joint_indices(DEMO_JOINTS, ARM_JOINTS)
SHOULDER, ELBOW, WRIST = ARM


@pytest.fixture(scope="module")
def demo() -> Dataset:
    return make_demo()


@pytest.fixture(scope="module")
def takes() -> list[Take]:
    return make_takes(0, "train") + make_takes(0, "test")


def bone_lengths(joints: np.ndarray) -> np.ndarray:
    first, second = np.array(DEMO_BONES).T
    return np.linalg.norm(joints[:, second] - joints[:, first], axis=-1)


def elbow_flexion(joints: np.ndarray) -> np.ndarray:
    upper, fore = joints[:, ELBOW] - joints[:, SHOULDER], joints[:, WRIST] - joints[:, ELBOW]
    cosine = np.sum(upper * fore, axis=-1) / np.linalg.norm(upper, axis=-1) / np.linalg.norm(fore, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """(first, length) of each stretch in which `mask` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [(int(a), int(b - a)) for a, b in edges.reshape(-1, 2)]


def test_counts_and_split(demo: Dataset):
    assert demo.name == "demo" and demo.actions == DEMO_ACTIONS
    for split, at_least in (("train", 12), ("test", 4)):
        trials = demo.split(split)
        assert [trial.index for trial in trials] == list(range(len(trials)))
        assert {trial.split for trial in trials} == {split}
        for action in DEMO_ACTIONS:
            assert sum(trial.action == action for trial in trials) >= at_least
    for trial in demo.train + demo.test:
        assert trial.rate == 30.0 and 5.0 <= trial.n_frames / trial.rate <= 9.0


def test_test_people_are_not_in_the_training_set():
    people = {split: {person for dyad in dyads for person in dyad} for split, dyads in DYADS.items()}
    assert not people["train"] & people["test"]
    assert len(set(DYADS["train"])) >= 4 and len(set(DYADS["test"])) >= 2


def test_cast_varies_about_the_published_proportions():
    cast = make_cast(0)
    statures = [person.stature for person in cast]
    assert min(statures) >= 1.55 and max(statures) <= 1.90 and max(statures) - min(statures) > 0.25
    for name, ratio in (("upper_arm", 0.186), ("forearm", 0.146), ("hand", 0.108)):
        ratios = np.array([person.lengths[name] / person.stature for person in cast])
        np.testing.assert_allclose(ratios, ratio, rtol=0.05)
        assert np.std(ratios / ratio) > 0.005
    for person in cast:
        leg = person.lengths["thigh"] + person.lengths["shank"]
        assert leg > person.lengths["hip_height"] - person.lengths["ankle_height"]


def test_same_seed_same_bits_and_another_seed_another_set(demo: Dataset):
    again, other = make_demo(), make_demo(seed=1)
    assert again.checksum == demo.checksum != other.checksum
    for one, two in zip(demo.train + demo.test, again.train + again.test, strict=True):
        for name in ("human_arm", "partner_arm", "phase", "T_world_human", "T_world_partner"):
            assert getattr(one, name).tobytes() == getattr(two, name).tobytes()
        assert one.human_skeleton is not None and two.human_skeleton is not None
        assert one.human_skeleton.positions.tobytes() == two.human_skeleton.positions.tobytes()
    assert demo.train[0].human_arm[:50].tobytes() != other.train[0].human_arm[:50].tobytes()


def test_another_seed_keeps_the_promises():
    for take in make_takes(7, "test"):
        assert 5.0 <= len(take.script.times) / 30 <= 9.0
        if take.action in CONTACT_ACTIONS:
            gap = np.linalg.norm(take.touching[0] - take.touching[1], axis=-1)
            assert gap[take.script.phase == CONTACT].max() < 0.025


def test_true_limbs_are_rigid(takes: list[Take]):
    for take in takes:
        for person, joints in zip(take.people, take.joints, strict=True):
            lengths = bone_lengths(joints)
            rigid = np.ptp(lengths, axis=0)
            assert rigid.max() < 0.02  # the spine bends a little as the trunk turns
            for segment, bone in (("upper_arm", (SHOULDER, ELBOW)), ("forearm", (ELBOW, WRIST))):
                k = DEMO_BONES.index(bone)
                np.testing.assert_allclose(lengths[:, k], person.lengths[segment], atol=1e-12)
            hand = DEMO_BONES.index((WRIST, DEMO_JOINTS.index("right_hand")))
            np.testing.assert_allclose(lengths[:, hand], GRIP * person.lengths["hand"], atol=1e-12)


def test_tracked_limbs_are_rigid_within_the_noise(demo: Dataset):
    for trial in demo.train + demo.test:
        for arm in (trial.human_arm, trial.partner_arm):
            assert arm is not None
            lengths = np.linalg.norm(np.diff(arm, axis=1), axis=-1)
            spread = np.nanstd(lengths, axis=0)
            assert (spread > 0.001).all() and (spread < 0.010).all()


def test_noise_is_of_the_stated_size_and_slow():
    noise = joint_noise(np.random.default_rng(3), 6000)
    wrist = noise[:, 0, WRIST]
    in_space = np.sqrt(np.sum(np.var(wrist, axis=0)))
    assert 0.005 < in_space < 0.008
    # Second differences see the white part mostly: sqrt(6) times its size, per axis.
    white = np.std(np.diff(wrist, n=2, axis=0), axis=0) / np.sqrt(6) * np.sqrt(3)
    assert (white > 0.0012).all() and (white < 0.0035).all()
    slow = [np.corrcoef(wrist[:-2, k], wrist[2:, k])[0, 1] for k in range(3)]
    assert min(slow) > 0.5


def test_hands_meet_and_stay_together(takes: list[Take]):
    for take in takes:
        if take.action not in CONTACT_ACTIONS:
            continue
        contact = take.script.phase == CONTACT
        gap = np.linalg.norm(take.touching[0] - take.touching[1], axis=-1)
        assert gap[contact].max() < 0.025
        assert gap[0] > 0.4 and gap[-1] > 0.4
        # Wrists stay a hand apart: two palms in a handshake (about 0.15 m), two fists in a bump (up to 0.21 m).
        wrists = np.linalg.norm(take.joints[0][:, WRIST] - take.joints[1][:, WRIST], axis=-1)[contact]
        assert wrists.min() > 0.11 and wrists.max() < 0.22


def test_tracked_wrists_meet_in_the_world_frame(demo: Dataset):
    for trial in demo.train + demo.test:
        assert trial.T_world_human is not None and trial.T_world_partner is not None
        assert trial.partner_arm is not None and trial.phase is not None
        human = to_world(trial.T_world_human, np.array(trial.human_arm))
        partner = to_world(trial.T_world_partner, np.array(trial.partner_arm))
        apart = np.linalg.norm(human[:, 2] - partner[:, 2], axis=-1)[trial.phase == CONTACT]
        if trial.action in CONTACT_ACTIONS:
            assert np.nanmin(apart) > 0.09 and np.nanmax(apart) < 0.24
        else:
            assert np.nanmin(apart) > 0.4


def test_partners_face_each_other_at_conversational_distance(demo: Dataset):
    for trial in demo.train + demo.test:
        assert trial.T_world_human is not None and trial.T_world_partner is not None
        between = trial.T_world_partner[:2, 3] - trial.T_world_human[:2, 3]
        assert 0.85 < np.linalg.norm(between) < 1.75
        assert trial.T_world_human[:2, 0] @ between / np.linalg.norm(between) > 0.9
        assert trial.T_world_partner[:2, 0] @ between / np.linalg.norm(between) < -0.9


def own_frame_is_from_the_first_frame(trial: Trial) -> None:
    for skeleton, arm in ((trial.human_skeleton, trial.human_arm), (trial.partner_skeleton, trial.partner_arm)):
        assert skeleton is not None and arm is not None
        assert skeleton.joint_names[: len(NUITRACK_JOINTS)] == NUITRACK_JOINTS
        np.testing.assert_array_equal(skeleton.positions[:, ARM], arm)
        at = dict(zip(skeleton.joint_names, skeleton.positions[0], strict=True))
        np.testing.assert_allclose(at["right_collar"], 0.0, atol=1e-12)
        across = at["left_shoulder"] - at["right_shoulder"]
        np.testing.assert_allclose(across / np.linalg.norm(across), [0, 1, 0], atol=1e-12)
        assert abs((at["waist"] - at["right_shoulder"])[0]) < 1e-12
        assert at["head"][2] > 0.1 and at["waist"][2] < -0.3 and at["left_ankle"][2] < -1.0


def test_own_frames_come_from_the_first_frame(demo: Dataset):
    for trial in demo.train[::5] + demo.test[::3]:
        own_frame_is_from_the_first_frame(trial)


def test_phases_come_in_order_and_none_is_empty(demo: Dataset):
    for trial in demo.train + demo.test:
        phase = trial.phase
        assert phase is not None
        order = [int(phase[0])] + [int(b) for a, b in pairwise(phase.tolist()) if a != b]
        assert order == [REST, REACH, CONTACT, RETURN, REST]
        lengths = [length for _, length in (run for k in range(4) for run in runs(phase == k))]
        assert min(lengths) >= 9


def test_phases_agree_with_the_movement(takes: list[Take]):
    for take in takes:
        phase, wrist = take.script.phase, take.joints[0][:, WRIST]
        speed = np.linalg.norm(np.diff(wrist, axis=0), axis=-1) * 30
        assert speed[phase[1:] == REST].max() < 0.08
        for moving in (REACH, RETURN):
            assert speed[phase[1:] == moving].max() > 0.5


def test_timing_amplitude_and_speed_vary(takes: list[Take]):
    for action in DEMO_ACTIONS:
        chosen = [take for take in takes if take.action == action]
        contact = np.array([np.sum(take.script.phase == CONTACT) for take in chosen]) / 30
        assert contact.std() > 0.15
        lags = np.array([take.script.timings[1].start - take.script.timings[0].start for take in chosen])
        assert lags.min() < -0.1 and lags.max() > 0.1
        assert (np.abs(lags) > 0.1).all()  # nobody starts at the same time: the other needs to react


def test_reaching_is_bell_shaped(takes: list[Take]):
    for take in takes:
        start, end = take.script.timings[0].start, take.script.timings[0].arrive
        times = take.script.times
        inside = (times[1:] > start + 1 / 30) & (times[1:] < end)
        hand = take.touching[0]
        speed = (np.linalg.norm(np.diff(hand, axis=0), axis=-1) * 30)[inside]
        s = (times[1:][inside] - 1 / 60 - start) / (end - start)
        bell = 30 * s**2 * (1 - s) ** 2
        # Not 1: the way is curved, and the shoulder from which the hand comes moves too.
        assert np.corrcoef(speed, bell)[0, 1] > 0.93
        assert 0.35 < s[np.argmax(speed)] < 0.65
        peak = int(np.argmax(speed))
        rising, falling = np.diff(speed[: peak + 1]), np.diff(speed[peak:])
        tolerance = 0.03 * speed.max()
        assert rising.min() > -tolerance and falling.max() < tolerance


def test_minimum_jerk_is_the_fifth_order_polynomial():
    s = np.linspace(0, 1, 101)
    np.testing.assert_allclose(minimum_jerk(2 + 3 * s, 2.0, 5.0), 10 * s**3 - 15 * s**4 + 6 * s**5, atol=1e-12)
    assert minimum_jerk(np.array([0.0, 9.0]), 2.0, 5.0).tolist() == [0.0, 1.0]


@pytest.mark.parametrize("cycles", [2, 3, 4])
def test_swings_have_the_asked_cycles(cycles: int):
    wave = swings(np.linspace(0, 1, 2001), 0.1, 0.9, cycles, 0.3)
    assert wave[0] == wave[-1] == 0.0 and np.abs(wave).max() <= 1.0
    high, low = runs(wave > 0.3), runs(wave < -0.3)
    assert len(high) == len(low) == cycles


def swing_count(signal: np.ndarray, threshold: float) -> int:
    """Oscillations about the slow trend, counted on the side with more."""
    return max(len(runs(signal > threshold)), len(runs(signal < -threshold)))


def test_each_interaction_does_what_its_name_says(takes: list[Take]):
    for take in takes:
        contact = take.script.phase == CONTACT
        human = take.joints[0][contact]
        hand, shoulder = human[:, DEMO_JOINTS.index("right_hand")], human[:, SHOULDER]
        head = human[:, DEMO_JOINTS.index("head")]
        stature = take.people[0].stature
        if take.action == "wave":
            assert (hand[:, 2] > shoulder[:, 2] + 0.05).all()
            assert np.abs(hand[:, 2] - head[:, 2]).mean() < 0.2
            assert 0.15 < np.linalg.norm(hand[:, :2] - head[:, :2], axis=-1).mean() < 0.65
            assert np.ptp(human[:, ELBOW], axis=0).max() < 0.12 < 0.2 < np.ptp(hand[:, 1])
            assert 2 <= swing_count(hand[:, 1] - (hand[:, 1].max() + hand[:, 1].min()) / 2, 0.03) <= 5
        elif take.action == "handshake":
            assert 0.50 < hand[:, 2].mean() / stature < 0.80
            assert 0.04 < np.ptp(hand[:, 2]) < 0.25 and np.ptp(hand[:, 1]) < 0.06
            assert 2 <= swing_count(hand[:, 2] - hand[0, 2], 0.008) <= 4
        elif take.action == "rocket":
            assert hand[-1, 2] - hand[0, 2] > 0.25 and np.diff(hand[:, 2]).min() > -0.01
        else:
            assert hand[0, 2] - hand[-1, 2] > 0.25 and np.diff(hand[:, 2]).max() < 0.01
            assert 2 <= swing_count(hand[:, 1] - hand[0, 1], 0.02) <= 4


def test_joint_angles_are_plausible(takes: list[Take]):
    in_reach = []
    for take in takes:
        for joints in take.joints:
            flexion = elbow_flexion(joints)
            assert flexion.min() > 5 and flexion.max() < 125
            if take.action in CONTACT_ACTIONS:
                assert flexion[take.script.phase == CONTACT].max() < 95
            in_reach.append(flexion < 90)
            # The elbow hangs below the shoulder, never comes above it by more than a little, and stays outside.
            upper = joints[:, ELBOW] - joints[:, SHOULDER]
            assert (upper[:, 2] / np.linalg.norm(upper, axis=-1)).max() < 0.1
    assert np.mean(np.concatenate(in_reach)) > 0.85


def test_the_rest_of_the_body_takes_part_but_little(takes: list[Take]):
    forward = []
    for take in takes:
        contact = take.script.phase == CONTACT
        for joints in take.joints:
            left = joints[:, DEMO_JOINTS.index("left_wrist")]
            assert 0.004 < np.ptp(left, axis=0).max() < 0.25
            ankle = joints[:, DEMO_JOINTS.index("left_ankle")]
            assert np.ptp(ankle, axis=0).max() < 1e-9 and 0 < ankle[0, 2] < 0.1
        if take.action == "handshake":
            moved = take.joints[0][:, SHOULDER, 0]
            forward.append(moved[contact].mean() - moved[0])
    assert 0.04 < np.mean(forward) < 0.20


def test_lost_frames_are_short_and_never_first(demo: Dataset):
    with_gaps = whole_body = 0
    for trial in demo.train + demo.test:
        for skeleton in (trial.human_skeleton, trial.partner_skeleton):
            assert skeleton is not None
            lost = np.any(np.isnan(skeleton.positions), axis=-1)
            np.testing.assert_array_equal(lost, np.all(np.isnan(skeleton.positions), axis=-1))
            assert not lost[0].any() and not lost[-1].any()
            gaps = runs(np.any(lost, axis=1))
            assert all(1 <= length <= LONGEST_GAP for _, length in gaps)
            with_gaps += bool(gaps)
            whole_body += bool(np.all(lost, axis=1).any())
    assert 0.2 < with_gaps / (2 * len(demo.train + demo.test)) < 0.7
    assert whole_body > 0


def test_two_link_reaches_and_keeps_its_lengths():
    rng = np.random.default_rng(0)
    root, pole = rng.normal(size=(200, 3)), rng.normal(size=(200, 3))
    direction = rng.normal(size=(200, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    target = root + rng.uniform(0.1, 0.54, (200, 1)) * direction
    elbow, fore = two_link(root, target, 0.30, 0.25, pole)
    np.testing.assert_allclose(np.linalg.norm(elbow - root, axis=-1), 0.30, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(fore, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(elbow + 0.25 * fore, target, atol=1e-12)
    assert (np.sum((elbow - root) * (pole - np.sum(pole * direction, -1, keepdims=True) * direction), -1) > 0).all()
    # Out of reach: as far as it goes, in the right direction, with the same lengths.
    elbow, fore = two_link(root, root + 2 * direction, 0.30, 0.25, pole)
    np.testing.assert_allclose(np.linalg.norm(elbow - root, axis=-1), 0.30, atol=1e-12)
    np.testing.assert_allclose(elbow + 0.25 * fore - root, 0.9995 * 0.55 * direction, atol=1e-12)


def test_generation_is_quick(demo: Dataset):
    begin = time.process_time()
    make_demo()
    assert time.process_time() - begin < 2.0  # about 0.3 s of CPU without the checks of the import hook
