"""The viewpoint task as a user runs it: records, rows, tables, and what goes wrong."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commandline import AMPLE_S, STRANGERS, records, surgbench

from surgbench.dataset.open import open_dataset
from surgbench.generation import GenerationRequest
from surgbench.generators.dispatch import plan_preset
from surgbench.generators.resumable import generate
from surgbench.processes.child import Child
from surgbench.report.column import ROW, VARIANT
from surgbench.report.field import keys
from surgbench.report.leaderboard import set_columns
from surgbench.report.render import table
from surgbench.report.rows import read_rows
from surgbench.reproduce.load import load_table
from surgbench.reproduce.table import Block, DatasetRequest
from surgbench.suite import running
from surgbench.tasks.viewpoint.dataset import ViewpointDataset
from surgbench.tasks.viewpoint.records import ViewpointFrames, ViewpointRecord
from surgbench.tasks.viewpoint.rows import VIEWPOINT_COLUMNS
from surgbench.tasks.viewpoint.worker import ViewpointSetup
from surgbench.viewpoint.scores import naive_violations
from surgbench.viewpoint.simulator import make_scene

SAMPLES = 260


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short trials."""
    folder = tmp_path_factory.mktemp("chaser") / "mini"
    surgbench("generate", "wire-chaser-mini", "--sequences", 2, "--frames", SAMPLES, "--out", folder)
    return folder


@pytest.fixture(scope="module")
def runs(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Our controller and the article's on both."""
    out = tmp_path_factory.mktemp("runs")
    surgbench("run", "--dataset", dataset, "--tracker", "gaze", "--tracker", "autocam", "--jobs", 2, "--out", out)
    return out


@pytest.mark.slow
def test_a_record_holds_the_course_and_its_errors(dataset: Path, runs: Path) -> None:
    found = records(runs)
    assert len(found) == 4
    for record in found:
        assert (record["status"], record["unit_frames"]) == ("ok", SAMPLES)
        assert record["spec"]["task"] == "viewpoint"
        frames, errors = record["frames"], record["errors"]
        # No picture was taken, and no hand led the ring.
        missing = {"tags_px", "ring", "contact", "sight"}
        assert set(frames) == set(ViewpointFrames.model_fields) - missing
        assert set(errors) == set(ViewpointRecord.error_names) - set(ViewpointRecord.whole)
        assert {len(values) for values in [*frames.values(), *errors.values()]} == {SAMPLES}
        assert np.isfinite(np.array(frames["joints"])).all()
        assert max(frames["joint_limit_deg"]) <= 0.0
    # The same samples are constrained for both controllers, and they are those of the naive pose.
    data = open_dataset(dataset)
    assert isinstance(data, ViewpointDataset)
    for record in found:
        trial = data.trial(record["spec"]["unit"])
        expected = naive_violations(trial, make_scene(trial)).any
        np.testing.assert_array_equal(np.array(record["frames"]["rules"]) != 0, expected)


@pytest.mark.slow
def test_a_part_of_a_dataset_is_its_trials_alone_and_the_same(dataset: Path, tmp_path: Path) -> None:
    """What --quick and --check make: the second trial, without the first."""
    plan = plan_preset("wire-chaser-mini", GenerationRequest(sequences=2, frames=SAMPLES, part=(("001",), 100)))
    generate(plan, tmp_path, progress=lambda frames: None)
    part, whole = open_dataset(tmp_path), open_dataset(dataset)
    assert [unit.sequence for unit in part.units()] == ["001"]
    assert part.manifest.configuration["part"] == ["001"]
    assert part.manifest.files.items() <= whole.manifest.files.items()


QUICK = load_table("autocam").table


@pytest.mark.long
@pytest.mark.parametrize("block", QUICK.blocks, ids=lambda block: block.name)
def test_rules_bind_in_what_a_quick_run_shows(block: Block, tmp_path: Path) -> None:
    """And in some samples none does, and in some the naive pose is out of reach or too near: no table is empty."""
    assert isinstance(block.dataset, DatasetRequest)
    plan = plan_preset(block.dataset.preset, GenerationRequest(part=(block.quick_sequences, QUICK.quick.frames)))
    generate(plan, tmp_path, progress=lambda frames: None)
    data = open_dataset(tmp_path)
    assert isinstance(data, ViewpointDataset)
    trial = data.trial(block.quick_sequences[0])
    found = naive_violations(trial, make_scene(trial), QUICK.quick.frames)
    assert min(found.any.sum(), (~found.any).sum(), found.solver.sum()) >= 50


@pytest.mark.slow
def test_rows_are_of_subsets_that_make_up_the_whole(runs: Path) -> None:
    rows = [row for row in read_rows([runs]) if row["row_id"] == "gaze" and row["camera"] is None]
    by_subset = {row["subset"]: row for row in rows if row["subset"] not in ("solver", "optimised")}
    assert list(by_subset) == ["all", "unconstrained", "constrained"]
    whole, free, bound = by_subset.values()
    assert whole["samples"] == 2 * SAMPLES == free["samples"] + bound["samples"]
    assert whole["constrained_percent"] == pytest.approx(100 * bound["samples"] / whole["samples"])
    assert set(keys(VIEWPOINT_COLUMNS)) <= set(whole)
    assert whole["no_go_samples"] == whole["joint_limit_samples"] == whole["clipped_commands"] == 0
    assert free["no_go_samples"] is None  # rules are of whole runs
    own = [record["frames"] for record in records(runs) if record["spec"]["row_id"] == "gaze"]
    times = np.concatenate([np.array(frames["latency_ms"])[np.array(frames["rules"]) != 0] for frames in own])
    assert bound["latency_ms_mean"] == pytest.approx(times.mean())
    of_gaze = [record["frames"] for record in records(runs) if record["spec"]["row_id"] == "gaze"]
    deepest = max(max(frames["floor_mm"]) for frames in of_gaze)
    assert whole["floor_deepest_mm"] == pytest.approx(max(deepest, 0.0))
    # Where the base really is, the camera was lower or higher than it is said to have been.
    assert all(np.ptp(np.subtract(frames["floor_mm_true"], frames["floor_mm"])) > 1e-3 for frames in of_gaze)
    assert whole["visibility_any_percent"] == whole["framed_any_percent"] == 100.0
    assert whole["visibility_any_percent_low"] == 100.0


@pytest.mark.slow
def test_the_same_again_runs_nothing_and_another_run_gives_the_same_course(
    dataset: Path, runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in runs.rglob("*-r*.json")}
    surgbench("run", "--dataset", dataset, "--tracker", "gaze", "--out", runs)
    assert "0 runs, 0 frames to track; 2 recorded already" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in runs.rglob("*-r*.json")} == before
    surgbench("run", "--dataset", dataset, "--tracker", "gaze", "--frames", 120, "--sequences", 1, "--out", tmp_path)
    (short,) = records(tmp_path)
    whole = next(r for r in records(runs) if r["spec"]["row_id"] == "gaze" and r["spec"]["unit"] == "000")
    assert short["frames"]["setpoint"] == whole["frames"]["setpoint"][:120]
    assert short["variant"] == "first 120 frames"


@pytest.mark.slow
def test_pictures_agree_with_geometry(dataset: Path, tmp_path: Path) -> None:
    """The ring's centre by the tags in rendered pictures is where the true poses have it."""
    surgbench(
        *("run", "--dataset", dataset, "--tracker", "gaze", "--sequences", 1, "--photographs", 2, "--out", tmp_path)
    )
    (record,) = records(tmp_path)
    tags = record["frames"]["tags_px"]
    taken = [step for step, found in enumerate(tags) if found is not None]
    assert taken == list(range(0, SAMPLES, 40))
    found = np.array([tags[step] for step in taken], dtype=np.float64)
    projected = np.array([record["frames"]["projected_px"][step] for step in taken], dtype=np.float64)
    assert np.isfinite(found).mean() > 0.9
    assert np.nanmedian(np.abs(found - projected)) < 2.0
    rows = {(row["pixels"], row["camera"]): row for row in read_rows([tmp_path]) if row["camera"] is not None}
    assert set(rows) == {(source, camera) for source in ("tags", "projected") for camera in ("left", "right", "any")}
    for camera in ("left", "right"):
        by_tags, by_geometry = (rows[source, camera]["l2_error_px"] for source in ("tags", "projected"))
        assert by_tags == pytest.approx(by_geometry, abs=15.0)
    # The right camera is 26.5 mm beside the point that is controlled.
    assert rows["projected", "right"]["u_error_px"] > rows["projected", "left"]["u_error_px"] + 50.0


# What was lost of a feature that is always seen, where the mean over trials lies, and on what it ran.
FURTHER = (
    "time_lost_share", "losses", "regained", "vva_deg_low", "vva_deg_high", "latency_reference_ms", "processor",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("form", ["table", "csv", "markdown", "json"])
def test_reports(runs: Path, form: str, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench("report", runs, "--format", form)
    out = capsys.readouterr().out
    assert "gaze" in out
    assert "autocam" in out
    if form == "csv":
        lines = list(csv.DictReader(out.splitlines()))
        assert tuple(lines[0]) == (*keys(VIEWPOINT_COLUMNS), *FURTHER)
        assert {line["subset"] for line in lines} >= {"all", "unconstrained", "constrained"}
    elif form == "json":
        assert set(json.loads(out)[0]) == {*keys(VIEWPOINT_COLUMNS), *FURTHER}
    else:
        assert "VVA" in out


@pytest.mark.slow
@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_the_table_of_any_width_has_every_column_and_each_line_its_name(runs: Path, width: int) -> None:
    rows = [row for row in read_rows([runs]) if row["subset"] == "all" and row["camera"] is None]
    text = table(rows, width)
    assert max(map(len, text.splitlines())) <= width
    for row in rows:
        named = " ".join(line for line in text.splitlines() if line.split()[:1] == [row["row_id"]])
        cells = [column.cell(row) for column in set_columns(rows) if column not in (ROW, VARIANT)]
        assert [word for word in named.split() if word != row["row_id"]][: len(cells)] == cells


@pytest.mark.slow
def test_registration_and_the_missing_face_are_settings(dataset: Path, runs: Path, tmp_path: Path) -> None:
    """A rigid registration brings the true view nearer to the reported one."""
    surgbench(
        *("run", "--dataset", dataset, "--tracker", "gaze", "--registration", "rigid", "--missing-face"),
        *("--out", tmp_path),
    )
    (rigid,) = [row for row in read_rows([tmp_path]) if row["subset"] == "all" and row["camera"] is None]
    (published,) = [
        row for row in read_rows([runs]) if row["subset"] == "all" and row["row_id"] == "gaze" and row["camera"] is None
    ]
    assert rigid["registration"] == "rigid"
    assert rigid["missing_face"] is True
    assert "registration rigid" in rigid["variant"]
    assert rigid["settings_hash"] != published["settings_hash"]
    assert rigid["pf_true_deg"] < published["pf_true_deg"]


class PatientChild(Child):
    """Waits as long as it is told to for the controller that hangs, and for the others as long as they take."""

    def send(self, *message: Any) -> None:
        if isinstance(message[0], ViewpointSetup) and message[0].tracker.name != "dozing":
            self.timeout_s = AMPLE_S
        super().send(*message)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "status", "message", "steps"),
    [
        ("Fainting", "failed", "step 30: ValueError: it is all too much", 30),
        ("Scribbling", "invalid", "step 20: the controller returned a command with NaN or infinity", 20),
        ("Mute", "invalid", "step 0: the controller returned a command with NaN or infinity", 0),
        ("Stumbling", "failed", "step 0: RuntimeError: no", 0),
        ("Dozing", "timeout", "step 0: no answer within 5 s", 0),
    ],
)
def test_a_controller_that_goes_wrong_costs_its_own_row(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, status: str, message: str, steps: int
) -> None:
    monkeypatch.setattr(running, "Child", PatientChild)
    surgbench(
        *("run", "--dataset", dataset, "--tracker", f"{STRANGERS}:{name}", "--tracker", f"{STRANGERS}:Watching"),
        *("--sequences", 1, "--timeout", 5, "--out", tmp_path),
    )
    good, bad = sorted(records(tmp_path), key=lambda record: str(record["status"]) != "ok")
    assert good["status"] == "ok"
    assert {row["tracker"] for row in read_rows([tmp_path])} == {"watching", name.lower()}
    assert (bad["status"], bad["error"]) == (status, message)
    assert len(bad["frames"].get("index", [])) == steps


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--tracker", "cmaes"], "tracker 'cmaes' is for the instrument task; this dataset is of the viewpoint task"),
        (["--tracker", "gaze", "--initialiser", "random"], "'initialiser' is for the instrument task"),
        (["--tracker", "gaze", "--arms", "dual"], "--device and --arms are for the instrument task"),
        (["--tracker", "gaez"], "unknown tracker 'gaez'; did you mean 'gaze'?"),
        (["--tracker", "gaze", "--set", "gaze.patience=1"], "gaze.patience"),
    ],
)
def test_what_does_not_fit_is_told_in_one_line(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    surgbench("run", "--dataset", dataset, *arguments, "--out", tmp_path / "runs", expect=2)
    error = capsys.readouterr().err
    assert message.split(".")[-1] in error
    assert len(error.strip().splitlines()) == 1


TABLE: dict[str, Any] = {
    "title": "A tiny table",
    "task": "viewpoint",
    "published": "banks2025",
    "quick": {"runs": 1, "frames": 60},
    "timing": {"runs": 1, "frames": 60},
    "check": {"runs": 1, "frames": 80},
    "figure": {"block": "only", "unit": "000", "rows": ["gaze", "watching"]},
    "blocks": [
        {
            "name": "only",
            "heading": "The only block",
            "dataset": {"preset": "wire-chaser-mini", "sequences": 2, "frames": 200},
            "quick_sequences": ["000"],
            "rows": [
                {
                    **{"row_id": "gaze", "label": "Gaze", "tracker": "gaze", "photographs_hz": 5.0},
                    **{"against": "watching", "floor": "watching"},
                },
                {"row_id": "watching", "label": "Watching", "tracker": f"{STRANGERS}:Watching"},
            ],
        }
    ],
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reproduced table."""
    folder = tmp_path_factory.mktemp("reproduce")
    (folder / "tiny.yaml").write_text(yaml.safe_dump(TABLE), encoding="utf-8")
    reproduce(folder)
    return folder


def reproduce(folder: Path, *arguments: object, expect: int = 0) -> None:
    places = ("--out", folder / "results", "--data", folder / "data", "--jobs", 1)
    surgbench("reproduce", folder / "tiny.yaml", *places, *arguments, expect=expect)


@pytest.mark.slow
def test_a_table_stands_beside_the_published_figures(made: Path) -> None:
    folder = made / "results" / "tiny"
    page = (folder / "leaderboard.md").read_text(encoding="utf-8")
    # The article's lines, as printed.
    assert "| *Banks et al. 2025* |  | 75463 | 1.71 ± 1.54 | 4.98 ± 5.00 | 0.34 ± 0.21 | 30.39 ± 37.68 |" in page
    assert "| *Banks et al. 2025* |  | 14720 | 4.38 ± 2.11 | 1.95 ± 5.66 | 0.03 ± 0.05 | 10.10 ± 24.22 |" in page
    rows = list(csv.DictReader((folder / "leaderboard.csv").read_text().splitlines()))
    gaze = next(row for row in rows if row["row_id"] == "gaze" and row["subset"] == "all" and not row["camera"])
    assert f"| Gaze | `gaze` | 400 | {float(gaze['vva_deg']):.2f} ± {float(gaze['vva_deg_std']):.2f} |" in page
    lines = list(csv.DictReader((folder / "sequences.csv").read_text().splitlines()))
    own = [float(line["vva_deg"]) for line in lines if line["row_id"] == "gaze"]
    assert float(gaze["vva_deg"]) == pytest.approx(np.mean(own))
    # Rules, and what two trials say of the difference from the row that it is held against.
    assert "| Gaze | `gaze` | reported | 0 |" in page
    other = [float(line["vva_deg"]) for line in lines if line["row_id"] == "watching"]
    assert float(gaze["vva_deg_difference"]) == pytest.approx(np.mean(own) - np.mean(other))
    difference, low, high = (float(gaze[f"vva_deg_difference{end}"]) for end in ("", "_low", "_high"))
    assert f"| Gaze | `gaze` | `watching` | {difference:.2f} [{low:.2f}, {high:.2f}] |" in page
    assert float(gaze["regret"]) < 0
    tags = next(row for row in rows if row["pixels"] == "tags" and row["camera"] == "any")
    assert f"{float(tags['visibility_any_percent']):.2f} [" in page


@pytest.mark.slow
def test_a_table_can_be_checked_and_a_slip_of_the_hand_is_found(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reproduce(made, "--check")
    assert "identical" in capsys.readouterr().out
    shutil.copy(made / "tiny.yaml", tmp_path)
    shutil.copytree(made / "results", tmp_path / "results")
    file = tmp_path / "results" / "tiny" / "sequences.csv"
    file.write_text(file.read_text().replace("gaze,only,000,0,ok,200,", "gaze,only,000,0,ok,200,1", 1))
    reproduce(tmp_path, "--check", expect=1)
    assert "its files do not agree" in capsys.readouterr().out


@pytest.mark.slow
def test_quick_tables_are_short(made: Path) -> None:
    reproduce(made, "--quick")
    page = (made / "results" / "tiny-quick" / "leaderboard.md").read_text(encoding="utf-8")
    assert "not to be quoted" in page
    assert "| Gaze | `gaze` | 60 |" in page


@pytest.mark.slow
@pytest.mark.extras
def test_figures_are_drawn_where_matplotlib_is(made: Path) -> None:
    pytest.importorskip("matplotlib")
    folder = made / "results" / "tiny"
    for name in ("figure.png", "paths.png", "centroids.png", "pixels.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
        assert name in (folder / "leaderboard.md").read_text(encoding="utf-8")
