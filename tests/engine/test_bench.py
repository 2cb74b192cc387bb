"""The comparison with other renderers: what it reports, what it skips, and that all of them see the same thing."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support import resting_state
from typer.testing import CliRunner

from surgbench.camera import Camera
from surgbench.cli import app
from surgbench.comparison import silhouettes
from surgbench.comparison.peers import PEERS, Peer
from surgbench.comparison.peers.body import Body
from surgbench.comparison.process import RendererProcess, own_cores
from surgbench.comparison.silhouettes import QUICK, check_threads, compare
from surgbench.comparison.workload import TRUE_STATE, silhouette_workload
from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray
from surgbench.instrument import load_instrument
from surgbench.rendering import backends as mitsuba_backends
from surgbench.silhouette import Reference, SilhouetteEvaluator

BASE_INSTALL = {"scanline", "opencv", "mitsuba-scalar"}
# Everything but OpenGL computes edges in floating point; its drawers round vertices to 1/256 pixel or less.
TOLERANCE_PX = {"moderngl": 12}


def bench(*arguments: str) -> Any:
    command = [sys.executable, "-c", "from surgbench.cli import main; main()", "bench", "silhouettes", *arguments]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.fixture(scope="module")
def entries() -> list[dict[str, Any]]:
    """One quick run of everything that is there, as JSON."""
    done = bench("--quick", "--json")
    assert done.returncode == 0, done.stderr
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


@pytest.fixture
def entry(entries: list[dict[str, Any]]) -> dict[str, Any]:
    """With one thread."""
    return entries[0]


@pytest.mark.slow
def test_one_entry_for_each_number_of_threads(entries: list[dict[str, Any]]) -> None:
    cores = len(own_cores())
    assert [one["threads"] for one in entries] == [1, 2][:cores]
    assert ("surgbench, 2 threads" in entries[0]["skipped"]) == (cores < 2)
    assert entries[0]["disagreement_px"] == entries[-1]["disagreement_px"]  # counts and masks are the same
    assert entries[0]["peers"] == entries[-1]["peers"]


@pytest.mark.slow
def test_json_has_the_figures(entry: dict[str, Any]) -> None:
    assert entry["threads"] == 1
    assert entry["us_per_candidate"] > 0
    assert set(entry["peers"]) >= BASE_INSTALL
    assert all(us > 0 for us in entry["peers"].values())
    exact = {name: us for name, us in entry["peers"].items() if PEERS[name].exact and PEERS[name].third_party}
    fastest = min(exact, key=lambda name: exact[name])
    assert entry["fastest_peer"] == fastest
    assert entry["speedup_over_fastest_peer"] == pytest.approx(exact[fastest] / entry["us_per_candidate"], rel=0.01)
    ratio = entry["peers"]["scanline"] / entry["us_per_candidate"]
    assert entry["scanline_ratio"] == pytest.approx(ratio, rel=0.01)
    assert (entry["width"], entry["height"], entry["candidates"]) == (700, 493, QUICK.candidates)


@pytest.mark.slow
def test_every_peer_is_measured_or_skipped_with_a_reason(entry: dict[str, Any]) -> None:
    assert set(entry["peers"]) | set(entry["skipped"]) - {"surgbench, 2 threads"} == set(PEERS)
    assert not set(entry["peers"]) & set(entry["skipped"])
    for reason in entry["skipped"].values():
        assert reason
        assert "\n" not in reason
        assert "failed" not in reason  # what is there must work


@pytest.mark.slow
def test_renderers_agree_on_the_pixels(entry: dict[str, Any]) -> None:
    exact = {name: px for name, px in entry["disagreement_px"].items() if PEERS[name].exact}
    assert entry["max_pixel_disagreement"] == max(exact.values())
    for name, px in exact.items():
        assert px <= TOLERANCE_PX.get(name, 2), name
    # A boundary of this length is touched by hundreds of pixels: none would mean that nothing was compared.
    assert entry["disagreement_px"]["opencv"] > 100


@pytest.fixture(scope="module")
def scanline(small_camera: Camera) -> Peer:
    peer = PEERS["scanline"]()
    peer.prepare(load_instrument("large_needle_driver"), small_camera)
    return peer


angle = st.floats(-np.pi, np.pi)
states = st.tuples(
    angle, angle, angle,
    st.floats(-0.08, 0.08), st.floats(-0.08, 0.08), st.floats(-0.05, 0.25),
    st.floats(-1.57, 1.57), st.floats(-1.39, 1.39), st.floats(0.0, 1.57),
).map(np.array)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=60)
@given(state=states)
@example(state=np.zeros(9))  # the camera inside
def test_scanline_equals_the_engine(scanline: Peer, state: FloatArray) -> None:
    """Two rasterisers that share nothing, at the near plane and behind the camera too."""
    evaluator = SilhouetteEvaluator([scanline.instrument], scanline.camera)
    # A crossing within rounding of a pixel's centre may fall on either side.
    assert np.count_nonzero(scanline.silhouette(state) != evaluator.mask(state)) <= 1


@settings(max_examples=60)
@given(state=states)
@example(state=np.zeros(9))
@example(state=np.array([2.0, 0.0, 0.0, 0.0, 0.00390625, 0.0, 0.0, 0.0, 0.0]))  # a face fills most of the view
def test_window_holds_all_that_is_seen(scanline: Peer, state: FloatArray) -> None:
    """Ray casters cast only its rays."""
    body = Body(scanline.instrument)
    window = body.window(body.place(scanline.instrument.link_transforms(state)), scanline.camera)
    outside = scanline.silhouette(state).copy()
    outside[window] = False
    assert not outside.any()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(PEERS))
def test_timed_counts_are_those_of_the_masks(camera: Camera, name: str) -> None:
    """Area and overlap as timed: with the shaft crossing the camera plane and not, around the camera, behind it."""
    peer_class = PEERS[name]
    # Two LLVMs, one of Mesa and one of Mitsuba, need not get along in one process.
    if name == "mitsuba-llvm" or (reason := peer_class.problem()) is not None:
        pytest.skip("in a process of its own only" if name == "mitsuba-llvm" else str(reason))
    peer = peer_class()
    peer.prepare(load_instrument("large_needle_driver"), camera)
    evaluator = SilhouetteEvaluator([peer.instrument], camera)
    reference = Reference(evaluator.mask(TRUE_STATE))
    peer.aim(reference.mask)
    around = np.array([0.01, 0.02, 0.03, 1e-4, 2e-4, 1e-4, 0.1, 0.2, 0.3])
    some = np.stack([TRUE_STATE, resting_state(), resting_state(0.3), around, resting_state(-0.2)])
    area, overlap = peer.score(some)
    masks = np.stack([peer.silhouette(state).copy() for state in some])
    assert area.tolist() == masks.sum(axis=(1, 2)).tolist()
    assert overlap.tolist() == (masks & reference.mask).sum(axis=(1, 2)).tolist()
    assert area[4] == 0 < area[3]
    if peer.exact:
        differing = np.count_nonzero(masks != np.stack([evaluator.mask(state) for state in some]), axis=(1, 2))
        assert differing.max() <= TOLERANCE_PX.get(name, 2)


def test_workload_is_a_generation_around_the_truth() -> None:
    work = silhouette_workload(20)
    assert np.array_equal(work.states, silhouette_workload(40).states[:20])
    reference = Reference(work.mask)
    ious = SilhouetteEvaluator([work.instrument], work.camera).score(work.states, reference).iou(reference)
    assert 0.3 < ious.min() < ious.max() < 1.0
    assert len(np.unique(work.states, axis=0)) == 20


def no_progress(*_: object) -> None:
    pass


class DyingProcess(RendererProcess):
    """A process that is killed in its first turn, as by a library that aborts, where it is OpenCV's."""

    doomed = False

    def send(self, *message: Any) -> None:
        self.doomed |= message[:2] == ("prepare", "opencv")
        if self.doomed and message[0] == "turn":
            self.kill()
        super().send(*message)


class FaultyProcess(RendererProcess):
    """A renderer that raises, where it is OpenCV: it is given a workload that is none."""

    def send(self, *message: Any) -> None:
        super().send(*message[:3], None) if message[:2] == ("prepare", "opencv") else super().send(*message)


@pytest.mark.slow
@pytest.mark.parametrize(("process", "reason"), [(DyingProcess, "was killed (signal 9)"), (FaultyProcess, "failed: ")])
def test_a_peer_that_fails_costs_its_own_row(
    monkeypatch: pytest.MonkeyPatch, process: type[RendererProcess], reason: str
) -> None:
    monkeypatch.setattr(silhouettes, "RendererProcess", process)
    comparison = compare([1], ["opencv", "scanline"], QUICK, no_progress, no_progress)
    assert reason in comparison.skipped["opencv"]
    assert [peer.name for peer in comparison.peers] == ["scanline"]
    (entry,) = comparison.entries()
    assert entry["speedup_over_fastest_peer"] is None  # no library is left


def test_what_is_not_installed_is_skipped_with_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("moderngl", "open3d", "embreex"):
        monkeypatch.setitem(sys.modules, name, None)  # importing it raises ModuleNotFoundError
        assert "pip install 'surgbench[bench]'" in str(PEERS[name].problem())


def test_an_llvm_that_kills_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mitsuba_backends, "llvm_version", lambda: (16, 0, 6))
    assert "needs LLVM 17 or later, found 16.0.6" in str(PEERS["mitsuba-llvm"].problem())
    monkeypatch.setattr(mitsuba_backends, "llvm_version", lambda: (19, 1, 7))
    assert PEERS["mitsuba-llvm"].problem() is None


@pytest.mark.slow
def test_table_shows_ratios_and_what_was_skipped() -> None:
    done = bench("--quick", "--threads", "1", "--peers", "scanline,mitsuba-llvm", "--rounds", "1")
    assert done.returncode == 0
    rows = {line.split()[0]: line.split() for line in done.stdout.splitlines() if line.split()}
    assert float(rows["scanline"][3]) == pytest.approx(float(rows["scanline"][2]) / float(rows["surgbench"][2]), abs=1)
    assert rows["scanline"][4] == "0"
    assert ("mitsuba-llvm" in rows) != ("skipped mitsuba-llvm: " in done.stdout)


def test_threads_are_capped_by_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(silhouettes, "own_cores", lambda: [3, 5])
    assert check_threads([2, 1, 2]) == ([1, 2], {})
    usable, skipped = check_threads([1, 4])
    assert usable == [1]
    assert skipped == {"surgbench, 4 threads": "this process has 2 cores"}
    with pytest.raises(ConfigError, match="give at most 2"):
        check_threads([4])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--peers", "modrngl"), "unknown peer 'modrngl'; did you mean 'moderngl'?"),
        (("--threads", "two"), "--threads two: give whole numbers"),
        (("--threads", "0,1"), "--threads 0,1: give numbers from 1"),
    ],
)
def test_mistakes_are_one_line(arguments: tuple[str, ...], expected: str) -> None:
    done = bench(*arguments)
    assert done.returncode == 2
    assert expected in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""


@pytest.mark.parametrize("command", [("bench",), ("bench", "silhouettes")], ids=" ".join)
def test_help_shows_an_example(command: tuple[str, ...]) -> None:
    result = CliRunner().invoke(app, [*command, "--help"])
    assert result.exit_code == 0
    assert "Example: surgbench bench silhouettes" in " ".join(result.output.split())
