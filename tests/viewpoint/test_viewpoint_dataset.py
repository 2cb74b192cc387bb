"""Datasets of the viewpoint task on disk: what goes in comes out, and what is damaged is said in one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commandline import surgbench

from surgbench.camera import Camera
from surgbench.dataset import tables
from surgbench.dataset.manifest import MANIFEST_NAME, FileEntry, observations_path
from surgbench.dataset.open import open_as, open_dataset
from surgbench.dataset.storage import file_entry
from surgbench.dataset.validate import validate
from surgbench.errors import DatasetError
from surgbench.generators.generate import plan_dataset
from surgbench.generators.presets import Preset
from surgbench.generators.resumable import generate
from surgbench.generators.wire_chaser.job import WirePlan
from surgbench.generators.wire_chaser.presets import Measurement, Rules, WireChaser
from surgbench.generators.wire_chaser.trial import make_trial
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.tasks.viewpoint.format import feature_path, scene_path
from surgbench.viewpoint.simulator import make_scene

PRESET = WireChaser(
    task="viewpoint",
    name="small",
    trials=2,
    samples=200,
    level="custom",
    share=(0.0, 1.0),
    measurement=Measurement(dropout=0.02),
    rules=Rules(distance_m=0.12, floor_m=0.03),
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "small"
    generate(WirePlan(PRESET), out)
    return out


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "small")
    return tmp_path / "small"


def change_manifest(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    path = folder / MANIFEST_NAME
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def replace_file(folder: Path, file: str, data: bytes) -> None:
    """Put other bytes there as if they had always been."""
    (folder / file).write_bytes(data)
    entry: FileEntry = file_entry(data)
    change_manifest(folder, lambda manifest: manifest["files"].update({file: entry.model_dump()}))


def change_table(folder: Path, file: str, change: Callable[[dict[str, Any]], None]) -> None:
    import io

    from pyarrow import parquet

    table = parquet.read_table(io.BytesIO((folder / file).read_bytes()), use_threads=False, pre_buffer=False)
    values = {name: table.column(name).to_numpy().copy() for name in table.column_names if name != tables.FRAME}
    change(values)
    replace_file(folder, file, tables.encode_table(values))


def test_what_was_made_is_read(made: Path) -> None:
    dataset = open_as(ViewpointDataset, made)
    assert (dataset.name, dataset.task, [trial.id for trial in dataset.trials]) == (
        "small",
        "viewpoint",
        ["000", "001"],
    )
    assert [unit.sequence for unit in dataset.units()] == ["000", "001"]
    assert dataset.sequence("001").frames == 200
    for trial_id in ("000", "001"):
        trial, original = dataset.trial(trial_id), make_trial(PRESET, trial_id)
        for name in ("timestamps_s", "T_world_base", "zone_m", "start"):
            np.testing.assert_array_equal(getattr(trial, name), getattr(original, name))
        np.testing.assert_array_equal(trial.touches.world_m, original.touches.world_m)
        np.testing.assert_array_equal(trial.touches.base_m, original.touches.base_m)
        np.testing.assert_allclose(trial.T_world_feature, original.T_world_feature, atol=1e-12)
        np.testing.assert_array_equal(trial.measured, original.measured)
        assert trial.truth is not None
        assert original.truth is not None
        np.testing.assert_allclose(trial.truth.T_world_feature, original.truth.T_world_feature, atol=1e-12)
        np.testing.assert_array_equal(trial.truth.T_world_base, original.truth.T_world_base)
        np.testing.assert_array_equal(trial.truth.contact, original.truth.contact)
        assert trial.truth.wire is not None
        assert original.truth.wire is not None
        np.testing.assert_array_equal(trial.truth.wire.points_m, original.truth.wire.points_m)
        assert trial.truth.wire.ring_radius_m == original.truth.wire.ring_radius_m
    assert 0 < np.mean([trial.measured.mean() for trial in map(dataset.trial, ("000", "001"))]) < 1


def test_the_rules_of_a_trial_reach_the_controller(made: Path) -> None:
    scene = make_scene(open_as(ViewpointDataset, made).trial("000"))
    assert scene.distance_m == 0.12
    assert scene.workspace.floor_m == 0.03
    assert scene.workspace.proximity_m == 0.08


def test_each_reader_reads_its_own_task_and_one_opens_both(made: Path, tmp_path: Path, small_camera: Camera) -> None:
    masks = tmp_path / "masks"
    generate(plan_dataset(Preset(name="masks", pairs=1, frames=2, camera=small_camera)), masks)
    with pytest.raises(DatasetError, match=r"small: a dataset of the viewpoint task; expected one of the instrument"):
        open_as(InstrumentDataset, made)
    with pytest.raises(DatasetError, match=r"masks: a dataset of the instrument task; expected one of the viewpoint"):
        open_as(ViewpointDataset, masks)
    for path, task, own in ((made, "viewpoint", ViewpointDataset), (masks, "instrument", InstrumentDataset)):
        opened = open_dataset(path)
        assert isinstance(opened, own)
        assert opened.task == opened.manifest.task == task
        assert opened.hash == open_as(own, path).hash


def test_an_unknown_task_is_one_line(copy: Path) -> None:
    change_manifest(copy, lambda manifest: manifest.update(task="suturing"))
    with pytest.raises(DatasetError, match=r"'task': unknown task 'suturing' \(valid: instrument, viewpoint\)"):
        open_dataset(copy)


def test_validate_as_a_user_types_it(made: Path, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("validate", made)
    assert "sound; 'small', 2 trials, 400 samples, 6 files, hash " in capsys.readouterr().out
    (copy / "notes.txt").write_text("mine")
    (copy / scene_path("001")).unlink()
    surgbench("validate", copy, expect=2)
    problems = capsys.readouterr().err
    assert f"{copy / 'notes.txt'}: extra" in problems
    assert f"{copy / scene_path('001')}: " in problems


def test_unknown_trials_are_named(made: Path) -> None:
    with pytest.raises(DatasetError, match="unknown trial '002'; did you mean '00"):
        open_as(ViewpointDataset, made).trial("002")


@pytest.mark.parametrize("file", [observations_path("000"), feature_path("000"), scene_path("000")])
def test_damaged_files_are_named_by_reader_and_validator(copy: Path, file: str) -> None:
    path = copy / file
    whole = path.read_bytes()
    for data, what in ((whole[:-9], "truncated"), (whole[:-1] + bytes([whole[-1] ^ 1]), "altered"), (None, "missing")):
        if data is None:
            path.unlink()
        else:
            path.write_bytes(data)
        with pytest.raises(DatasetError) as caught:
            open_as(ViewpointDataset, copy).trial("000")
        assert str(caught.value).startswith(f"{path}: ")
        assert what in str(caught.value)
        assert validate(copy) == [str(caught.value)]
        open_as(ViewpointDataset, copy).trial("001")


def problem_of(folder: Path) -> str:
    """The one problem that the validator finds and the reader raises."""
    problems = validate(folder)
    with pytest.raises(DatasetError) as caught:
        open_as(ViewpointDataset, folder).trial("000")
    assert problems == [str(caught.value)]
    assert "\n" not in problems[0]
    return problems[0]


def test_a_gap_in_time_names_trial_and_row(copy: Path) -> None:
    def later(values: dict[str, Any]) -> None:
        values[tables.TIMESTAMP][120:] += 0.0126

    change_table(copy, observations_path("000"), later)
    assert "trial '000': row 120: a gap in time, 0.0252 s after the row before; expected" in problem_of(copy)


def test_a_clock_that_drifts_is_not_uniform(copy: Path) -> None:
    def slow(values: dict[str, Any]) -> None:
        values[tables.TIMESTAMP] *= 1.001  # each step is good enough, their sum is not

    change_table(copy, observations_path("000"), slow)
    assert "trial '000': row 11: a gap in time" in problem_of(copy)


@pytest.mark.parametrize(
    ("file", "column", "value", "message"),
    [
        (observations_path("000"), tables.TIMESTAMP, np.nan, "row 7: 'timestamp_s' is not a finite number"),
        (observations_path("000"), "feature_x_m", np.inf, "row 7: the feature's pose is not finite"),
        (observations_path("000"), "feature_rx_rad", 4.0, "row 7: the feature's pose is not finite, or its rotation"),
        (feature_path("000"), "feature_x_m", np.nan, "row 7: the feature's pose is not finite"),
        (feature_path("000"), "contact", 0.5, "row 7: 'contact' must be 0 or 1"),
    ],
)
def test_impossible_numbers_name_trial_and_row(copy: Path, file: str, column: str, value: float, message: str) -> None:
    def spoil(values: dict[str, Any]) -> None:
        for name in values:  # whole, whatever dropped out
            values[name][7] = values[name][6] if np.isfinite(values[name][6]) else 0.0
        values[tables.TIMESTAMP if tables.TIMESTAMP in values else column][7] = 7 * 0.0126
        values[column][7] = value

    change_table(copy, file, spoil)
    assert f"{copy / file}: trial '000': {message}" in problem_of(copy)


def test_a_table_of_another_length_is_said(copy: Path) -> None:
    change_manifest(copy, lambda manifest: manifest["trials"][0].update(samples=201))
    with pytest.raises(DatasetError, match=r"has 200 rows; expected one per frame, 201"):
        open_as(ViewpointDataset, copy).trial("000")
    assert len(validate(copy)) == 2  # observations and truth


def test_a_zone_that_spans_nothing_and_a_start_beyond_the_limits_are_said(copy: Path) -> None:
    def line(manifest: dict[str, Any]) -> None:
        manifest["trials"][0]["zone_m"] = [[0.01 * k, 0.0, 0.0] for k in range(5)]

    change_manifest(copy, line)
    assert problem_of(copy).startswith(f"{copy}: trial '000': the no-go zone's base points are collinear")
    whole = json.loads((copy / MANIFEST_NAME).read_text())["trials"][1]["zone_m"]

    def too_deep(manifest: dict[str, Any]) -> None:
        manifest["trials"][0]["zone_m"] = whole
        manifest["trials"][0]["start"][2] = -0.01

    change_manifest(copy, too_deep)
    assert "trial '000': start joint 3 is -0.01, outside its limits [0, 0.24]" in problem_of(copy)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("T_world_base", [2.0, *[0.0] * 15], "T_world_base is not a rotation and a translation"),
        ("preferred_side", [1.0, 1.0, 0.0], "preferred_side must be of unit length"),
        ("touches", {"world_m": [[0, 0, 0]], "base_m": []}, "world_m has 1 points and base_m 0"),
        ("id", "../escape", "'trials.0.id'"),
        ("dt_s", 0.0, "'trials.0.dt_s'"),
        ("colour", "red", "'trials.0.colour'"),
    ],
)
def test_a_wrong_manifest_is_one_line_that_names_the_key(copy: Path, key: str, value: Any, message: str) -> None:
    change_manifest(copy, lambda manifest: manifest["trials"][0].update({key: value}))
    with pytest.raises(DatasetError) as caught:
        open_as(ViewpointDataset, copy)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_scene_that_is_none_is_said(copy: Path) -> None:
    replace_file(copy, scene_path("000"), b'{"T_world_base": [1]}')
    assert problem_of(copy).startswith(f"{copy / scene_path('000')}: 'T_world_base'")
    replace_file(copy, scene_path("000"), b"{")
    assert problem_of(copy) == f"{copy / scene_path('000')}: not valid JSON"


def test_recordings_have_no_truth(copy: Path) -> None:
    def strip(manifest: dict[str, Any]) -> None:
        for trial in manifest["trials"]:
            trial["truth"] = False
        manifest["files"] = {name: entry for name, entry in manifest["files"].items() if not name.startswith("truth/")}

    change_manifest(copy, strip)
    shutil.rmtree(copy / "truth")
    assert validate(copy) == []
    assert open_as(ViewpointDataset, copy).trial("000").truth is None
