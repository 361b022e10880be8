"""`mild-viz evaluate` over several checkpoints: rows, best and median, comparisons, files, and what it refuses."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from mild_viz import cli
from mild_viz.checkpoint import RobotInterface, load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.evaluation.baselines import (
    BASELINES,
    NEIGHBOURS,
    TIME_WEIGHTS,
    Examples,
    fit_nearest,
    leave_one_trial_out,
)
from mild_viz.evaluation.layout import comparison_table, error_table
from mild_viz.evaluation.metrics import Row
from mild_viz.evaluation.report import REFERENCE, Evaluation, evaluate, load_named, measure
from mild_viz.evaluation.runs import best_and_median, over_recorded_seeds
from mild_viz.evaluation.significance import POOLED
from mild_viz.evaluation.tables import latex_text, to_latex, to_markdown
from mild_viz.pairs import check_rate
from mild_viz.paths import default_checkpoint
from mild_viz.settings import VARIANTS
from tests.models import random_checkpoint

SEEDS = ("best", "middle", "worst_1")


@pytest.fixture(scope="module")
def demo() -> Any:
    """The demo set, with two training trials an action: the baselines are no matter here."""
    whole = load_dataset("demo")
    train = [[trial for trial in whole.train if trial.action == action][:2] for action in whole.actions]
    return replace(whole, train=tuple(trial for trials in train for trial in trials))


@pytest.fixture(scope="module")
def several(demo: Any) -> Evaluation:
    """The shipped model, and two random ones that have some of its variants."""
    models = (
        load_checkpoint(default_checkpoint("demo")),
        random_checkpoint(1, ("v1", "v3.1")),
        random_checkpoint(2, ("v1", "v3.1")),
    )
    return measure(dict(zip(SEEDS, models, strict=True)), demo, ("v3.1", "v3.1@best", "v3.2", "constant"))


def error(rows: list[Row], model: str, checkpoint: str | None, action: str) -> float:
    (row,) = [row for row in rows if (row.model, row.checkpoint, row.action) == (model, checkpoint, action)]
    return row.mse_mean


def test_rows_of_several_checkpoints_say_which(several: Evaluation) -> None:
    assert {row.checkpoint for row in several.rows if row.model == "v3.1"} == set(SEEDS)
    assert {row.checkpoint for row in several.rows if row.model in BASELINES} == {None}
    assert "checkpoint" in several.rows[0].as_dict() and "checkpoint" not in several.rows[-1].as_dict()


def test_best_and_median_over_checkpoints(several: Evaluation) -> None:
    found = {(one.model, one.statistic): one for one in several.over_runs if one.source == "checkpoints"}
    assert set(found) == {(model, statistic) for model in ("v1", "v3.1") for statistic in ("best", "median")}
    for action in several.dataset.actions:
        errors = [error(several.rows, "v3.1", seed, action) for seed in SEEDS]
        assert found["v3.1", "median"].errors[action] == pytest.approx(np.median(errors))
        assert found["v3.1", "best"].errors[action] == pytest.approx(errors[0])
    means = {one.checkpoint: one.mean for one in several.measured if one.model == "v3.1"}
    assert found["v3.1", "best"].run == "best" and found["v3.1", "best"].errors["mean"] == pytest.approx(means["best"])
    assert found["v3.1", "median"].errors["mean"] == pytest.approx(np.median(list(means.values())))


def test_best_is_one_run_and_a_diverged_one_is_the_worst() -> None:
    runs = {"a": {"x": 1.0, "y": 9.0}, "b": {"x": 4.0, "y": 2.0}, "c": {"x": float("nan"), "y": 1.0}}
    best, median = best_and_median("made", "v1", runs, "checkpoints")
    assert (best.run, best.errors) == ("b", {"x": 4.0, "y": 2.0, "mean": 3.0})
    assert median.errors == {"x": 4.0, "y": 2.0, "mean": 5.0}  # of (1, 4, inf), (9, 2, 1), (5, 3, inf)


def test_a_variant_of_several_checkpoints_is_compared_by_its_average(several: Evaluation) -> None:
    found = {(one.first, one.second): one for one in several.comparisons if one.action == POOLED}
    names = ["v3.1", "v3.1@best", "v3.2", "constant"]
    assert list(found) == [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    means = {(one.model, one.checkpoint): one.mean for one in several.measured}
    average = np.mean([means["v3.1", seed] for seed in SEEDS])
    assert found["v3.1", "constant"].difference == pytest.approx(average - means["constant", None])
    alone = found["v3.1@best", "constant"]
    assert alone.difference == pytest.approx(means["v3.1", "best"] - means["constant", None])
    assert alone.conclusion == "v3.1@best is better"
    assert found["v3.1", "v3.1@best"].conclusion == "v3.1@best is better"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One run of the command on the shipped demo model, with every file, and a record of two seeds."""
    folder = tmp_path_factory.mktemp("evaluate")
    shutil.copytree(default_checkpoint("demo"), folder / "my_model")
    config = json.loads((folder / "my_model/config.json").read_text())
    test = config["metrics"]["test"]
    config["metrics"]["test_seeds"] = [test, [{**row, "mse_mean": 3 * row["mse_mean"]} for row in test]]
    (folder / "my_model/config.json").write_text(json.dumps(config))
    files = {suffix: folder / f"result.{suffix}" for suffix in ("json", "csv", "md", "tex")}
    options = [("--json", "json"), ("--csv", "csv"), ("--markdown", "md"), ("--latex", "tex")]
    arguments = [part for option, suffix in options for part in (option, str(files[suffix]))]
    assert cli.main(["evaluate", "--checkpoint", str(folder / "my_model"), *arguments]) == 0
    return {suffix: file.read_text(encoding="utf-8") for suffix, file in files.items()}


def test_the_json_holds_rows_and_comparisons(written: dict[str, Any]) -> None:
    content = json.loads(written["json"])
    assert set(content["rows"][0]) == {"dataset", "model", "action", "mse_mean", "mse_std", "n_windows", "n_trials"}
    assert {row["model"] for row in content["rows"]} == {*VARIANTS, *BASELINES}
    mean = pd.DataFrame(content["rows"]).groupby("model").mse_mean.mean()
    assert mean["v3.1"] < 0.5 * mean["constant"]
    pairs = {(one["first"], one["second"]) for one in content["comparisons"]}
    assert pairs == {(variant, REFERENCE) for variant in VARIANTS}
    single = next(one for one in content["comparisons"] if one["action"] == "wave")
    assert (single["n_trials"], single["smallest_p"], single["conclusion"]) == (4, 0.125, "too few trials")
    best = [one for one in content["over_runs"] if (one["model"], one["statistic"]) == ("v3.1", "best")]
    recorded = [row["mse_mean"] for row in content["rows"] if row["model"] == "v3.1"]
    assert [one["mse_mean"] for one in best[:-1]] == pytest.approx(recorded, rel=1e-6)
    assert {(one["run"], one["source"]) for one in best} == {("seed 0", "record of my_model")}


def test_the_csv_is_a_table_of_all_errors(written: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(written["csv"], encoding="utf-8")
    table = pd.read_csv(tmp_path / "a.csv")
    rows = json.loads(written["json"])["rows"]
    plain = table.query("statistic.isna() and action != 'mean'")
    np.testing.assert_allclose(plain.mse_mean, [row["mse_mean"] for row in rows])
    of_ridge = table.query("model == 'ridge'").set_index("action").mse_mean
    assert of_ridge["mean"] == pytest.approx(of_ridge.drop("mean").mean())
    median = table.query("model == 'v3.1' and statistic == 'median'").set_index("action")
    v31 = plain.query("model == 'v3.1'").set_index("action").mse_mean
    assert median.mse_mean["wave"] == pytest.approx(2 * v31["wave"], rel=1e-6)  # of one and three times it


def test_the_markdown_is_made_of_whole_tables(written: dict[str, Any]) -> None:
    blocks = [block.splitlines() for block in re.findall(r"(?:^\|.*\n)+", written["md"], re.MULTILINE)]
    assert len(blocks) == 3  # errors, seeds of the record, comparisons
    for lines in blocks:
        assert len({line.count("|") for line in lines}) == 1 and len({len(line) for line in lines}) == 1
        assert re.fullmatch(r"[|\-: ]+", lines[1])
    rows = {(row["model"], row["action"]): row for row in json.loads(written["json"])["rows"]}
    (ridge,) = [line for line in blocks[0] if line.startswith("| ridge")]
    row = rows["ridge", "wave"]
    assert f"{row['mse_mean']:.4f} ± {row['mse_std']:.4f}" in ridge
    assert "4 trials give no p below 0.12" in written["md"] and "not independent" in written["md"]
    assert "record of my_model" in written["md"]


def test_the_latex_is_balanced_and_escaped(written: dict[str, Any]) -> None:
    text = written["tex"]
    assert "booktabs" in text.splitlines()[0] and text.count(r"\toprule") == 3
    assert [text.count(r"\begin{" + name + "}") for name in ("table*", "tabular")] == [3, 3]
    assert re.findall(r"\\(begin|end)\{", text) == ["begin", "begin", "end", "end"] * 3
    for body in re.findall(r"\\toprule\n(.*?)\\bottomrule", text, re.DOTALL):
        assert len({line.count("&") for line in body.splitlines() if line.endswith(r"\\")}) == 1
    assert r"my\_model" in text and not re.search(r"(?<!\\)[_#^](?!2)|(?<!\\)%(?! needs)|[±²−]", text)
    assert text.count("{") == text.count("}")
    assert latex_text("50 % of a_b < -0.1, p (Holm), 'cm' sign-flip") == (
        r"50 \% of a\_b $<$ $-$0.1, $p$ (Holm), `cm' sign-flip"
    )


def test_a_figure_of_the_paper_is_never_the_one_in_bold() -> None:
    rows = [Row("made", model, "wave", value, 0.1, 10, 2) for model, value in (("v1", 0.2), ("ridge", 0.1))]
    rows.append(Row("made", "paper v1", "wave", 0.01, 0.1, None, None))
    table = error_table(rows, "caption")
    assert [section[0][0] for section in table.sections] == ["v1", "ridge", "paper v1"]
    assert table.bold == {(1, 1), (1, 2)}
    assert "**0.100 ± 0.100**" in to_markdown(table) and r"\textbf{0.100 $\pm$ 0.100}" in to_latex(table, "tab:a")


def test_the_terminal_shows_single_actions_when_pairs_are_asked_for(several: Evaluation) -> None:
    actions = {cell for section in several.tables()[-1].sections for row in section for cell in row[1:2]}
    assert actions == {*several.dataset.actions, POOLED}
    pooled = comparison_table(several.comparisons, "rad²", each_action=False)
    assert sum(map(len, pooled.sections)) == 6 and "wave" not in str(pooled.sections)
    assert not any("Too few" in note for note in pooled.notes)  # 16 trials


# what is refused


def test_another_joint_set_is_refused_by_both_names(demo: Any) -> None:
    ours = random_checkpoint(1, ("v1",))
    yumi = replace(random_checkpoint(2, ("v1",)), robot=RobotInterface("yumi", ("yumi_joint_1_r",), "gripper"))
    with pytest.raises(UserError, match="b predicts yumi_joint_1_r: their errors cannot"):
        measure({"a": ours, "b": yumi}, demo)
    with pytest.raises(UserError, match="no motion for the joints yumi_joint_1_r"):
        measure({"b": yumi}, demo)


def test_another_rate_is_refused_by_both_rates(demo: Any) -> None:
    for rate in (None, 30.0, 30.1):
        check_rate(rate, "model", demo.test)
    with pytest.raises(UserError, match="checkpoint model was trained on 8 Hz, trial demo/test/0 has 30 Hz"):
        check_rate(8.0, "model", demo.test)


def test_unknown_names_are_refused(demo: Any) -> None:
    models = {"a": random_checkpoint(1, ("v1",)), "b": random_checkpoint(2, ("v1",))}
    with pytest.raises(UserError, match="--compare 'v9' is unknown; valid: v1, v1@a, v1@b, constant, .*knn-time"):
        measure(models, demo, ("v9", "ridge"))
    with pytest.raises(UserError, match="two different names"):
        measure(models, demo, ("ridge", "ridge"))


@pytest.mark.parametrize("record", [3, [1], [[{"model": "v1"}]], [[{"dataset": "demo", "model": "v1"}]], [["text"]]])
def test_a_record_of_another_form_is_refused(record: Any) -> None:
    model = replace(random_checkpoint(), metrics={"test_seeds": record})
    with pytest.raises(UserError, match=r"config.json: metrics.test_seeds is not a list over seeds"):
        over_recorded_seeds("model", model, "demo")


def test_a_record_of_another_dataset_is_left_out() -> None:
    rows = [Row("nuisi", "v1", "wave", 0.1, 0.0, 10, 2).as_dict()]
    model = replace(random_checkpoint(), metrics={"test_seeds": [rows, rows]})
    assert over_recorded_seeds("model", model, "demo") == []
    assert len(over_recorded_seeds("model", model, "nuisi")) == 2


def test_folders_of_one_name_are_told_apart_by_their_paths(tmp_path: Path) -> None:
    for parent in ("a", "b"):
        shutil.copytree(default_checkpoint("demo"), tmp_path / parent / "model")
    paths = [tmp_path / "a/model", tmp_path / "b/model", tmp_path / "b/../b/model", default_checkpoint("demo")]
    assert list(load_named(paths)) == [str(paths[0]), str(paths[2]), "demo"]


def test_nothing_is_written_where_something_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="'v9' is unknown"):
        evaluate([default_checkpoint("demo")], "demo", ("v9", "v1"), json=tmp_path / "a.json")
    assert list(tmp_path.iterdir()) == []


# nearest neighbours with elapsed time


def timed_examples() -> Examples:
    """Human windows of noise; the partner follows the time alone, slightly shifted in every trial."""
    generator = np.random.default_rng(0)
    step = np.tile(np.arange(80), 5)
    trial = np.repeat(np.arange(5), 80)
    partner = np.stack([np.sin(step / 12 + 0.1 * trial), np.cos(step / 12)], axis=1)
    return Examples(generator.normal(size=(400, 6)), partner, step, trial)


def test_time_is_a_coordinate_as_wide_as_the_whole_window() -> None:
    train = timed_examples()
    scale = np.sqrt(train.human.var(0).sum()) / train.step.std()
    for weight in (0.0, 0.7):
        predicted = fit_nearest(train, 5, weight)(train)
        points = np.column_stack([train.human, weight * scale * train.step])
        for row in range(0, 400, 40):
            nearest = np.argsort(((points - points[row]) ** 2).sum(1))[:5]
            np.testing.assert_allclose(predicted[row], train.partner[nearest].mean(0))


def test_k_and_time_weight_are_chosen_by_leaving_trials_out() -> None:
    train = timed_examples()
    scores = {
        (weight, k): leave_one_trial_out(train, lambda rest, w=weight, k=k: fit_nearest(rest, k, w))
        for weight in TIME_WEIGHTS
        for k in NEIGHBOURS
    }
    weight, k = min(scores, key=lambda pair: scores[pair])
    assert weight > 0 and scores[weight, k] < 0.2 * min(scores[0.0, k] for k in NEIGHBOURS)
    np.testing.assert_allclose(BASELINES["knn-time"](train)(train), fit_nearest(train, k, weight)(train))
