"""Points on first pictures: from files as people write them, and from where an estimate puts the arms."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import resting_state, scene_of

from surgbench.camera import Camera
from surgbench.camera.change_of_view import ChangeOfView
from surgbench.errors import ConfigError
from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.instrument import Instrument
from surgbench.mask_sources import Prompts
from surgbench.prompts import LEAST_DEPTH_PX, Pictures, check_on_instrument, prompts_from_state, read_prompts
from surgbench.silhouette import SilhouetteEvaluator, VisibilityEvaluator

CAMERA = Camera(width=160, height=120, fx=200, fy=200, cx=80, cy=60)
ONE = {"first": Pictures({"": CAMERA}, ("right",))}
BOTH = ("left", "right")
TWO = {"first": Pictures({"": CAMERA, "stereo": CAMERA}, BOTH), "second": Pictures({"": CAMERA}, BOTH)}
# --- files


def written(folder: Path, content: object) -> Path:
    """A prompts file: a table where it is a text, else JSON."""
    path = folder / ("prompts.csv" if isinstance(content, str) else "prompts.json")
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def test_a_table_of_one_arm_needs_no_more_than_pixels(tmp_path: Path) -> None:
    found = read_prompts(written(tmp_path, "u,v\n80,60\n90.5,61\n"), ONE)["first"][""]
    np.testing.assert_array_equal(found.points_px[0], [[80, 60], [90.5, 61]])
    assert found.inside[0].tolist() == [True, True]


def test_points_go_to_their_sequence_view_and_arm(tmp_path: Path) -> None:
    table = (
        "\nsequence;view;arm;u;v;inside\nfirst;;left;40;50;\nfirst;;right;110;50;1\nfirst;;right;80;20;0\n"
        "first;stereo;left;30;50;1\nfirst;stereo;right;;;\n\nsecond;;right;100;60;true\nsecond;;left;20;60;1\n"
    )
    found = read_prompts(written(tmp_path, table), TWO)
    assert {name: list(views) for name, views in found.items()} == {"first": ["", "stereo"], "second": [""]}
    left, right = found["first"][""].points_px
    assert left.tolist() == [[40, 50]]
    assert right.tolist() == [[110, 50], [80, 20]]
    assert found["first"][""].inside[1].tolist() == [True, False]
    assert found["first"]["stereo"].points_px[1].shape == (0, 2)  # said not to be in the picture
    assert [points.tolist() for points in found["second"][""].points_px] == [[[20, 60]], [[100, 60]]]


@given(
    st.lists(
        st.tuples(st.sampled_from(BOTH), st.floats(-0.5, 159.5), st.floats(-0.5, 119.5), st.booleans()), max_size=6
    )
)
def test_json_holds_what_a_table_holds(
    tmp_path_factory: pytest.TempPathFactory, more: list[tuple[object, ...]]
) -> None:
    folder = tmp_path_factory.mktemp("both")
    rows = [("left", 1.0, 2.0, True), ("right", 3.0, 4.0, True), *more]
    entries = [{"sequence": "second", "arm": arm, "u": u, "v": v, "inside": inside} for arm, u, v, inside in rows]
    lines = [f"second,{arm},{u!r},{v!r},{int(bool(inside))}" for arm, u, v, inside in rows]
    table = read_prompts(written(folder, "\n".join(["sequence,arm,u,v,inside", *lines])), TWO)["second"][""]
    object_ = read_prompts(written(folder, entries), TWO)["second"][""]
    for arm in range(2):
        np.testing.assert_array_equal(table.points_px[arm], object_.points_px[arm])
        np.testing.assert_array_equal(table.inside[arm], object_.inside[arm])
        assert len(table.points_px[arm]) == sum(row[0] == BOTH[arm] for row in rows)


@pytest.mark.parametrize(
    ("content", "sequences", "message"),
    [
        ("u,v\n160,60\n", ONE, r"prompts.csv: line 2: \(160, 60\) lies outside the picture of 160x120 pixels"),
        ("u,v\n80,nan\n", ONE, "line 2: 'v' must be a finite number, not 'nan'"),
        ("u,v\n80,\n", ONE, "line 2: 'v' must be a finite number, not ''"),
        ("u,v\n80,60\n80,sixty\n", ONE, "line 3: 'v' must be a finite number, not 'sixty'"),
        ("u,v\n80\n", ONE, r"line 2 has 1 values; expected 2 \(u,v\)"),
        ("u,v,inside\n80,60,yes\n", ONE, "line 2: 'inside' must be 1 or 0, not 'yes'"),
        ("u,v,insde\n80,60,1\n", ONE, "line 1: unknown column 'insde'; did you mean 'inside'?"),
        ("arm,u\nright,80\n", ONE, "line 1 must be 'sequence,arm,u,v,inside', each once, u and v at least"),
        ("u,v,u\n80,60,1\n", ONE, "line 1 must be"),
        ("arm,u,v\nleft,80,60\n", ONE, r"line 2: unknown arm 'left' \(valid: right\)"),
        ("sequence,u,v\nfrist,80,60\n", ONE, "line 2: unknown sequence 'frist'; did you mean 'first'?"),
        ("view,u,v\nstereo,80,60\n", ONE, "line 2: unknown view 'stereo'"),
        ("arm,u,v\nleft,80,60\n", TWO, r"line 2: 'sequence' is missing \(valid: first, second\)"),
        ("sequence,u,v\nfirst,80,60\n", TWO, r"line 2: 'arm' is missing \(valid: left, right\)"),
        ("u,v,inside\n80,60,0\n", ONE, "prompts.csv: sequence 'first': the right arm has no point inside"),
        ("sequence,arm,u,v\nfirst,left,80,60\n", TWO, "sequence 'first': the right arm has no point inside"),
        ("sequence,view,arm,u,v\nfirst,stereo,left,,\nfirst,stereo,right,,\n", TWO, "'stereo': has no point on any"),
        ("u,v\n", ONE, "holds no point; expected 'sequence,arm,u,v,inside'"),
        ("", ONE, "the file is empty"),
        ({"u": 80, "v": 60}, ONE, "prompts.json: must be a list of objects"),
        ([[80, 60]], ONE, r"prompts.json: entry 1: must be an object, not \[80, 60\]"),
        ([{"u": 80, "v": 60}, {"u": True, "v": 60}], ONE, "entry 2: 'u' must be a finite number, not 'True'"),
        ([{"u": 80, "v": 60, "side": 1}], ONE, "entry 1: unknown column 'side'"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(
    tmp_path: Path, content: object, sequences: dict[str, Pictures], message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        read_prompts(written(tmp_path, content), sequences)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere.csv: prompts cannot be read \(no such file"):
        read_prompts(tmp_path / "nowhere.csv", ONE)
    (tmp_path / "picture.csv").write_bytes(b"\x89PNG\xff")
    with pytest.raises(ConfigError, match=r"picture.csv: prompts cannot be read as text"):
        read_prompts(tmp_path / "picture.csv", ONE)
    (tmp_path / "damaged.json").write_text("[{", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"damaged.json: not valid JSON"):
        read_prompts(tmp_path / "damaged.json", ONE)


# --- estimates


def crossing(camera: Camera) -> FloatArray:
    """Two arms, of which the right one's shaft runs before the left one's jaws."""
    behind = resting_state(0.15)
    before = np.array([-0.3, 0.2, -0.8, 0.015, 0.01, 0.11, 0.0, 0.0, 0.2])
    return np.concatenate([behind, before])


def depths(visible: np.ndarray, points: FloatArray) -> FloatArray:
    """How far points lie from what is not of the mask, pixels, by brute force; beyond the border is not of it."""
    off = np.argwhere(~np.pad(visible, 1)) - 1
    return np.array([np.hypot(*(off - [v, u]).T).min() for u, v in points])


@pytest.mark.parametrize("turned", [False, True], ids=["own", "auxiliary"])
def test_points_lie_deep_in_what_shows_of_their_arm(small_camera: Camera, turned: bool) -> None:
    scene, state = scene_of(small_camera, arms=2), crossing(small_camera)
    pose = rigid_transform(rotation_from_vector(np.array([0.0, 0.1, 0.05])), np.array([-0.01, 0.0, 0.0]))
    view = replace(scene.views[0], T_view_cam=pose if turned else np.eye(4))
    prompts = prompts_from_state(scene, view, state)
    here = ChangeOfView(view.T_view_cam).states(state)
    visible = VisibilityEvaluator(scene.instruments, small_camera).visible_masks(here)
    assert check_on_instrument(prompts, np.logical_or.reduce(visible), tuple(visible)) is None
    for own, points, inside in zip(visible, prompts.points_px, prompts.inside, strict=True):
        assert inside.all()
        assert len(points) >= 1
        assert depths(own, points).min() >= LEAST_DEPTH_PX


def test_links_that_show_have_a_point_each(camera: Camera) -> None:
    scene, state = scene_of(camera), resting_state()
    state[8] = 0.6  # open jaws
    (points,) = prompts_from_state(scene, scene.views[0], state).points_px
    instrument = scene.instruments[0]
    shown = {}
    for name, mesh in instrument.meshes.items():
        link = SilhouetteEvaluator([Instrument(instrument.spec, {name: mesh})], camera).mask(state)
        shown[name] = [bool(link[int(v), int(u)]) for u, v in points]
    assert sum(map(sum, shown.values())) == len(points)  # each on one link alone
    for name in ("shaft", "wrist", "jaw_right", "jaw_left"):
        assert sum(shown[name]) == 1, name


def test_an_arm_too_small_for_that_has_one(camera: Camera) -> None:
    scene, state = scene_of(camera), resting_state(0.13)
    far = Camera(width=70, height=49, fx=90.6, fy=90.5, cx=29.4, cy=23.9)
    (points,) = prompts_from_state(
        scene, replace(scene.views[0], camera=far), state * [1, 1, 1, 4, 4, 4, 1, 1, 1]
    ).points_px
    assert len(points) == 0  # thinner than what an estimate may be off by
    (points,) = prompts_from_state(scene, replace(scene.views[0], camera=far), state).points_px
    assert 1 <= len(points) < 5


def test_what_the_other_arm_hides_gets_no_point(small_camera: Camera) -> None:
    scene = scene_of(small_camera, arms=2)
    near, far = resting_state(0.1), resting_state(0.1)
    far[3:6] *= 1.5  # on the same rays, so all of it is hidden but for what is thinner
    both = prompts_from_state(scene, scene.views[0], np.concatenate([far, near]))
    alone = prompts_from_state(scene_of(small_camera), scene.views[0], near)
    np.testing.assert_array_equal(both.points_px[1], alone.points_px[0])
    assert not len(both.points_px[0])


@pytest.mark.parametrize("where", [(0.0, 0.0, -0.13), (0.5, 0.0, 0.13), (np.nan, 0.0, 0.13)])
def test_an_arm_out_of_the_picture_gets_none(small_camera: Camera, where: tuple[float, float, float]) -> None:
    scene, state = scene_of(small_camera, arms=2), np.concatenate([resting_state(), resting_state()])
    state[9:12], state[12:15] = 0.0, where
    prompts = prompts_from_state(scene, scene.views[0], state)
    assert len(prompts.points_px[0])
    assert prompts.points_px[1].shape == (0, 2)


# --- true masks


def test_points_on_the_background_or_the_other_arm_are_named() -> None:
    left, right = np.zeros((2, 120, 160), dtype=bool)
    left[50:70, :60], right[50:70, 100:] = True, True

    def said(*points: tuple[float, float], inside: bool = True) -> str | None:
        prompts = Prompts([np.array(points), np.array([[120.0, 60]])], [np.full(len(points), inside), np.array([True])])
        return check_on_instrument(prompts, left | right, (left, right))

    assert said((10, 60), (59.5, 69.5)) is None  # the last pixels reach half a pixel further
    assert said((10, 60), (59.6, 60)) == "the point (59.6, 60) of arm 1 lies on the background"
    assert said((110, 60)) == "the point (110, 60) of arm 1 lies on the other arm"
    assert said((80, 10), inside=False) is None
