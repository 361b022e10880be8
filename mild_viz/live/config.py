"""Every threshold of live operation, with its unit and the reason for its default."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import get_type_hints

from mild_viz.errors import UserError
from mild_viz.settings import WINDOW, Watch
from mild_viz.toml_config import check_keys, converted, read_toml

RESTS = {"demo": 0.97, "nuisi": 0.2, "handover": 0.07, "yumi": 2.0}
"""How long the training trials of a dataset go on before this module's thresholds see a start [s], in the median
(benchmarks/onset.py prints it). v3 models hardly care; the v4 model of demo errs by 0.029 rad^2 with it (there: 29
frames), and by 0.039 with 0.17 s (5 frames)."""

USUAL_REST = 0.3
"""For any other dataset [s]."""


@dataclass(frozen=True)
class LiveConfig:
    """When an interaction begins and ends, and what is not believed. Times in seconds, distances in metres.

    "The authors" are those of the paper: their controller is public (souljaboy764/mild_hri_ros, mild_hr_node.py).
    """

    calibration: float = 0.5
    """How long the hand must rest [s] before its mean counts as its resting place. The authors average 70 frames
    (2.3 s) once an experimenter has said that the person stands still; without one, half a second (15 frames) makes a
    tracking error of 6 mm one of 2 mm, and the place is then refined for as long as the hand rests."""
    start_displacement: float = 0.0224
    """An interaction begins when the hand is this far from its resting place [m]: the authors' 0.0005 m^2, squared. In
    no trial of demo or NuiSI does it start before the hand moves (benchmarks/onset.py)."""
    start_duration: float = 0.03
    """For how long it must be there [s]: one frame more at 30 Hz, so that one frame's tracking error starts nothing."""
    adaptation: float = 10.0
    """Time constant with which the resting place follows a hand that rests [s]: who shifts weight starts nothing."""
    lead: float | None = None
    """How much of the time before the start the model is given [s]: recordings begin at rest, and a v4 model counts the
    time from there. None: as long as the model's own recordings rest (`RESTS`); at least its first window."""
    end_distance: float = 0.071
    """The hand is back when it is this near to its resting place [m]; the authors' 0.005 m^2, squared."""
    end_duration: float = 0.3
    """For how long it must be there [s]: a hand may pass its resting place."""
    end_still: float = 2.0
    """A hand that has moved less than `start_displacement` for this long [s] has come to rest too, wherever that is:
    after every sixth trial of NuiSI the arm hangs 10 cm or more from where it hung before."""
    shortest: float = 1.5
    """No interaction ends earlier [s]: its start is nearer to the resting place than `end_distance`. The authors wait
    for 130 frames."""
    longest: float = 60.0
    """No interaction lasts longer [s]; the hand must then rest before the next one begins."""
    stale: float = 0.1
    """A frame that is older than this when its turn comes [s] is not used: three frames at 30 Hz, half of a human's
    reaction time."""
    bridge: float = 0.1
    """Frames missing for up to this long are interpolated [s]; later ones count as not tracked."""
    clock: float = 0.5
    """If the sender's clock and ours differ by more than this over one frame [s], the sender's has jumped, and the time
    of arrival counts."""
    max_age: float = Watch.max_age
    """The robot stops where it is when the person was last seen longer ago than this [s] (`settings.Watch`)."""
    max_speed: float = Watch.max_speed
    """A hand that moved faster than this between two frames has jumped, and the robot stops [m/s]."""
    gone_after: float = Watch.gone_after
    """Not seen for this long [s], the person is gone: the interaction ends and the arm returns to rest."""
    page_rate: float = 30.0
    """Most frames a second that the page is sent [Hz]."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "lead" and value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value <= 0:
                raise UserError(f"{field.name} is {value!r}; valid: a finite number above 0")
        if self.gone_after <= self.bridge:
            raise UserError(f"gone_after is {self.gone_after} s; valid: above bridge, {self.bridge} s")
        _ = self.watch  # its own checks

    @property
    def watch(self) -> Watch:
        """What the safety filter expects of the observations."""
        return Watch(self.max_age, self.max_speed, self.gone_after)

    def for_dataset(self, dataset: str) -> LiveConfig:
        """With the lead of a model that was trained on a dataset, where none is chosen."""
        return self if self.lead is not None else replace(self, lead=RESTS.get(dataset, USUAL_REST))

    def lead_frames(self, rate: float) -> int:
        """Frames before the start that a model at `rate` [Hz] is given."""
        return max(round((USUAL_REST if self.lead is None else self.lead) * rate), WINDOW)


def read_live_config(file: Path) -> LiveConfig:
    """The config in a flat TOML file; what it leaves out has its default.

    Raises:
        UserError: naming the file and the key, what was found and what would be valid.
    """
    table, types = read_toml(file), get_type_hints(LiveConfig)
    check_keys(table, types, str(file))
    values = {key: converted(value, types[key], f"{file}: {key}") for key, value in table.items()}
    try:
        return LiveConfig(**values)
    except UserError as error:
        raise UserError(f"{file}: {error}") from None
