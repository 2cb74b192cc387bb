"""Films and plots of viewpoint runs, and runs with a simulated hand, as a user types them."""

from __future__ import annotations

import csv
import shutil
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from commandline import records, surgbench

from surgbench.camera import Camera
from surgbench.records.reader import read_records
from surgbench.report.rows import read_rows
from surgbench.report.video_options import VideoOptions
from surgbench.reproduce.published import load_published
from surgbench.tasks.viewpoint.film.eyes import OUTLINE
from surgbench.tasks.viewpoint.film.film import make_film, plan
from surgbench.tasks.viewpoint.film.raster import Canvas, Mesh
from surgbench.tasks.viewpoint.hand_page import difference
from surgbench.tasks.viewpoint.records import ViewpointRecord
from surgbench.viewpoint.hand.measures import PERFORMANCE
from surgbench.viewpoint.optics.stereo import AUTOCAM_STEREO

STEPS = 150


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One short trial."""
    folder = tmp_path_factory.mktemp("chaser") / "mini"
    surgbench("generate", "wire-chaser-mini", "--sequences", 1, "--frames", STEPS, "--out", folder)
    return folder


@pytest.fixture(scope="module")
def runs(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two controllers on it."""
    out = tmp_path_factory.mktemp("runs")
    surgbench("run", "--dataset", dataset, "--tracker", "gaze", "--tracker", "static", "--out", out)
    return out


def frames_of(video: Path) -> list[np.ndarray]:
    reader = cv2.VideoCapture(str(video))
    found: list[np.ndarray] = []
    while True:
        done, frame = reader.read()
        if not done:
            return found
        found.append(frame)


# The canvas


def test_the_nearer_triangle_wins_and_a_line_behind_it_is_dim() -> None:
    canvas = Canvas(40, 40, (0, 0, 0))
    camera = Camera(width=40, height=40, fx=40, fy=40, cx=19.5, cy=19.5)

    def triangle(depth: float, colour: int) -> None:
        points = np.array([[-0.4, -0.4, 1.0], [0.4, -0.4, 1.0], [0.0, 0.5, 1.0]]) * depth
        mesh = Mesh(points, np.array([[0, 1, 2]], np.int32), np.full((1, 3), colour, np.uint8))
        canvas.triangles(camera.project(points), points[:, 2], mesh, points)

    triangle(2.0, 200)
    triangle(1.0, 100)
    triangle(3.0, 250)
    # Facing the viewer, but for a few degrees off the axis: as light as it is.
    assert 95 <= canvas.picture[15, 20, 0] <= 100
    ends = np.array([[-0.9, 0.0, 2.0], [0.9, 0.0, 2.0]])
    canvas.line(camera.project(ends), ends[:, 2], (255, 255, 255), width=2.0, shown=1.0, hidden=0.0)
    assert 95 <= canvas.picture[19, 20, 0] <= 100
    assert canvas.picture[19, 3, 0] > 200


def test_what_is_behind_the_viewer_or_nowhere_is_not_drawn() -> None:
    canvas = Canvas(20, 20, (0, 0, 0))
    camera = Camera(width=20, height=20, fx=20, fy=20, cx=9.5, cy=9.5)
    for points in (np.array([[-1, -1, -1.0], [1, -1, -1], [0, 1, 1]]), np.full((3, 3), np.nan)):
        mesh = Mesh(points, np.array([[0, 1, 2]], np.int32), np.full((1, 3), 200, np.uint8))
        canvas.triangles(camera.project(points), points[:, 2], mesh, points)
        canvas.line(camera.project(points), points[:, 2], (255, 255, 255))
    assert not canvas.picture.any()


# Films


@pytest.mark.slow
def test_a_film_for_each_controller_as_fast_as_it_was(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    surgbench("video", runs, "--out", tmp_path, "--frames", 2)
    printed = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert [path.name for path in printed] == ["000-gaze.mp4", "000-gaze.png", "000-static.mp4", "000-static.png"]
    # 12 frames a second, near enough: every 7th step of 12.6 ms.
    pictures = frames_of(tmp_path / "000-gaze.mp4")
    assert len(pictures) == -(-STEPS // 7)
    assert all(size % 2 == 0 for size in pictures[0].shape[:2])
    reader = cv2.VideoCapture(str(tmp_path / "000-gaze.mp4"))
    assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(1 / (7 * 0.0126), rel=0.01)
    assert np.abs(pictures[0].astype(int) - pictures[-1]).mean() > 0.2  # something moved
    assert cv2.imread(str(tmp_path / "000-gaze.png")) is not None


@pytest.mark.slow
def test_controllers_side_by_side_with_stills(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surgbench(
        *("video", runs, "--side-by-side", "--every", 50, "--fps", 5, "--frames", 3, "--samples", "--out", tmp_path)
    )
    names = [Path(line).name for line in capsys.readouterr().out.splitlines()]
    assert names == ["000.mp4", "000.png", "000-000000.png", "000-000074.png", f"000-{STEPS - 1:06d}.png"]
    assert len(frames_of(tmp_path / "000.mp4")) == 3
    still = cv2.imread(str(tmp_path / "000-000000.png"))
    assert still is not None
    assert still.shape == frames_of(tmp_path / "000.mp4")[0].shape


@pytest.mark.slow
def test_the_ring_is_drawn_where_the_record_says_that_the_picture_has_it(runs: Path) -> None:
    """By geometry, through the lens; the film's pictures are turned upright."""
    (job,) = plan(viewpoint_records(runs), VideoOptions(rows=("gaze",)), None)
    film = make_film(job)
    eyes, step = film._panels[0].eyes, STEPS // 2
    assert eyes.turned
    pixels = np.array(job.records[0].frames.projected_px[step], dtype=np.float64).reshape(2, 2)
    for picture, wanted in zip(eyes.draw(step), pixels, strict=True):
        outline = np.argwhere((np.abs(picture.astype(int) - OUTLINE) < 60).all(axis=2))[:, ::-1]
        scale = eyes.size[0] / AUTOCAM_STEREO.left.width
        there = np.array(eyes.size) - 1 - ((wanted + 0.5) * scale - 0.5)
        assert np.linalg.norm((outline.min(axis=0) + outline.max(axis=0)) / 2 - there) < 3.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--overlay"], "--overlay: cameras do not look from one place"),
        (["--row", "gaez"], "unknown row 'gaez'; did you mean 'gaze'?"),
        (["--unit", "00"], "unknown unit '00'"),
    ],
)
def test_what_cannot_be_drawn_is_told_in_one_line(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    surgbench("video", runs, *arguments, "--out", tmp_path / "film", expect=2)
    error = capsys.readouterr().err.splitlines()
    assert message in error[-1]
    assert not (tmp_path / "film").exists()


@pytest.mark.slow
def test_a_dataset_that_moved_has_to_be_named(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without truth, too: then the ring is where it was measured, and there is no wire."""
    here, moved, out = tmp_path / "here", tmp_path / "moved", tmp_path / "runs"
    shutil.copytree(dataset, here)
    surgbench("run", "--dataset", here, "--tracker", "static", "--frames", 30, "--out", out)
    here.rename(moved)
    surgbench("video", out, "--out", tmp_path / "film", expect=2)
    assert "--dataset PATH" in capsys.readouterr().err
    surgbench("video", out, "--dataset", moved, "--every", 20, "--frames", 1, "--out", tmp_path / "film")
    assert len(frames_of(tmp_path / "film" / "000-static.mp4")) == 2


def viewpoint_records(folder: Path) -> list[ViewpointRecord]:
    return [record for record in read_records([folder]) if isinstance(record, ViewpointRecord)]


# Plots


@pytest.mark.slow
@pytest.mark.extras
def test_plots_over_time_stand_beside_the_table(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    surgbench("report", runs, "--plots", tmp_path / "plots", "--format", "csv")
    captured = capsys.readouterr()
    assert str(tmp_path / "plots" / "000.png") in captured.err
    assert {line["row_id"] for line in csv.DictReader(captured.out.splitlines())} == {"gaze", "static"}
    picture = cv2.imread(str(tmp_path / "plots" / "000.png"))
    assert picture is not None
    assert picture.shape[1] > picture.shape[0] > 800


@pytest.mark.slow
def test_plots_without_matplotlib_are_one_line(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    surgbench("report", runs, "--plots", tmp_path / "plots", expect=2)
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert "figures need Matplotlib" in error[0]
    surgbench("report", runs, "--dataset", tmp_path, expect=2)
    assert "--dataset: is for --plots" in capsys.readouterr().err


# Hands


@pytest.fixture(scope="module")
def hands(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two people with the endoscope, the first seconds of it."""
    out = tmp_path_factory.mktemp("hands")
    surgbench(
        *("run", "--dataset", dataset, "--tracker", "static", "--hand", "endoscope", "--repeats", 2),
        *("--frames", 149, "--out", out),
    )
    return out


@pytest.mark.slow
def test_a_hand_leaves_a_record_of_its_own_way(hands: Path, tmp_path: Path) -> None:
    first, second = records(hands)
    for record in (first, second):
        assert record["status"] == "ok"
        assert (record["spec"]["hand"], record["spec"]["steady"]) == ("endoscope", False)
        assert "a hand by the picture of the endoscope" in record["variant"]
        frames = record["frames"]
        assert {len(frames[name]) for name in ("index", "ring", "contact", "sight", "joints")} == {149}
        assert set(PERFORMANCE) <= set(record["errors"])
    # It waits until the camera has come: nothing has happened yet, and nothing can be said of it.
    assert np.ptp(np.array(first["frames"]["ring"]), axis=0).max() == 0
    assert first["errors"]["task_time_s"] == [None]
    surgbench("video", hands, "--every", 100, "--frames", 1, "--out", tmp_path)
    assert (tmp_path / "000-static-endoscope.mp4").is_file()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--steady"], "--steady: is for a simulated hand; give --hand endoscope or --hand auxiliary"),
        (["--tracker", "remote", "--hand", "endoscope"], "--hand: 'remote' is in another process"),
        (["--hand", "endo"], "'endo' is not one of 'endoscope', 'auxiliary'"),
    ],
)
def test_what_a_hand_cannot_do_is_told_in_one_line(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    surgbench("run", "--dataset", dataset, "--tracker", "static", *arguments, "--out", tmp_path, expect=2)
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert message in error[0]


def test_the_published_figures_of_fig_7() -> None:
    published = load_published("banks2025")
    assert published.value("fig7", "aut", "task_time_s") == 74.26
    assert published.value("fig7", "endo", "contact_s") == 22.08
    assert published.value("fig7", "stat", "collisions") == 21.70


def test_differences_are_paired_by_person_and_wire() -> None:
    """What people and wires differ in goes out of it; an interval about a constant difference is that constant."""
    rng = np.random.default_rng(0)
    lines: list[dict[str, Any]] = []
    for unit in "abcd":
        for person in range(6):
            value = rng.normal(50, 20)
            for row, more in (("endo", 0.0), ("aut", 3.0)):
                lines.append({"row_id": row, "unit": unit, "repeat": person, "task_time_s": value + more})
    assert difference(lines, "aut", "endo", "task_time_s") == pytest.approx((3.0, 3.0, 3.0))
    for line in lines:
        line["task_time_s"] += rng.normal(0, 5.0)
    found = difference(lines, "aut", "endo", "task_time_s")
    assert found is not None
    assert found[1] < found[0] < found[2]
    assert difference(lines[:4], "aut", "endo", "task_time_s") is None  # one wire


TABLE: dict[str, Any] = {
    "title": "Hands",
    "task": "viewpoint",
    "note": "Two of them.",
    "published": "banks2025",
    "quick": {"runs": 1, "frames": 100000},
    "timing": {"runs": 1, "frames": 60},
    "check": {"runs": 2, "frames": 300},
    "figure": {"block": "only", "unit": "000", "rows": ["endo"]},
    "blocks": [
        {
            "name": "only",
            "heading": "The only block",
            "dataset": {"preset": "wire-chaser-mini", "sequences": 2, "frames": STEPS},
            "conditions": {"repeats": 2},
            "quick_sequences": ["000"],
            "rows": [
                {"row_id": "endo", "label": "ENDO", "tracker": "static", "hand": "endoscope", "frames": 149},
                {"row_id": "stat", "label": "STAT", "tracker": "static", "hand": "auxiliary", "frames": 149},
            ],
        }
    ],
}


@pytest.mark.long
def test_a_table_of_hands_is_made_and_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With the disclaimer, the published figures and the differences; a part of it comes out again bit for bit."""
    whole = yaml.safe_load(yaml.safe_dump(TABLE))
    for row in whole["blocks"][0]["rows"]:
        del row["frames"]
    (tmp_path / "hands.yaml").write_text(yaml.safe_dump(whole), encoding="utf-8")
    places = ("--out", tmp_path / "results", "--data", tmp_path / "data", "--jobs", 1)
    surgbench("reproduce", tmp_path / "hands.yaml", *places)
    page = (tmp_path / "results" / "hands" / "leaderboard.md").read_text(encoding="utf-8")
    assert "**No human took part.**" in page
    assert "| *ENDO, Banks et al. 2025* |  | 6 × 5 | 79.8 ± 30.1 | 19.3 ± 6.6 | 22.1 ± 14.5 | 1.07 ± 0.46 |" in page
    assert "### From ENDO" in page
    lines = list(csv.DictReader((tmp_path / "results" / "hands" / "sequences.csv").read_text().splitlines()))
    assert len(lines) == 8
    assert all(float(line["task_time_s"]) > 10 for line in lines)
    surgbench("reproduce", tmp_path / "hands.yaml", *places, "--check")
    assert "identical" in capsys.readouterr().out
    rows = [row for row in read_rows([tmp_path / "results" / "hands" / "records"]) if row.get("hand")]
    assert {row["hand"] for row in rows} == {"endoscope", "auxiliary"}
