"""Scripts of the demo set: when each partner moves, and where the hands go, for each interaction.

Both right hands follow minimum-jerk courses (Flash and Hogan, 1985) to a goal and back. In the interactions with
touch the goal of both is one moving point in the world between the partners, so that the hands stay together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mild_viz.data.demo_body import FIST, GRIP, ArmMotion, Person
from mild_viz.trial import PHASES

RATE = 30.0
"""Frames a second [Hz], as NuiSI."""

REST, REACH, CONTACT, RETURN = range(len(PHASES))


@dataclass(frozen=True)
class Timing:
    """When one person's hand starts, arrives at its goal, leaves it, and hangs again [s]."""

    start: float
    arrive: float
    leave: float
    back: float

    def share(self, times: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
        """`ArmMotion.share`: up by minimum jerk, 1 while at the goal, down by minimum jerk."""
        return minimum_jerk(times, self.start, self.arrive) - minimum_jerk(times, self.leave, self.back)


@dataclass(frozen=True)
class Stance:
    """Where a person stands: position on the floor [m] and heading about z [rad], in world."""

    x: float
    y: float
    heading: float

    def pose(self) -> Float[np.ndarray, "4 4"]:
        """T_world_body."""
        c, s = float(np.cos(self.heading)), float(np.sin(self.heading))
        return np.array([[c, -s, 0.0, self.x], [s, c, 0.0, self.y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Script:
    """One interaction, ready to be performed by two bodies; the human comes first in every pair."""

    times: Float[np.ndarray, " T"]
    phase: Int[np.ndarray, " T"]
    stances: tuple[Stance, Stance]
    arms: tuple[ArmMotion, ArmMotion]
    timings: tuple[Timing, Timing]


def minimum_jerk(times: Float[np.ndarray, " T"], start: float, end: float) -> Float[np.ndarray, " T"]:
    """0 before `start`, 1 after `end`, and between them the smoothest way (10 s^3 - 15 s^4 + 6 s^5)."""
    s = np.clip((times - start) / (end - start), 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def swings(
    times: Float[np.ndarray, " T"], start: float, end: float, cycles: int, decay: float
) -> Float[np.ndarray, " T"]:
    """`cycles` oscillations between `start` and `end`, from and back to rest, the last smaller by `decay`."""
    s = np.clip((times - start) / (end - start), 0.0, 1.0)
    edge = 0.35 / cycles
    envelope = minimum_jerk(s, 0.0, edge) * (1 - minimum_jerk(s, 1 - edge, 1.0)) * (1 - decay * s)
    return envelope * np.sin(2 * np.pi * cycles * s)


def phases(times: Float[np.ndarray, " T"], timing: Timing, meet: float, part: float) -> Int[np.ndarray, " T"]:
    """Index into `PHASES` of every frame, from the human's timing; contact lasts from `meet` to `part` [s]."""
    edges = np.array([timing.start, meet, part, timing.back])
    return np.array([REST, REACH, CONTACT, RETURN, REST])[np.searchsorted(edges, times, side="right")]


def frame_times(rng: np.random.Generator, last: float) -> Float[np.ndarray, " T"]:
    """Times of all frames: until the later hand hangs at `last`, and some rest after it [s]."""
    total = max(last + rng.uniform(0.5, 0.9), 5.05)
    return np.arange(int(total * RATE)) / RATE


def meeting_times(rng: np.random.Generator, people: tuple[Person, Person], touching: float) -> tuple[Timing, Timing]:
    """Timings of two hands that meet, stay together for `touching` seconds and part.

    One partner, more often the human, begins; the other follows after a reaction time and moves a little faster.
    """
    human_leads = rng.uniform() < 0.65
    lead, follow = people if human_leads else people[::-1]
    start = rng.uniform(0.5, 0.9)
    duration = rng.uniform(0.85, 1.15) * lead.tempo
    delay = rng.uniform(0.12, 0.40)
    following = max(duration - delay + rng.uniform(-0.05, 0.20), 0.65 * follow.tempo)
    arrivals = np.array([start + duration, start + delay + following])
    part = float(arrivals.max()) + touching
    leaves = part + np.array([0.0, rng.uniform(0.0, 0.12)])[:: 1 if rng.uniform() < 0.5 else -1]
    backs = leaves + rng.uniform(0.80, 1.10, 2) * np.array([lead.tempo, follow.tempo])
    pair = (
        Timing(start, float(arrivals[0]), float(leaves[0]), float(backs[0])),
        Timing(start + delay, float(arrivals[1]), float(leaves[1]), float(backs[1])),
    )
    return pair if human_leads else (pair[1], pair[0])


def stand(rng: np.random.Generator, distance: float, aside: float) -> tuple[Stance, Stance]:
    """Two people facing each other, each stepped to the right by `aside`, so that right hands meet in the middle."""
    turns = rng.normal(0.0, np.radians(2.5), 2).tolist()
    return (
        Stance(-distance / 2, -aside, turns[0]),
        Stance(distance / 2, aside, np.pi + turns[1]),
    )


def in_body(stance: Stance, points: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """World points in the body frame of someone who stands at `stance`."""
    pose = stance.pose()
    return (points - pose[:3, 3]) @ pose[:3, :3]


def meeting_height(
    rng: np.random.Generator,
    action: str,
    times: Float[np.ndarray, " T"],
    begin: float,
    end: float,
    cycles: int,
    shoulders: list[float],
    vigour: float,
) -> Float[np.ndarray, " T"]:
    """Height of the meeting hands over time [m]; they move between `begin` and `end` [s]."""
    middle = sum(shoulders) / 2
    # The taller one would have to bow to hands that are much lower than this.
    floor = max(shoulders) - 0.43
    if action == "handshake":
        shake = 0.5 * rng.uniform(0.08, 0.14) * vigour * swings(times, begin, end, cycles, rng.uniform(0.2, 0.5))
        return max(middle - rng.uniform(0.24, 0.32), floor) - shake
    low = max(middle - rng.uniform(0.34, 0.43), floor)
    high = middle + (rng.uniform(-0.01, 0.08) if action == "rocket" else rng.uniform(-0.07, 0.05))
    rise = minimum_jerk(times, begin, end)
    return low + (high - low) * (rise if action == "rocket" else 1 - rise)


def script_touch(rng: np.random.Generator, action: str, people: tuple[Person, Person]) -> Script:
    """Handshake, rocket or parachute: the hands meet, move together, and part."""
    vigour = (people[0].vigour + people[1].vigour) / 2
    tempo = (people[0].tempo + people[1].tempo) / 2
    touch = GRIP if action == "handshake" else FIST
    cycles = int(rng.integers(2, 5))
    settle, hold = rng.uniform(0.15, 0.45), rng.uniform(0.15, 0.40)
    if action == "handshake":
        moving = cycles * rng.uniform(0.48, 0.72) * tempo
    elif action == "rocket":
        moving = rng.uniform(0.95, 1.45) * tempo
        hold = rng.uniform(0.25, 0.65)
    else:
        moving = cycles * rng.uniform(0.75, 1.0) * tempo
    timings = meeting_times(rng, people, settle + moving + hold)
    times = frame_times(rng, max(timing.back for timing in timings))
    meet = max(timing.arrive for timing in timings)
    part = min(timing.leave for timing in timings)
    begin, end = meet + settle, part - hold

    shoulders = [person.lengths["collar_height"] for person in people]
    height = meeting_height(rng, action, times, begin, end, cycles, shoulders, vigour)
    # Both stretch by the same fraction of their own arm, where the hands are lowest, the shoulder 0.1 m ahead.
    arm_lengths = [
        person.lengths["upper_arm"] + person.lengths["forearm"] + touch * person.lengths["hand"] for person in people
    ]
    lengths, drops = np.array(arm_lengths) * rng.uniform(0.87, 0.96), np.array(shoulders) - height.min()
    reaches = np.sqrt(np.maximum(lengths**2 - drops**2 - 0.20**2, 0.38**2)) + 0.10
    stances = stand(rng, float(reaches.sum()), rng.uniform(0.02, 0.07))
    point = np.empty((len(times), 3))
    point[:, 0] = (reaches[0] - reaches[1]) / 2
    point[:, 1] = rng.normal(0.0, 0.012)
    point[:, 2] = height
    if action == "rocket":
        point[:, 1] += 0.008 * swings(times, begin, end, 4, 0.0)
    elif action == "parachute":
        side = rng.uniform(0.11, 0.15) * vigour * (1 if rng.uniform() < 0.5 else -1)
        point[:, 1] += side * swings(times, begin, end, cycles, rng.uniform(0.0, 0.3))

    arms = []
    for k in range(2):
        # Palms lie side by side, and fists give a little, so the two touching points are not quite one.
        give = np.array([0.0, 0.008 if action == "handshake" else 0.003, 0.0]) * (1 if k else -1)
        slip = 0.004 * np.sin(2 * np.pi * rng.uniform(0.3, 0.8) * times + rng.uniform(0, 2 * np.pi))
        shifted = point + give + slip[:, None] * np.array([0.3, 0.2, 0.9])
        pole = np.array([-0.35, -rng.uniform(0.75, 1.15), -1.0])
        arms.append(
            ArmMotion(
                share=timings[k].share(times),
                goal=in_body(stances[k], shifted),
                from_shoulder=False,
                detour=np.array([rng.uniform(0.02, 0.06), -rng.uniform(0.0, 0.04), -rng.uniform(0.0, 0.03)]),
                elbow=np.tile(pole / np.linalg.norm(pole), (len(times), 1)),
                touch=touch,
            )
        )
    return Script(times, phases(times, timings[0], meet, part), stances, (arms[0], arms[1]), timings)


def script_wave(rng: np.random.Generator, people: tuple[Person, Person]) -> Script:
    """Both raise a hand beside the head and swing the forearm about the elbow, the partner in answer."""
    start, answer = rng.uniform(0.5, 0.9), rng.uniform(0.25, 0.60)
    leader = 0 if rng.uniform() < 0.7 else 1
    cycles = int(rng.integers(2, 5))
    timings, swinging = [], []
    for k, person in enumerate(people):
        # The one who answers has seen the other's hand come up, and waves no longer than the other.
        own = start + (0.0 if k == leader else answer)
        count = cycles if k == leader else max(cycles - int(rng.integers(0, 2)), 2)
        arrive = own + rng.uniform(0.85, 1.15) * person.tempo
        begin = arrive + rng.uniform(-0.05, 0.10)
        end = begin + count * rng.uniform(0.75, 1.05) * person.tempo
        timings.append(Timing(own, arrive, end, end + rng.uniform(0.85, 1.15) * person.tempo))
        swinging.append((begin, end, count))
    times = frame_times(rng, max(timing.back for timing in timings))

    arms = []
    for person, timing, (begin, end, count) in zip(people, timings, swinging, strict=True):
        size = person.lengths
        swing = np.radians(rng.uniform(23, 31)) * person.vigour * swings(times, begin, end, count, rng.uniform(0, 0.25))
        # Upper arm forward and out, a little below the shoulder; it follows the forearm's swing slightly.
        out = np.radians(rng.uniform(38, 50)) + 0.18 * swing
        drop = np.radians(rng.uniform(8, 18))
        upper = np.stack(
            [np.cos(drop) * np.cos(out), -np.cos(drop) * np.sin(out), np.full(len(times), -np.sin(drop))], axis=-1
        )
        # Forearm upright, tilted forward, swinging sideways about the elbow.
        tilt, middle = np.radians(rng.uniform(18, 28)), np.radians(rng.uniform(-8, 4))
        sideways = middle + swing
        forearm = np.stack(
            [np.full(len(times), np.sin(tilt)), -np.cos(tilt) * np.sin(sideways), np.cos(tilt) * np.cos(sideways)],
            axis=-1,
        )
        link = size["forearm"] + GRIP * size["hand"]
        arms.append(
            ArmMotion(
                share=timing.share(times),
                goal=size["upper_arm"] * upper + link * forearm,
                from_shoulder=True,
                detour=np.array([rng.uniform(0.10, 0.17), -rng.uniform(0.0, 0.04), 0.0]),
                elbow=upper,
                touch=GRIP,
            )
        )
    begin, end, _ = swinging[0]
    stances = stand(rng, rng.uniform(1.25, 1.65), rng.uniform(-0.06, 0.06))
    return Script(times, phases(times, timings[0], begin, end), stances, (arms[0], arms[1]), (timings[0], timings[1]))


def write_script(rng: np.random.Generator, action: str, people: tuple[Person, Person]) -> Script:
    """Draw one performance of an interaction by these two people."""
    return script_wave(rng, people) if action == "wave" else script_touch(rng, action, people)
