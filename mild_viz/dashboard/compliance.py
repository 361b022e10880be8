"""The page's third stage: simulate how the arm gives way, after the rollout is shown, and show that too."""

from __future__ import annotations

from collections.abc import Callable

from mild_viz.dashboard.scene.compliance import compliance_frames
from mild_viz.dashboard.scene.scene import Scene
from mild_viz.dashboard.session import Choice
from mild_viz.dashboard.tabs.compliance import ComplianceTab
from mild_viz.dashboard.timeline import Timeline
from mild_viz.errors import UserError
from mild_viz.rollout import Rollout
from mild_viz.simulation.compare import Comparison, compare


class ComplianceStage:
    """Runs in the session's worker. What was simulated of the rollout that is shown is kept, by scenario."""

    def __init__(self, scene: Scene, tab: ComplianceTab, timeline: Timeline) -> None:
        self._scene, self._tab, self._timeline = scene, tab, timeline
        self._rollout: Rollout | None = None
        self._found: dict[str, Comparison] = {}
        self.n_simulated = 0

    def run(self, rollout: Rollout, choice: Choice, is_stale: Callable[[], bool]) -> bool:
        """Simulate what is asked for and show it; False if a newer choice came first, and nothing was shown.

        A robot that cannot be simulated, or a missing package, is said in the tab: the rollout itself is fine.
        """
        if rollout is not self._rollout:
            self._rollout, self._found = rollout, {}
        wanted = choice.view.compliance
        if wanted is None:
            self._tab.say("")
            self._timeline.show_force(None)
            return True
        try:
            if wanted.scenario not in self._found:
                self._tab.say("Simulating …")
                self._found[wanted.scenario] = compare(choice.robot, rollout, wanted.scenario)
                self.n_simulated += 1
        except UserError as error:
            self._tab.say(f"Not simulated: {error}.")
            self._timeline.show_force(None)
            return True
        if is_stale():
            return False
        comparison = self._found[wanted.scenario]
        self._scene.show_compliance(compliance_frames(choice.robot, rollout, comparison, wanted.stiffness))
        self._tab.show(comparison)
        self._timeline.show_force(comparison)
        return True
