"""The session reruns what depends on a change and nothing else; the latest settings win; failures break nothing."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest
from dashboard_fakes import make_checkpoint, make_choice, make_inference, make_rollout, with_view

from mild_viz.checkpoint import Checkpoint
from mild_viz.dashboard.session import Choice, Pipeline, Session
from mild_viz.errors import UserError
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Inference, Rollout
from mild_viz.settings import ControlSettings
from mild_viz.trial import Trial


class Bench:
    """A session whose widgets are the field `choice`, and whose pipeline is invented and may be slow or fail."""

    def __init__(self) -> None:
        self.choice = make_choice(make_checkpoint())
        self.shown: list[tuple[Rollout, Choice, bool]] = []
        self.reports: list[str | None] = []
        self.controlled: list[ControlSettings] = []
        self.infer_hook: Callable[[], None] = lambda: None
        self.control_hook: Callable[[ControlSettings], None] = lambda settings: None
        self.session = Session(
            lambda: self.choice,
            Pipeline(self.infer, self.control),
            lambda rollout, choice, is_new: self.shown.append((rollout, choice, is_new)),
            self.reports.append,
        )

    def infer(self, checkpoint: Checkpoint, trial: Trial, variant: str, robot: RobotModel) -> Inference:
        self.infer_hook()
        return make_inference(trial=trial.index, variant=variant)

    def control(
        self, inference: Inference, checkpoint: Checkpoint, robot: RobotModel, trial: Trial, settings: ControlSettings
    ) -> Rollout:
        self.control_hook(settings)
        self.controlled.append(settings)
        return make_rollout(inference, settings.controller)

    def choose(self, **control: Any) -> None:
        settings = replace(self.choice.settings, control=replace(self.choice.settings.control, **control))
        self.choice = replace(self.choice, settings=settings)
        self.session.mark_dirty()

    def settle(self) -> None:
        assert self.session.wait_idle(10.0)

    @property
    def counts(self) -> tuple[int, int, int]:
        return self.session.n_infer, self.session.n_control, len(self.shown)


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    bench.session.start()
    bench.settle()
    yield bench
    bench.session.close()


def test_the_first_rollout_comes_by_itself(bench: Bench) -> None:
    assert bench.counts == (1, 1, 1)
    rollout, choice, is_new = bench.shown[0]
    assert is_new and rollout is bench.session.rollout and choice is bench.choice
    assert bench.session.error is None and bench.reports == []


def test_a_control_setting_reruns_only_the_control(bench: Bench) -> None:
    before = bench.shown[-1][0]
    bench.choose(lambda_x=7.0)
    bench.settle()
    assert bench.counts == (1, 2, 2)
    rollout, _, is_new = bench.shown[-1]
    assert not is_new and rollout.inference is before.inference
    assert bench.controlled[-1].lambda_x == 7.0


def test_a_view_setting_reruns_nothing(bench: Bench) -> None:
    before = bench.session.rollout
    bench.choice = with_view(bench.choice, sigma=3.0)
    bench.session.mark_dirty()
    bench.settle()
    assert bench.counts == (1, 1, 2)
    assert bench.session.rollout is before and bench.shown[-1][1].view.sigma == 3.0


def test_no_change_does_nothing(bench: Bench) -> None:
    for _ in range(5):
        bench.session.mark_dirty()
        bench.settle()
    assert bench.counts == (1, 1, 1)


@pytest.mark.parametrize("change", [{"trial": 3}, {"variant": "v1"}])
def test_trial_and_variant_rerun_everything(bench: Bench, change: dict[str, Any]) -> None:
    bench.choice = make_choice(bench.choice.checkpoint, **change)
    bench.session.mark_dirty()
    bench.settle()
    assert bench.counts == (2, 2, 2)
    assert bench.shown[-1][2]


def test_another_model_reruns_everything_but_new_defaults_of_the_same_do_not(bench: Bench) -> None:
    bench.choice = replace(bench.choice, checkpoint=replace(bench.choice.checkpoint, contact_states={}))
    bench.session.mark_dirty()
    bench.settle()
    assert bench.counts == (1, 1, 1)
    bench.choice = replace(bench.choice, checkpoint=make_checkpoint())
    bench.session.mark_dirty()
    bench.settle()
    assert bench.counts == (2, 2, 2)


def test_a_failure_is_reported_and_leaves_the_last_good_rollout(bench: Bench) -> None:
    good = bench.session.rollout

    def refuse(settings: ControlSettings) -> None:
        if settings.lambda_q == 5.0:
            raise UserError("lambda_q of 5 is refused")

    bench.control_hook = refuse
    bench.choose(lambda_q=5.0)
    bench.settle()
    assert bench.reports == ["lambda_q of 5 is refused"] and bench.session.error == "lambda_q of 5 is refused"
    assert bench.session.rollout is good and len(bench.shown) == 1
    bench.choose(lambda_q=0.1)
    bench.settle()
    assert bench.reports[-1] is None and bench.session.error is None
    assert bench.session.rollout is not good and len(bench.shown) == 2


def test_going_back_to_what_is_shown_clears_the_message_without_a_rerun(bench: Bench) -> None:
    def refuse(settings: ControlSettings) -> None:
        if settings.lambda_q == 5.0:
            raise UserError("refused")

    bench.control_hook = refuse
    bench.choose(lambda_q=5.0)
    bench.settle()
    bench.choose(lambda_q=0.01)
    bench.settle()
    assert bench.session.error is None and bench.reports == ["refused", None]
    assert len(bench.shown) == 1


def test_an_unforeseen_exception_is_reported_too(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    def crash(settings: ControlSettings) -> None:
        raise ZeroDivisionError("by zero")

    bench.control_hook = crash
    bench.choose(lambda_q=5.0)
    bench.settle()
    assert bench.reports == ["ZeroDivisionError: by zero"]
    assert "the session's rerun failed" in caplog.text
    bench.control_hook = lambda settings: None
    bench.choose(lambda_q=6.0)
    bench.settle()
    assert bench.session.error is None


def test_a_dragged_slider_neither_floods_nor_blocks(bench: Bench) -> None:
    """200 changes while each rerun takes 30 ms: few reruns, never two at once, none out of order, the last one wins."""
    running = threading.Lock()

    def slow(settings: ControlSettings) -> None:
        assert running.acquire(blocking=False), "two reruns at once"
        time.sleep(0.03)
        running.release()

    bench.control_hook = slow
    longest = 0.0
    for i in range(200):
        start = time.perf_counter()
        bench.choose(lambda_x=1.0 + i)
        longest = max(longest, time.perf_counter() - start)
        time.sleep(0.001)
    bench.settle()
    weights = [settings.lambda_x for settings in bench.controlled[1:]]
    assert weights == sorted(weights) and weights[-1] == 200.0
    assert len(weights) < 40
    assert longest < 0.05
    assert bench.session.choice is bench.choice


def test_a_control_change_during_inference_is_taken_along(bench: Bench) -> None:
    bench.infer_hook = lambda: bench.choose(lambda_x=9.0) if bench.session.n_infer == 2 else None
    bench.choice = make_choice(bench.choice.checkpoint, trial=1)
    bench.session.mark_dirty()
    bench.settle()
    assert bench.session.n_infer == 2, "the inference did not depend on it"
    assert bench.session.n_control == 2 and bench.controlled[-1].lambda_x == 9.0


def test_a_trial_chosen_during_inference_replaces_it(bench: Bench) -> None:
    def change() -> None:
        if bench.session.n_infer == 2:
            bench.choice = make_choice(bench.choice.checkpoint, trial=2)
            bench.session.mark_dirty()

    bench.infer_hook = change
    bench.choice = make_choice(bench.choice.checkpoint, trial=1)
    bench.session.mark_dirty()
    bench.settle()
    assert [rollout.inference.trial for rollout, _, _ in bench.shown] == [0, 2], (
        "trial 1 was outdated before it was done"
    )
    assert bench.session.n_control == 2


def test_a_view_that_cannot_be_drawn_is_tried_again(bench: Bench) -> None:
    """What failed while drawing does not count as shown."""
    failures = iter([True, False])
    draw = bench.session._show

    def show(rollout: Rollout, choice: Choice, is_new: bool) -> None:
        if next(failures):
            raise UserError("cannot draw")
        draw(rollout, choice, is_new)

    bench.session._show = show
    bench.choose(lambda_x=3.0)
    bench.settle()
    assert bench.session.error == "cannot draw" and bench.session.choice is not bench.choice
    bench.session.mark_dirty()
    bench.settle()
    assert bench.session.error is None and bench.session.choice is bench.choice


def test_close_ends_the_worker() -> None:
    bench = Bench()
    bench.session.start()
    bench.settle()
    bench.session.close()
    assert not bench.session._thread.is_alive()
