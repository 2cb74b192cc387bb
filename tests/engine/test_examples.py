"""Examples in docstrings run as printed, and the Python of the documents compiles, imports and runs."""

from __future__ import annotations

import ast
import doctest
import importlib
import importlib.util
import pkgutil
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from surgbench.contract import Observation
from surgbench.geometry import FloatArray
from surgbench.registry import create, find
from surgbench.state import POSITION, split_arms
from surgbench.tasks.instrument.conformance.scenes import Play, make_play
from surgbench.tasks.viewpoint.conformance.worlds import circling
from surgbench.viewpoint.scores import course_errors
from surgbench.viewpoint.simulator import Simulation, make_scene

ROOT = next(folder for folder in Path(__file__).parents if (folder / "pyproject.toml").is_file())
PACKAGES = ("surgbench", "surgbench.trackers", "surgbench.generators")
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE

# What the author of a plug-in meets: each has an example in its own docstring.
WITH_EXAMPLE = (
    "surgbench.camera.Camera",
    "surgbench.camera.Camera.project",
    "surgbench.camera.Camera.see",
    "surgbench.camera.Camera.contains",
    "surgbench.camera.change_of_view.ChangeOfView",
    "surgbench.camera.change_of_view.ChangeOfView.pull_back",
    "surgbench.camera.change_of_view.angle_rates",
    "surgbench.contract.Estimate",
    "surgbench.contract.Initialiser",
    "surgbench.contract.InstrumentTracker",
    "surgbench.contract.KeypointSource",
    "surgbench.contract.Observation",
    "surgbench.contract.Plugin",
    "surgbench.contract.Scene",
    "surgbench.contract.StateFilter",
    "surgbench.contract.View",
    "surgbench.geometry.inverse_transform",
    "surgbench.geometry.is_rigid",
    "surgbench.geometry.look_at_angles",
    "surgbench.geometry.look_at_rotation",
    "surgbench.geometry.rigid_transform",
    "surgbench.geometry.rotation_angle",
    "surgbench.geometry.rotation_from_vector",
    "surgbench.geometry.rotation_vector",
    "surgbench.geometry.wrap_angle",
    "surgbench.search.hypotheses.hypothesis_states",
    "surgbench.instrument.Instrument.link_transforms",
    "surgbench.instrument.Instrument.points_cam",
    "surgbench.instrument.Instrument.tips_cam",
    "surgbench.instrument.load_instrument",
    "surgbench.metrics.choose_twin",
    "surgbench.metrics.jitter",
    "surgbench.metrics.keypoint_error",
    "surgbench.metrics.lag",
    "surgbench.metrics.mask_error",
    "surgbench.metrics.pose_errors",
    "surgbench.metrics.rotation_error",
    "surgbench.report.summary.summarise",
    "surgbench.objective.LossWeights",
    "surgbench.objective.Objective",
    "surgbench.objective.KeypointTerm",
    "surgbench.randomness.generator",
    "surgbench.randomness.seed_from",
    "surgbench.silhouette.KeypointProjector",
    "surgbench.silhouette.Reference",
    "surgbench.silhouette.SilhouetteEvaluator",
    "surgbench.silhouette.SilhouetteEvaluator.contour_points",
    "surgbench.silhouette.SilhouetteEvaluator.gradient",
    "surgbench.silhouette.VisibilityEvaluator",
    "surgbench.silhouette.autograd.areas",
    "surgbench.silhouette.iou",
    "surgbench.state.JointLimits",
    "surgbench.state.JointLimits.clip",
    "surgbench.state.StateSpace",
    "surgbench.state.clip_joints",
    "surgbench.state.split_arms",
    "surgbench.state.twin",
    "surgbench.search.spaces.SearchSpaces",
    "surgbench.viewpoint.contract.ViewCommand",
    "surgbench.viewpoint.contract.ViewpointTracker",
)


def _raise(name: str) -> None:
    raise ImportError(f"{name} cannot be imported, so that its modules would be left out")


@cache
def modules() -> dict[str, Path]:
    """Every module and its file. None but packages are imported: some are what worker processes run."""
    found: dict[str, Path] = {}
    for package in PACKAGES:
        folders = importlib.import_module(package).__path__
        for info in pkgutil.walk_packages(folders, f"{package}.", onerror=_raise):
            spec = importlib.util.find_spec(info.name)
            assert spec is not None, info.name
            assert spec.origin is not None, info.name
            found[info.name] = Path(spec.origin)
    return found


def examples_of(module: str) -> int:
    """How many examples its text has, in docstrings or anywhere."""
    return len(re.findall(r"^\s*>>> ", modules()[module].read_text(encoding="utf-8"), flags=re.MULTILINE))


@pytest.mark.parametrize("name", sorted(name for name in modules() if examples_of(name)))
def test_examples_of_a_module(name: str) -> None:
    """All of them, each docstring on its own: it imports what it uses."""
    module = importlib.import_module(name)
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    said: list[str] = []
    for test in doctest.DocTestFinder(exclude_empty=True).find(module, globs={}):
        runner.run(test, out=said.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(said)
    assert runner.tries == examples_of(name), "an example stands where doctest does not find it"


def test_no_module_is_left_out() -> None:
    """A folder without ``__init__.py`` would hide its modules."""
    found = {file.resolve() for file in modules().values()}
    for package in PACKAGES:
        for folder in importlib.import_module(package).__path__:
            root = Path(folder).resolve()
            assert {file.resolve() for file in root.rglob("*.py")} - found <= {root / "__init__.py"}


@pytest.mark.parametrize("name", WITH_EXAMPLE)
def test_it_has_an_example(name: str) -> None:
    text = pkgutil.resolve_name(name).__doc__ or ""
    assert re.search(r"^ *Example:$", text, flags=re.MULTILINE)
    assert doctest.DocTestParser().get_examples(text)


# --- documents


def blocks(document: Path) -> list[tuple[int, str]]:
    """Line and text of a document's blocks of Python."""
    text = document.read_text(encoding="utf-8")
    matches = re.finditer(r"^```python\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)
    return [(text.count("\n", 0, match.start(1)) + 1, match[1]) for match in matches]


def load(text: str, name: str, folder: Path) -> Any:
    """An instance of the class that a document shows, as the suite makes one of a user's file."""
    (source,) = [block for _, block in blocks(ROOT / text) if f"class {name}" in block]
    (folder / "mine.py").write_text(source, encoding="utf-8")
    return create(find("tracker", f"{folder / 'mine.py'}:{name}"), {})


@pytest.mark.parametrize(
    "source",
    [
        pytest.param(source, id=f"{document.name}:{line}")
        for document in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))
        for line, source in blocks(document)
    ],
)
def test_python_in_a_document_compiles_and_finds_what_it_imports(source: str) -> None:
    tree = ast.parse(source)
    compile(tree, "document", "exec", dont_inherit=True)
    tree.body = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    exec(compile(tree, "document", "exec", dont_inherit=True), {})


@pytest.mark.parametrize(
    ("document", "name"),
    [("README.md", "Still"), ("CONTRIBUTING.md", "MineTracker"), ("docs/add-tracker.md", "MineTracker")],
)
def test_a_tracker_in_a_document_tracks(document: str, name: str, tmp_path: Path) -> None:
    play, tracker = make_play(frames=2), load(document, name, tmp_path)
    tracker.reset(play.scene, play.truth[0], np.random.default_rng(0))
    for observation in play.observations:
        answer = tracker.step(observation)
        state = np.asarray(getattr(answer, "state", answer))
        assert np.linalg.norm((state - play.truth[0])[POSITION]) < 0.01


def test_the_controller_in_a_document_sees_the_feature(tmp_path: Path) -> None:
    trial, controller = circling(10), load("docs/viewpoint.md", "Straight", tmp_path)
    scene = make_scene(trial)
    course = Simulation(controller, trial, scene, np.random.default_rng(0)).run()
    errors = course_errors(course, trial, scene)
    assert errors["vva_deg"].max() < 5
    assert errors["fd_mm"].max() < 5


def spotted(play: Play, state: FloatArray) -> NDArray[np.uint8]:
    """An image in which the instruments of a play are covered with grey spots that move with them."""
    rng, camera = np.random.default_rng(7), play.scene.views[0].camera
    picture = np.full((camera.height, camera.width), 60, np.uint8)
    for instrument, arm in zip(play.scene.instruments, split_arms(state), strict=True):
        transforms = instrument.link_transforms(arm)
        for name, mesh in instrument.meshes.items():
            T = transforms[instrument.link_index[name]]
            corners = mesh.vertices_m[mesh.faces].clip(min=-0.06)
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            face = rng.choice(len(corners), 150, p=(size := np.linalg.norm(normals, axis=1)) / size.sum())
            places = np.einsum("pc,pcx->px", rng.dirichlet(np.ones(3), 150), corners[face]) @ T[:3, :3].T + T[:3, 3]
            shade = rng.integers(90, 255, 150)
            for place, normal, grey in zip(places, normals[face] @ T[:3, :3].T, shade, strict=True):
                if place @ normal < 0:
                    centre = np.rint(camera.project(place) * 16).astype(int).tolist()
                    cv2.circle(picture, centre, 24, int(grey), cv2.FILLED, cv2.LINE_AA, 4)
    return np.repeat(cv2.GaussianBlur(picture, (0, 0), 0.7)[..., None], 3, axis=2)


@pytest.mark.parametrize("arms", [1, 2])
def test_the_tracker_that_looks_at_images_follows_them(arms: int) -> None:
    play = make_play(arms=arms, frames=5)
    tracker = create(find("tracker", f"{ROOT / 'examples/flow.py'}:FlowTracker"), {})
    tracker.reset(play.scene, play.truth[0], np.random.default_rng(0))

    def with_image(frame: Observation) -> Observation:
        view = frame.views[0]
        # No mask: it does not need one.
        return replace(frame, views=(replace(view, mask=np.zeros_like(view.mask), image=lambda: images[frame.index]),))

    images = [spotted(play, state) for state in play.truth]
    answers = [tracker.step(with_image(frame)) for frame in play.observations]
    assert not any(answer.lost for answer in answers)
    camera, instrument = play.scene.views[0].camera, play.scene.instruments[0]
    began, ended, answered = (
        camera.project(instrument.tips_cam(split_arms(state)))
        for state in (play.truth[0], play.truth[-1], answers[-1].state)
    )
    off_px, moved_px = (np.linalg.norm(pixels - ended, axis=-1) for pixels in (answered, began))
    assert (off_px < 0.25 * moved_px).all()
    assert tracker.step(play.observations[-1]).lost, "there is no image"
