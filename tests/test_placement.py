"""Where the human stands: contact frames, the estimate, and recordings with one world frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mild_viz.errors import UserError
from mild_viz.robot.contact import arm_length, contact_frames, in_frame, suggest_contact_states
from mild_viz.robot.model import load_robot
from mild_viz.robot.placement import (
    FACING,
    T_world_human,
    dyad_translation,
    estimate_meeting,
    estimate_placement,
    outstretched_placement,
    place_human,
    recorded_placement,
)
from mild_viz.robot.retarget_arm import LARGEST_FRACTION
from mild_viz.settings import Placement
from mild_viz.trial import CONTACT_ACTIONS, Trial

CHAIN = load_robot("pepper").chain
T = 120
APART = np.array([0.95, 0.03, 0.12])
"""Where the partner's frame is in the human's, in the made trials below."""


def reaching(shoulder: np.ndarray, hand: np.ndarray) -> np.ndarray:
    """An arm of 0.3 + 0.25 m with its wrist at `hand` (T, 3)."""
    reach = hand - shoulder
    distance = np.linalg.norm(reach, axis=1, keepdims=True)
    along = (distance**2 + 0.3**2 - 0.25**2) / (2 * distance)
    down = np.cross(reach, np.cross(reach, [0.0, 0.0, 1.0]))
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    elbow = shoulder + along * reach / distance + np.sqrt(np.maximum(0.3**2 - along**2, 0.0)) * down
    return np.stack([np.tile(shoulder, (len(hand), 1)), elbow, hand], axis=1)


def made_trial(seed: int = 0, action: str = "handshake", world: bool = False, noise: float = 0.0) -> Trial:
    """Two people who face each other, reach out, touch in the middle third, and go back."""
    random = np.random.default_rng(seed)
    share = np.sin(np.clip(np.linspace(-0.75, 1.75, T), 0.0, 1.0) * np.pi) ** 0.25
    share = np.where(np.abs(np.linspace(-1, 1, T)) < 1 / 3, 1.0, 0.6 * share)[:, None]
    meeting = np.array([0.45, -0.12, -0.12]) + 0.03 * np.sin(np.linspace(0, 20, T))[:, None] * (0, 0, 1)
    shoulder, rest = np.array([0.0, -0.18, 0.0]), np.array([0.1, -0.2, -0.45])
    human = reaching(shoulder, rest + share * (meeting - rest))
    partner_meeting = (meeting - APART) @ FACING
    partner = reaching(shoulder, rest + share * (partner_meeting - rest))
    human, partner = (arm + random.normal(scale=noise, size=arm.shape) for arm in (human, partner))
    frames = {}
    if world:
        pose, facing = np.eye(4), np.eye(4)
        pose[:3, :3] = Rotation.from_euler("Z", 0.7).as_matrix()
        pose[:3, 3] = [3.0, -2.0, 1.4]
        facing[:3, :3], facing[:3, 3] = FACING, APART
        frames = {"T_world_human": pose, "T_world_partner": pose @ facing}
    return Trial("made", "train", seed, action, 30.0, human, partner, **frames)


# contact frames


def test_contact_frames_of_made_trials():
    expected = np.abs(np.linspace(-1, 1, T)) < 1 / 3
    for world in (False, True):
        found = contact_frames(made_trial(world=world))
        assert found[expected].mean() > 0.8 and not found[~expected].any()
    assert not contact_frames(made_trial(action="wave")).any()


def test_contact_follows_the_known_phase_and_skips_gaps():
    trial = made_trial()
    phase = np.zeros(T, dtype=int)
    phase[30:60] = 2
    human = np.array(trial.human_arm)
    human[40:45] = np.nan
    found = contact_frames(replace(trial, human_arm=human, phase=phase))
    assert np.flatnonzero(found).tolist() == [*range(30, 40), *range(45, 60)]


def test_nobody_reaches_or_nobody_is_seen():
    trial = made_trial()
    lazy = np.tile(trial.human_arm[:1], (T, 1, 1))
    assert not contact_frames(replace(trial, human_arm=lazy)).any()
    assert not contact_frames(replace(trial, human_arm=np.full((T, 3, 3), np.nan))).any()
    assert not contact_frames(replace(trial, partner_arm=None)).any()


def test_contact_in_real_recordings_is_one_part_of_the_trial(dataset):
    for name in ("nuisi", "handover"):
        for trial in dataset(name).train:
            share = contact_frames(trial).mean()
            assert (0.01 < share < 0.8) if trial.action in CONTACT_ACTIONS else share == 0.0, trial.name


def test_suggested_contact_states():
    active = [np.array([0, 0, 1, 1, 2, 2, 3]), np.array([0, 1, 1, 2, 3])]
    touching = [np.array([0, 0, 1, 1, 1, 0, 0], bool), np.array([0, 0, 1, 1, 0], bool)]
    assert suggest_contact_states(active, touching, 5) == {1, 2}
    assert suggest_contact_states(active, [t & False for t in touching], 5) == frozenset()
    rare = [np.array([1, 0, 0, 0, 0, 0, 0], bool), np.zeros(5, bool)]
    assert suggest_contact_states(active, rare, 5) == {0}, "relative to the state with the largest share"


@pytest.mark.parametrize(("speed", "together"), [(0.45, True), (0.55, False)])
def test_extended_hands_that_move_apart_are_not_in_contact(speed, together):
    shoulder = np.array([0.0, -0.18, 0.0])
    human = np.tile([0.45, -0.18, -0.05], (T, 1))
    partner = human.copy()
    partner[:, 1] += np.clip(np.arange(T) - 60, 0, 10) * speed / 30.0  # sideways: as extended as before
    found = contact_frames(
        replace(made_trial(), human_arm=reaching(shoulder, human), partner_arm=reaching(shoulder, partner))
    )
    assert found[:57].all() and found[74:].all()
    assert (found[63:68] == together).all()


# the estimate


def test_the_translation_of_made_dyads_is_found_despite_outliers():
    trials = [made_trial(seed, noise=0.005) for seed in range(5)]
    fit = dyad_translation(trials)
    np.testing.assert_allclose(fit.translation, APART, atol=0.003)
    assert fit.n_trials == 5 and fit.within_trials < 0.03
    spoilt = np.array(trials[0].human_arm)
    spoilt[:, 2] += (0.0, 0.3, 0.0)
    np.testing.assert_allclose(
        dyad_translation([*trials, replace(trials[0], human_arm=spoilt)]).translation, APART, atol=0.01
    )


def test_nuisi_handshakes_give_the_verified_translation(dataset):
    train = dataset("nuisi").train
    fit = dyad_translation([trial for trial in train if trial.action == "handshake"])
    np.testing.assert_allclose(fit.translation, [0.97, 0.02, 0.14], atol=0.015)
    assert fit.n_trials == 8
    assert fit.between_trials < 0.05 and fit.within_trials < 0.06


def test_estimate_puts_contact_at_the_partners_fraction_of_reach(dataset):
    train = dataset("nuisi").train
    placement, fit = estimate_placement(CHAIN, train)
    assert placement.estimated and "24 training trials of nuisi" in placement.source
    assert 0.6 < placement.distance < 0.9 < dyad_translation(train).translation[0]
    pose = T_world_human(CHAIN, placement)
    np.testing.assert_allclose(pose[:3, 3], fit.translation)
    np.testing.assert_allclose(pose[:3, :3], FACING)
    for action in ("handshake", "rocket", "parachute"):
        fractions, robots = [], []
        for trial in train:
            touching = contact_frames(trial)
            if trial.action == action and touching.any():
                partner = trial.partner_arm[touching]
                fractions.append(np.linalg.norm(partner[:, 2] - partner[:, 0], axis=1) / arm_length(trial.partner_arm))
                hand = in_frame(pose, trial.human_arm[touching, 2])
                robots.append(np.linalg.norm(hand - CHAIN.shoulder, axis=1) / CHAIN.reach)
        # one place for three actions, whose contact moves more than Pepper's arm can: right on average
        assert np.concatenate(robots).mean() == pytest.approx(np.concatenate(fractions).mean(), abs=0.2)


def test_estimate_without_contact_is_refused():
    with pytest.raises(UserError, match="no trial shows contact"):
        estimate_placement(CHAIN, [made_trial(action="wave")])


# one world frame


def test_recorded_placement_puts_the_robot_in_the_partners_place():
    trial = made_trial(world=True)
    placed = recorded_placement(CHAIN, trial)
    assert placed is not None and not placed.placement.estimated and trial.partner_arm is not None
    np.testing.assert_allclose(placed.T_world_human[:3, :3], FACING, atol=1e-12)
    touching = contact_frames(trial)
    hand = in_frame(placed.T_world_human, trial.human_arm[touching, 2]) - CHAIN.shoulder
    partner = trial.partner_arm[touching, 2] - trial.partner_arm[touching, 0]
    expected = CHAIN.reach * np.minimum(np.linalg.norm(partner, axis=1).mean() / 0.55, LARGEST_FRACTION)
    assert np.linalg.norm(hand, axis=1).mean() == pytest.approx(expected, abs=0.01)
    direction = partner.mean(axis=0) / np.linalg.norm(partner.mean(axis=0))
    np.testing.assert_allclose(hand.mean(axis=0) / np.linalg.norm(hand.mean(axis=0)), direction, atol=0.05)
    np.testing.assert_allclose(placed.T_world_human, T_world_human(CHAIN, placed.placement), atol=1e-12)


@pytest.mark.parametrize(("partner_fraction", "fraction"), [(0.6, 0.6), (0.8, 0.8), (0.88, 0.88), (0.97, 0.9)])
def test_hands_meet_at_the_partners_fraction_of_reach_up_to_nine_tenths(partner_fraction, fraction):
    shoulder = np.array([0.0, -0.18, 0.0])
    hand = shoulder + partner_fraction * 0.55 * np.array([0.96, 0.0, -0.28])
    partner = reaching(shoulder, np.tile(hand, (T, 1)))
    meeting = APART + FACING @ hand  # in the human's frame
    human = reaching(meeting + (-0.4, 0.05, 0.1), np.tile(meeting, (T, 1)))
    trial = replace(made_trial(world=True), human_arm=human, partner_arm=partner)
    placed = recorded_placement(CHAIN, trial)
    assert placed is not None and contact_frames(trial).all()
    found = in_frame(placed.T_world_human, human[:, 2]) - CHAIN.shoulder
    np.testing.assert_allclose(found, np.tile(fraction * CHAIN.reach * np.array([0.96, 0.0, -0.28]), (T, 1)), atol=1e-6)


def test_recorded_placement_does_not_depend_on_the_world():
    trial = made_trial(world=True)
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("Z", -2.0).as_matrix()
    turned[:3, 3] = [5.0, 1.0, -3.0]
    assert trial.T_world_human is not None and trial.T_world_partner is not None
    moved = replace(trial, T_world_human=turned @ trial.T_world_human, T_world_partner=turned @ trial.T_world_partner)
    one, other = recorded_placement(CHAIN, trial), recorded_placement(CHAIN, moved)
    assert one is not None and other is not None
    np.testing.assert_allclose(one.T_world_human, other.T_world_human, atol=1e-9)


def test_without_contact_the_distance_shrinks_with_the_arms():
    trial = made_trial(action="wave", world=True)
    placed = recorded_placement(CHAIN, trial)
    assert placed is not None
    shoulder = in_frame(placed.T_world_human, trial.human_arm[:1, 0])[0] - CHAIN.shoulder
    recorded = FACING @ ([0.0, -0.18, 0.0] - APART) - [0.0, -0.18, 0.0]
    np.testing.assert_allclose(shoulder, recorded * (0.55 + CHAIN.reach) / 1.1, atol=1e-9)


@pytest.mark.parametrize("name", ["demo", "handover"])
def test_recorded_hands_meet_within_reach(request, name):
    from mild_viz.data.load import load_dataset

    data = load_dataset("demo") if name == "demo" else request.getfixturevalue("dataset")(name)
    for trial in data.test:
        placed = place_human(CHAIN, trial)
        assert np.isfinite(placed.T_world_human).all() and placed.placement.source.startswith("recorded")
        touching = contact_frames(trial)
        if touching.any():
            hand = in_frame(placed.T_world_human, trial.human_arm[touching, 2])
            fraction = np.linalg.norm(hand - CHAIN.shoulder, axis=1) / CHAIN.reach
            assert 0.5 < np.median(fraction) < 1.2, trial.name


# which one counts


def test_chosen_before_recorded_before_stored():
    stored, chosen = Placement(0.8, 0.1, 0.0, "stored"), Placement(1.0, 0.0, 0.2)
    apart, together = made_trial(), made_trial(world=True)
    assert place_human(CHAIN, apart, stored=stored).placement is stored
    assert place_human(CHAIN, together, stored=stored).placement.source.startswith("recorded")
    for trial in (apart, together):
        placed = place_human(CHAIN, trial, chosen, stored)
        assert placed.placement is chosen
        np.testing.assert_allclose(placed.T_world_human[:3, 3], CHAIN.shoulder + [1.0, 0.0, 0.2])
    assumed = place_human(CHAIN, apart)
    assert assumed.placement == outstretched_placement(CHAIN, apart) and assumed.placement.estimated
    assert assumed.placement.distance == pytest.approx(0.85 * (CHAIN.reach + arm_length(apart.human_arm)), abs=1e-6)


def test_same_place_for_descriptions_with_another_base(shared):
    standing = load_robot(str(shared("robots/pepper_description/urdf/pepper.urdf"))).chain
    place = Placement(0.8, 0.1, 0.0)
    difference = T_world_human(standing, place) - T_world_human(CHAIN, place)
    np.testing.assert_allclose(difference[:3, 3], [0.0, 0.0, 0.82], atol=1e-6)


def test_a_meeting_puts_the_human_where_the_estimate_for_that_robot_does(dataset: Callable[[str], Any]) -> None:
    train = dataset("nuisi").train
    touching = [trial for trial in train if contact_frames(trial).any()]
    meeting = estimate_meeting(touching)
    assert 0.8 < np.linalg.norm(meeting.partner) < 1.0, "people meet with arms that are nearly stretched"
    for name in ("pepper", "panda", "yumi"):
        chain = load_robot(name).chain
        fitted, placed = estimate_placement(chain, touching)[0], meeting.placement(chain)
        for axis in ("distance", "lateral", "height"):
            # a Panda's lift turns each frame's direction by another angle, where the meeting knows their mean alone
            within = 0.05 if chain.position.lift == 0.0 else 0.08
            assert getattr(placed, axis) == pytest.approx(getattr(fitted, axis), abs=within)
    with pytest.raises(UserError, match="no trial shows contact"):
        estimate_meeting([trial for trial in train if trial.action == "wave"])
