"""The checkpoint folder: what is written is read back; what is wrong is named."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from mild_viz.checkpoint import (
    Checkpoint,
    check_checkpoint_target,
    load_checkpoint,
    save_checkpoint,
    save_contact_states,
)
from mild_viz.errors import UserError
from mild_viz.robot.placement import Meeting
from mild_viz.settings import VARIANTS, Placement
from tests.disk import full_disk
from tests.models import random_checkpoint

MEETING = Meeting((0.8, -0.1, -0.2), (0.5, 0.1, 0.2), "test")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "model"
    places = {"placement": Placement(0.9, 0.1, 0.2, "test", True), "meeting": MEETING}
    save_checkpoint(replace(random_checkpoint(), **places), path, "# model\n")
    return path


def test_what_is_saved_is_loaded(folder: Path) -> None:
    original, loaded = random_checkpoint(), load_checkpoint(folder)
    assert loaded.variants == original.variants and loaded.actions == original.actions
    assert loaded.placement == Placement(0.9, 0.1, 0.2, "test", True) and loaded.meeting == MEETING
    assert loaded.contact_states == original.contact_states
    x = np.random.default_rng(0).normal(size=(3, 90))
    np.testing.assert_array_equal(loaded.human_vae.encode(x)[0], original.human_vae.encode(x)[0])
    for action in original.actions:
        np.testing.assert_array_equal(
            loaded.hmm(action).emission_covariances, original.hmm(action).emission_covariances
        )


def test_saving_again_replaces_the_whole_folder(folder: Path) -> None:
    save_contact_states(load_checkpoint(folder), "v3.1", "wave", frozenset({1}))
    save_checkpoint(random_checkpoint(1, ("v3.1",)), folder, "# new\n")
    assert sorted(p.name for p in folder.iterdir()) == ["README.md", "config.json", "weights.safetensors"]
    assert load_checkpoint(folder).variants == ("v3.1",)
    assert [p.name for p in folder.parent.iterdir()] == ["model"]


@pytest.mark.parametrize("limit", [2000, 20_000])
def test_a_disk_that_fills_up_in_mid_save_leaves_the_old_folder(folder: Path, limit: int) -> None:
    before = content(folder)
    with full_disk(limit), pytest.raises(UserError, match="model cannot be written: .*File too large"):
        save_checkpoint(random_checkpoint(1), folder, "# new\n" + 100_000 * "x")
    assert content(folder) == before and load_checkpoint(folder).name == "random"
    assert [p.name for p in folder.parent.iterdir()] == ["model"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("step", [1, 2])
def test_a_failing_swap_brings_the_old_folder_back(
    folder: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, step: int
) -> None:
    before, moves = content(folder), []
    move = os.replace

    def replace_until(source: Path, target: Path) -> None:
        moves.append(target)
        if len(moves) == step:
            raise error
        move(source, target)

    monkeypatch.setattr("mild_viz.files.os.replace", replace_until)
    with pytest.raises((UserError, KeyboardInterrupt)):
        save_checkpoint(random_checkpoint(1), folder, "")
    assert content(folder) == before
    assert [p.name for p in folder.parent.iterdir()] == ["model"]


def test_a_failing_write_leaves_the_old_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("mild_viz.checkpoint.folder.save_file", full)
    with pytest.raises(UserError, match=r"model cannot be written: No space"):
        save_checkpoint(random_checkpoint(1), folder, "")
    assert load_checkpoint(folder).name == "random"
    assert [p.name for p in folder.parent.iterdir()] == ["model"]


def content(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_saving_returns_what_loading_gives(tmp_path: Path) -> None:
    saved = save_checkpoint(random_checkpoint(), tmp_path / "a" / "model", "")
    assert saved.path == tmp_path / "a" / "model" and saved.actions == load_checkpoint(saved.path).actions


def test_a_broken_model_does_not_replace_a_good_one(folder: Path) -> None:
    before, model = content(folder), random_checkpoint(1)
    broken = replace(model.hmms["wave"], emission_means=np.full((6, 10), np.nan))
    with pytest.raises(UserError, match=r"model is left as it was, the new model is not valid: .*emission_means"):
        save_checkpoint(replace(model, hmms={**model.hmms, "wave": broken}), folder, "")
    assert content(folder) == before and [p.name for p in folder.parent.iterdir()] == ["model"]


@pytest.mark.parametrize("name", ["thesis.txt", "weights.safetensors/photo.png", ".git/HEAD"])
def test_a_folder_with_anything_else_is_not_replaced(folder: Path, name: str) -> None:
    precious = folder / name
    if precious.parent.is_file():
        precious.parent.unlink()
    precious.parent.mkdir(exist_ok=True)
    precious.write_text("precious")
    for attempt in (check_checkpoint_target, lambda out: save_checkpoint(random_checkpoint(1), out, "")):
        with pytest.raises(UserError, match=rf"model is not a checkpoint folder.* holds {name.split('/')[0]}"):
            attempt(folder)
    assert precious.read_text() == "precious"


@pytest.mark.parametrize("config", [None, "{}", '{"schema_version": 2}', "[1]", "{"])
def test_a_folder_with_another_config_is_not_replaced(tmp_path: Path, config: str | None) -> None:
    (tmp_path / "README.md").write_text("my project")
    if config is not None:
        (tmp_path / "config.json").write_text(config)
    with pytest.raises(UserError, match=r"no config\.json with schema_version 1|config\.json is not valid JSON"):
        check_checkpoint_target(tmp_path)


def test_places_for_a_checkpoint(folder: Path, tmp_path: Path) -> None:
    check_checkpoint_target(tmp_path / "absent" / "model")
    (tmp_path / "empty").mkdir()
    check_checkpoint_target(tmp_path / "empty")
    (folder / "contact_states.json").write_text('{"wave": [1]}')
    check_checkpoint_target(folder)
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "model", tmp_path / ("x" * 300), Path("/proc/x")):
        with pytest.raises(UserError, match=str(place)):
            save_checkpoint(random_checkpoint(), place, "")


def edit_config(folder: Path, **changes: Any) -> None:
    file = folder / "config.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def edit_tensors(folder: Path, edit: Callable[[dict[str, np.ndarray]], None]) -> None:
    tensors = load_file(folder / "weights.safetensors")
    edit(tensors)
    save_file(tensors, folder / "weights.safetensors")


@pytest.mark.parametrize(
    ("name", "shape"),
    [("human/encoder.0.weight", (40, 91)), ("robot/v3.1/output.bias", (19,)), ("hmm/wave/emission_means", (5, 10))],
)
def test_a_wrong_shape_names_the_tensor(folder: Path, name: str, shape: tuple[int, ...]) -> None:
    edit_tensors(folder, lambda tensors: tensors.update({name: np.zeros(shape)}))
    short = name.split("/")[-1]
    with pytest.raises(UserError, match=rf"{short}' has shape .*, expected") as error:
        load_checkpoint(folder)
    assert str(shape) in str(error.value)


def test_a_missing_tensor_is_named(folder: Path) -> None:
    edit_tensors(folder, lambda tensors: tensors.__delitem__("human/output.bias"))
    with pytest.raises(UserError, match=r"tensor 'output\.bias' is missing"):
        load_checkpoint(folder)


def test_values_that_are_not_finite_are_named(folder: Path) -> None:
    edit_tensors(folder, lambda tensors: tensors.update({"human/output.bias": np.full(90, np.nan)}))
    with pytest.raises(UserError, match="not finite"):
        load_checkpoint(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schema_version": 99}, "schema_version is 99"),
        ({"window": 8}, "window is 8 observations, this program works with 5"),
        ({"actions": ["hug"]}, "action 'hug' is unknown; valid: wave"),
        ({"variants": {"v9": {}}}, "variants 'v9' is unknown; valid: v1"),
        ({"schema_version": [1]}, r"schema_version is \[1\]"),
        ({"window": "5"}, "window is '5' observations, this program works with 5"),
        ({"hidden": "wide"}, r"hidden is 'wide', expected a list"),
        ({"hidden": [40]}, r"hidden is \[40\], expected the widths of two layers"),
        ({"hidden": [40, float("inf")]}, "hidden is inf, expected a whole number from 1"),
        ({"hidden": [40, 20.5]}, r"hidden is 20\.5, expected a whole number"),
        ({"n_states": float("inf")}, "n_states is inf, expected a whole number"),
        ({"n_states": "6"}, "n_states is '6', expected a whole number"),
        ({"n_states": 0}, "n_states is 0, expected a whole number"),
        ({"latent_size": 10**4000}, "latent_size is 1000.*, expected a whole number"),
        ({"latent_size": True}, "latent_size is True, expected a whole number"),
        ({"name": 5}, "name is 5, expected a text"),
        ({"dataset": "demo"}, "dataset is 'demo', expected an object"),
        ({"dataset": {}}, "dataset: missing name"),
        ({"actions": []}, r"actions is \[\], expected one name or more"),
        ({"actions": "wave"}, "actions is 'wave', expected a list"),
        ({"actions": [["wave"]]}, r"actions: an entry is \['wave'\], expected a text"),
        ({"actions": ["wave", "wave"]}, "expected one name or more, each once"),
        ({"robot": {"name": "pepper"}}, "robot: missing joint_names, end_effector"),
        ({"robot": {"name": "pepper", "joint_names": "abcd", "end_effector": "x"}}, "joint_names is 'abcd', expected"),
        ({"variants": ["v1"]}, r"variants is \['v1'\], expected an object"),
        ({"variants": {}}, "variants is empty; a model that drives pepper has one or more of: v1"),
        ({"variants": {"v1": {}}}, r"variants\.v1 was trained as \{\}, here it means \{'name': 'v1'"),
        ({"variants": {"v1": []}}, r"variants\.v1 is \[\], expected an object"),
        ({"variants": {"v1": {**asdict(VARIANTS["v1"]), "more": 1}}}, r"variants\.v1 was trained as .*'more'"),
        ({"contact_states": None}, "contact_states is None, expected an object"),
        ({"contact_states": [1]}, r"contact_states is \[1\], expected an object"),
        ({"contact_states": {"wave": [99]}}, r"wave: states \[99\] do not exist; valid: 0 to 5"),
        ({"contact_states": {"dance": [1]}}, "action 'dance' is unknown; valid: wave"),
        ({"placement": {"distance": "far", "lateral": 0, "height": 0}}, r"distance is 'far', expected a finite number"),
        ({"placement": {"distance": float("nan"), "lateral": 0, "height": 0}}, "distance is nan, expected a finite"),
        ({"placement": {"distance": 10**4000, "lateral": 0, "height": 0}}, "distance is 10.*, expected a finite"),
        (
            {"placement": {"distance": 200, "lateral": 0, "height": 0}},
            r"placement: distance is 200\.0; valid: a number",
        ),
        ({"placement": {"distance": 1}}, "placement: missing lateral, height"),
        (
            {"placement": {"distance": 1, "lateral": 0, "height": 0, "yaw": 0}},
            "placement: yaw unknown; valid: distance",
        ),
        ({"placement": 5}, "placement is 5, expected an object"),
        ({"meeting": {"partner": [1, 0, 0]}}, "meeting: missing human, source"),
        ({"points": ["right_wrist"]}, r"points is \['right_wrist'\], expected .* or right_wrist, left_wrist"),
        ({"workspace": []}, r"workspace is \[\], expected a box for each of right_wrist, left_wrist"),
        (
            {"meeting": {"partner": [1, 0], "human": [1, 0, 0], "source": ""}},
            r"meeting\.partner is .*, expected three numbers",
        ),
        (
            {"meeting": {"partner": [0, 0, 0], "human": [1, 0, 0], "source": ""}},
            "meeting: partner is .*0.0.*; valid: .* apart from the shoulder",
        ),
        ({"training": None}, "training is None, expected an object"),
        ({"robot": {"name": "yumi", "joint_names": list("abcdefg"), "end_effector": "x"}}, "shape"),
    ],
)
def test_a_wrong_config_is_named(folder: Path, changes: dict[str, Any], message: str) -> None:
    edit_config(folder, **changes)
    with pytest.raises(UserError, match=message):
        load_checkpoint(folder)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"n_states": ' + "9" * 5000 + "}", "[1]", "null", "\xff"])
@pytest.mark.parametrize("name", ["config.json", "contact_states.json"])
def test_strange_json_is_named(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(text, encoding="latin-1")
    with pytest.raises(UserError, match=rf"{name}.* (is not valid JSON|expected an object)"):
        load_checkpoint(folder)


@pytest.mark.parametrize(
    "text",
    ['{"wave": "123"}', '{"wave": {"1": 2}}', '{"wave": [1.7]}', '{"wave": [true]}', '{"wave": [1e400]}'],
)
def test_contact_states_are_lists_of_whole_numbers(folder: Path, text: str) -> None:
    edit_config(folder, contact_states=json.loads(text))
    with pytest.raises(UserError, match=r"config\.json: contact_states: wave is .*, expected"):
        load_checkpoint(folder)
    edit_config(folder, contact_states={})
    (folder / "contact_states.json").write_text(text)
    with pytest.raises(UserError, match=r"contact_states\.json: wave is .*, expected"):
        load_checkpoint(folder)


@pytest.mark.parametrize("kind", ["BF16", "F8_E4M3", "U64", "Q7"])
def test_strange_number_types_are_named(folder: Path, kind: str) -> None:
    header = json.dumps({"human/output.bias": {"dtype": kind, "shape": [0], "data_offsets": [0, 0]}}).encode()
    (folder / "weights.safetensors").write_bytes(len(header).to_bytes(8, "little") + header)
    with pytest.raises(UserError, match=r"weights\.safetensors"):
        load_checkpoint(folder)


def test_a_place_that_cannot_be_is_refused() -> None:
    assert Placement(0.9, -99.0, 0.0).lateral == -99.0
    for value in (float("nan"), float("inf"), 100.0, -1e9):
        with pytest.raises(UserError, match="lateral is .*; valid: a number of metres between -100 and 100"):
            Placement(0.9, value, 0.0)


def test_broken_files_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not a checkpoint"):
        load_checkpoint(tmp_path / "nothing")
    weights = (folder / "weights.safetensors").read_bytes()
    for cut in (b"", weights[: len(weights) // 2]):
        (folder / "weights.safetensors").write_bytes(cut)
        with pytest.raises(UserError, match=r"weights\.safetensors is not a readable"):
            load_checkpoint(folder)
    (folder / "config.json").write_text("{")
    with pytest.raises(UserError, match=r"config\.json is not valid JSON"):
        load_checkpoint(folder)


def test_unknown_variant_and_action_list_the_valid_ones() -> None:
    model = random_checkpoint(variants=("v1", "v3.1"))
    with pytest.raises(UserError, match=r"'v3\.2' is unknown; valid: v1, v3\.1"):
        model.members("v3.2")
    with pytest.raises(UserError, match="'handover' is unknown; valid: wave"):
        model.hmm("handover")


def saved_model(folder: Path) -> Checkpoint:
    return load_checkpoint(folder)


def test_saved_contact_states_are_the_default_next_time(folder: Path) -> None:
    before = (folder / "weights.safetensors").read_bytes(), (folder / "config.json").read_bytes()
    updated = save_contact_states(saved_model(folder), "v3.1", "handshake", frozenset({4}))
    assert updated.contact_states["handshake"] == frozenset({4})
    save_contact_states(updated, "v3.1", "rocket", frozenset())
    again = saved_model(folder)
    assert again.contact_states == {"handshake": frozenset({4}), "rocket": frozenset()}
    assert before == ((folder / "weights.safetensors").read_bytes(), (folder / "config.json").read_bytes())


def test_invalid_contact_states_are_refused(folder: Path) -> None:
    with pytest.raises(UserError, match=r"states \[6\] do not exist; valid: 0 to 5"):
        save_contact_states(saved_model(folder), "v3.1", "handshake", frozenset({6}))
    (folder / "contact_states.json").write_text('{"handshake": [17]}')
    with pytest.raises(UserError, match=r"contact_states\.json.*\[17\] do not exist"):
        saved_model(folder)


def test_a_folder_that_cannot_be_written_says_so(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError(13, "Permission denied")

    model = saved_model(folder)
    monkeypatch.setattr("mild_viz.files.os.replace", refuse)
    with pytest.raises(UserError, match=r"contact_states\.json cannot be written: Permission denied"):
        save_contact_states(model, "v3.1", "handshake", frozenset({1}))
    assert not (folder / "contact_states.json").exists()
    assert not list(folder.glob(".*"))


# --- variants with models of their own


def own_folder(tmp_path: Path) -> Path:
    path = tmp_path / "own"
    save_checkpoint(
        replace(random_checkpoint(n_own=2), own_contact_states={"v4": {"wave": frozenset({5})}}), path, "#\n"
    )
    return path


def test_own_models_are_loaded_as_saved(tmp_path: Path) -> None:
    original, loaded = random_checkpoint(n_own=2), load_checkpoint(own_folder(tmp_path))
    assert loaded.variants == (*original.robot_vaes, "v4") and loaded.rate == 30.0
    for before, after in zip(original.members("v4"), loaded.members("v4"), strict=True):
        assert after.layout == before.layout
        for action in original.actions:
            np.testing.assert_array_equal(after.regressions[action].gain, before.regressions[action].gain)
            np.testing.assert_array_equal(after.hmms[action].emission_means, before.hmms[action].emission_means)
        z = np.random.default_rng(0).normal(size=(3, 5))
        np.testing.assert_array_equal(after.robot_vae.decode(z), before.robot_vae.decode(z))
    assert loaded.members("v4")[0].hmms["wave"] is not loaded.hmms["wave"]


def test_contact_states_of_own_models_are_kept_apart(tmp_path: Path) -> None:
    folder = own_folder(tmp_path)
    loaded = load_checkpoint(folder)
    assert loaded.contact_states_of("v4", "wave") == {5} and loaded.contact_states_of("v3.1", "handshake") == {2, 3}
    assert loaded.contact_states_of("v4", "handshake") == frozenset()
    save_contact_states(loaded, "v4", "handshake", frozenset({1}))
    again = save_contact_states(load_checkpoint(folder), "v1", "handshake", frozenset({4}))
    for checkpoint in (again, load_checkpoint(folder)):
        assert checkpoint.contact_states_of("v4", "handshake") == {1}
        assert checkpoint.contact_states_of("v4", "wave") == {5}
        assert checkpoint.contact_states_of("v3.2", "handshake") == {4}


def edited(folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    config = json.loads((folder / "config.json").read_text())
    change(config)
    (folder / "config.json").write_text(json.dumps(config))
    return folder


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["own_models"].pop("v4"), r"own_models is about nothing, expected v4"),
        (lambda c: c["own_models"]["v4"].update(n_models=3), r"v4/2/human: tensor 'encoder.0.weight' is missing"),
        (lambda c: c["own_models"]["v4"].update(lags=[3]), r"regression/wave/gain' has shape \(6, 5, 31\), expected"),
        (lambda c: c["own_models"]["v4"].update(lags=[0]), r"v4.lags is 0, expected a whole number"),
        (lambda c: c["own_models"]["v4"].update(clock=-1), r"clock is -1.0; valid: a number from 0 to 100"),
        (lambda c: c.update(rate=0), r"rate is 0.0, expected frames a second"),
        (lambda c: c.update(own_contact_states={"v3.1": {}}), r"own_contact_states 'v3.1' is unknown; valid: v4"),
    ],
)
def test_what_is_wrong_with_own_models_is_named(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        load_checkpoint(edited(own_folder(tmp_path), change))
