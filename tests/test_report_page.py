"""The report page: what it holds, that it stands alone, that names cannot break it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timezone
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from mild_viz import cli
from mild_viz.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from mild_viz.data import load
from mild_viz.errors import UserError
from mild_viz.evaluation.baselines import BASELINES
from mild_viz.evaluation.page import report
from mild_viz.evaluation.page.figures import principal_plane
from mild_viz.evaluation.page.measure import measure_groups
from mild_viz.evaluation.page.render import render
from mild_viz.pairs import stack_windows
from mild_viz.paths import default_checkpoint
from mild_viz.prediction import predict
from mild_viz.trial import Dataset, Trial
from tests.models import random_checkpoint

HOSTILE = "<img src=x onerror=alert(1)> & $x$"
VOID = {"meta", "img", "br", "hr", "link", "input"}


class Page(HTMLParser):
    """Collects what the tests look at, and that every element is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.captions: list[str] = []
        self.tags: dict[str, int] = {}
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] = self.tags.get(tag, 0) + 1
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src", "xlink:href", "action")]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self.open:
            return
        self.words.append(data)
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[-1][-1][-1] += data.strip()
        elif "caption" in self.open:
            self.captions.append(data)

    def column(self, table: int) -> list[str]:
        """The first column of a table."""
        return [line[0] for line in self.tables[table]]


@pytest.fixture(scope="module")
def small() -> Dataset:
    """Two training trials and one test trial of each action of the demo set."""
    source = load.load_dataset("demo")

    def first(trials: tuple[Trial, ...], n: int) -> tuple[Trial, ...]:
        return tuple(t for action in source.actions for t in [t for t in trials if t.action == action][:n])

    return replace(source, train=first(source.train, 2), test=first(source.test, 1))


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """The statistics have tests of their own."""
    monkeypatch.setattr("mild_viz.evaluation.significance.N_RESAMPLES", 99)


@pytest.fixture()
def small_demo(small: Dataset, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The demo set stands for few trials: the page has the same parts, in a fraction of the time."""
    monkeypatch.setattr("mild_viz.evaluation.page.render.load_dataset", lambda name: small)
    yield


def human_human(checkpoint: Checkpoint) -> Checkpoint:
    nothing = {"robot_vaes": {}, "own_models": {}, "own_contact_states": {}, "contact_states": {}}
    return replace(checkpoint, robot=None, name="people", placement=None, **nothing)


def test_the_page_holds_all_parts_and_stands_alone(
    small_demo: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "demo.html"
    assert cli.main(["report", "--dataset", "demo", "--out", str(out)]) == 0
    assert "open it in a browser" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["demo.html"]
    text = out.read_text(encoding="utf-8")
    model = load_checkpoint(default_checkpoint("demo"))
    page = Page(text)
    assert set(page.column(0)) >= {*model.variants, *BASELINES}
    captions = " ".join(page.captions)
    for part in ("squared error", "true phases", "same active", "coverage", "Differences", "forward kinem", "touch"):
        assert part in captions, part
    for variant in model.variants:
        assert sum(variant in page.column(table) for table in range(len(page.tables))) >= 5
    assert page.tags["svg"] >= 1 + len(model.actions) + 3 * 4  # curves, latents, three strips of each test trial
    words = " ".join("".join(page.words).split())
    for part in (
        model.dataset_checksum,
        "Read this first",
        str(model.training["command"]),
        f"mild-viz report --dataset demo --out {out}",
        "demo/test/4",
    ):
        assert part in words, part
    assert page.addresses and all(address.startswith("#") for address in page.addresses)
    assert not re.search(r"https?:|url\((?!#)|@import|<script|<link|<iframe", text)
    assert len(text) < 3e6


def test_names_are_shown_as_they_are(small: Dataset) -> None:
    model = load_checkpoint(default_checkpoint("demo"))
    variant = "v3.2"
    hostile = [
        replace(model, name=HOSTILE + end, robot_vaes={variant: model.robot_vaes[variant]}, own_models={})
        for end in ("1", "2")
    ]
    source = replace(small, title=HOSTILE, test=small.test[:1])
    commands = [(f"mild-viz {HOSTILE}", "this page")]
    text = render(measure_groups(hostile, source), hostile, source, commands, datetime(2026, 1, 2, tzinfo=timezone.utc))
    page = Page(text)
    assert "img" not in page.tags and "<img" not in text
    words = "".join(page.words)
    assert words.count(HOSTILE) > 10
    assert f"{variant}@{HOSTILE}1" in page.column(0)
    assert "2026-01-02 00:00 UTC" in words


def test_a_human_human_model_has_a_page(small_demo: None, tmp_path: Path) -> None:
    people = save_checkpoint(human_human(load_checkpoint(default_checkpoint("demo"))), tmp_path / "people", "people")
    out = tmp_path / "both.html"
    report([people.path, default_checkpoint("demo")], "demo", out)
    page = Page(out.read_text(encoding="utf-8"))
    captions = " ".join(page.captions)
    assert "m² × 100" in captions and "rad²" in captions
    assert "second human's wrist" in captions and "hand by forward kinematics" in captions
    assert sum("touch" in caption for caption in page.captions) == 1  # of the robot alone
    assert "Human to second human" in "".join(page.words)


def test_a_variant_with_models_of_its_own_is_measured_alike(small: Dataset) -> None:
    """Its states and contact states are those of its first model, its predictions the average of all."""
    model = random_checkpoint(variants=("v1",), n_own=2)
    (group,) = measure_groups([model], small)
    own = group.models[-1]
    assert [one.label for one in group.models] == list(model.variants) and own.variant not in model.robot_vaes
    for action, (one,) in own.passes.items():
        assert one.hmm is model.members(own.variant)[0].hmms[action]
        trial = stack_windows([one.trial], model.for_robot().joint_names)
        said = predict(model, own.variant, action, trial.human)
        np.testing.assert_array_equal(one.predicted, said.decoded)
        assert np.nanmean(one.errors) == pytest.approx(group.rows[own.label][action].mse_mean)
    assert {one.action for one in own.warnings if one.kind == "no contact state"} == {
        "handshake",
        "rocket",
        "parachute",
    }


def test_a_robot_without_description_leaves_distances_out(small: Dataset) -> None:
    model = load_checkpoint(default_checkpoint("demo"))
    assert model.robot is not None
    other = replace(model, robot=replace(model.robot, name="unheard-of"))
    (group,) = measure_groups([other], replace(small, test=small.test[:1]))
    assert "unheard-of" in group.notes[0]
    assert set(group.models[0].hands.values()) == {None}


def test_a_failing_write_leaves_the_old_page(
    small_demo: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "page.html"
    out.write_text("old")

    def full_disk(self: Path, *args: object, **kwargs: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mild_viz.evaluation.page.render.measure_groups", lambda *args: [])
    monkeypatch.setattr(Path, "write_text", full_disk)
    assert cli.main(["report", "--out", str(out)]) == 2
    assert "No space left" in capsys.readouterr().err
    assert out.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("--out {tmp}/a.pdf", "must end in .html"),
        ("--out {tmp}/none/a.html", "there is no folder"),
        ("--dataset nothing --out {tmp}/a.html", "no model ships for dataset 'nothing'"),
        ("--checkpoint {tmp}/none --out {tmp}/a.html", "is not a checkpoint"),
    ],
)
def test_unusable_input_is_refused(
    arguments: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["report", *arguments.format(tmp=tmp_path).split()]) == 2
    assert expected in " ".join(capsys.readouterr().err.split())
    assert list(tmp_path.iterdir()) == []


def test_a_model_that_does_not_know_the_actions_is_refused(small: Dataset) -> None:
    model = load_checkpoint(default_checkpoint("demo"))
    narrow = replace(model, hmms={"wave": model.hmms["wave"]})
    with pytest.raises(UserError, match="handshake"):
        measure_groups([narrow], small)


def test_the_principal_plane_is_that_of_the_largest_variance() -> None:
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(5, 5)))[0]
    points = rng.normal(size=(4000, 5)) * (3.0, 2.0, 0.1, 0.1, 0.1) @ basis.T + 7.0
    mean, plane, share = principal_plane(points)
    np.testing.assert_allclose(mean, points.mean(0))
    np.testing.assert_allclose(np.abs(plane @ basis[:, :2]), np.eye(2), atol=0.05)
    np.testing.assert_allclose(share, np.array([9.0, 4.0]) / 13.03, atol=0.03)
