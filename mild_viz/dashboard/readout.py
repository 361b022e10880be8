"""What holds at one moment, in words: the same in the panel's header and in the line over the charts."""

from __future__ import annotations

from mild_viz.dashboard.charts import state_color
from mild_viz.robot.control.rules import fired_rules
from mild_viz.rollout import Rollout

LOST = "tracking lost"


def state_html(rollout: Rollout, frame: int) -> str:
    """The active state with its colour, and whether it is one of the ticked contact states."""
    state = int(rollout.inference.active_state[frame])
    swatch = f'<span class="mv-swatch" style="background:{state_color(state)}"></span>'
    return f"{swatch}state <b>{state}</b> · {'contact state' if rollout.contact[frame] else 'free motion'}"


def stiffness_text(rollout: Rollout, frame: int) -> str:
    """Stiffness of the softest joint."""
    return f"stiffness {100 * rollout.stiffness[frame].min():.0f} %"


def rules_text(rollout: Rollout, frame: int) -> str:
    """The names of the rules that fired."""
    return ", ".join(rule.name for rule in fired_rules(int(rollout.fired[frame]))) or "none"


def distance_html(rollout: Rollout, frame: int, emphasis: str = "{}") -> str:
    """How far the robot's hand is from the human's wrist; no number where the wrist was not seen."""
    if not rollout.inference.tracked[frame]:
        return emphasis.format(LOST)
    return f"robot hand to wrist {emphasis.format(f'{100 * rollout.hand_distance[frame]:.1f} cm')}"
