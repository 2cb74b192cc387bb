"""Images: they show what the masks show, from the same states, and say how they were made."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from surgbench import open_dataset
from surgbench.camera import Camera
from surgbench.config import parse_model
from surgbench.dataset.manifest import MANIFEST_NAME
from surgbench.dataset.validate import validate
from surgbench.errors import ConfigError
from surgbench.generators.generate import generate, plan_dataset
from surgbench.generators.looks.look import Look, draw_look
from surgbench.generators.looks.markers import MARKERS, painted, with_markers, without_markers
from surgbench.generators.looks.optics import Optics, compressed, defocused
from surgbench.generators.looks.patterns import noise, threshold
from surgbench.generators.looks.pictures import PictureWriter
from surgbench.generators.looks.scene import PictureRenderer
from surgbench.generators.looks.sections import Images, LookRanges, Stereo
from surgbench.generators.looks.sequence import EYE, SequenceLook, eye_pose, steps
from surgbench.generators.looks.surface import link_surface
from surgbench.generators.looks.variants import loads, pick
from surgbench.generators.observations import lagged
from surgbench.generators.presets import Preset, load_preset
from surgbench.generators.render import MaskRenderer
from surgbench.geometry import FloatArray
from surgbench.instrument import Instrument, load_instrument, save_instrument
from surgbench.instrument.model import LinkMesh
from surgbench.state import BETA
from surgbench.tasks.instrument.dataset import InstrumentDataset
from surgbench.tasks.instrument.format import IMAGE_KIND, observed_path

SMALL = Camera(width=96, height=72, fx=124.0, fy=122.5, cx=42.3, cy=35.1)
# Nothing is drawn: every range is one value, and the lens and the sensor do nothing.
PLAIN: dict[str, Any] = {name: (value, value) for name, value in {
    "lens_px": 0.0, "defocus_px": 0.0, "k1": 0.0, "fringe_px": 0.0, "vignette": 0.0, "noise": 0.0, "shot": 0.0,
    "sharpening": 0.0, "shutter": 0.0, "grain_px": 0.0, "saturation": 1.0, "white_red": 1.0, "white_blue": 1.0,
}.items()}  # fmt: skip
TINY = Preset(
    name="tiny",
    pairs=1,
    frames=2,
    camera=SMALL,
    images=Images(samples=2, variant="scalar_rgb", stereo=Stereo(), depth=True, links=True),
)
STATES = np.array(
    [[0.25, 0.4, 0.7, -0.01, 0.0, 0.12, 0.3, -0.2, 0.3], [0.2, -1.0, -0.7, 0.02, 0.005, 0.13, 0.1, 0.3, 0.4]]
)


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    return load_instrument("large_needle_driver")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("made") / "tiny"
    assert generate(plan_dataset(TINY), out)
    return out


@pytest.fixture
def tiny(made: Path) -> InstrumentDataset:
    dataset = open_dataset(made)
    assert isinstance(dataset, InstrumentDataset)
    return dataset


def look(**ranges: Any) -> Look:
    return draw_look(Images(look=LookRanges(**{**PLAIN, **ranges})), dataset=0, sequence="000")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def decoded(png: bytes) -> NDArray[np.uint8]:
    """RGB."""
    picture: Any = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    return np.asarray(picture[..., ::-1], np.uint8)


def rendered(instrument: Instrument) -> NDArray[np.float32]:
    """Linear light of both arms before nothing."""
    renderer = PictureRenderer(instrument, 2, SMALL, look(), "scalar_rgb", 8, None)
    light: NDArray[np.float32] = renderer.linear(STATES, np.zeros((2, 9)), 0.0, seed=1)
    return light


# What images show


@pytest.mark.slow
def test_instruments_are_seen_where_the_clean_mask_says(instrument: Instrument) -> None:
    covered = rendered(instrument)[..., 3]
    mask = MaskRenderer([instrument] * 2, SMALL).mask(STATES)
    # Of a pixel on the edge any part may be covered.
    kernel = np.ones((3, 3), np.uint8)
    sure = cv2.erode(mask.astype(np.uint8), kernel).astype(bool)
    near = cv2.dilate(mask.astype(np.uint8), kernel).astype(bool)
    assert covered[sure].min() == 1.0
    assert covered[~near].max() == 0.0
    assert abs(covered.sum() / mask.sum() - 1.0) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("markers", [False, True])
def test_pixel_centres_see_the_instruments_that_the_clean_mask_shows(instrument: Instrument, markers: bool) -> None:
    camera = SMALL.resized(384, 288)
    shown = with_markers(instrument) if markers else instrument
    renderer = PictureRenderer(shown, 2, camera, look(), "scalar_rgb", 1, None)
    seen = renderer.depth_m(STATES, 0.0) > 0
    mask = MaskRenderer([instrument] * 2, camera).mask(STATES)
    assert (seen & mask).sum() / (seen | mask).sum() > 0.999


@pytest.mark.slow
def test_depth_is_that_of_the_surface(instrument: Instrument) -> None:
    renderer = PictureRenderer(instrument, 2, SMALL, look(), "scalar_rgb", 1, None)
    straight = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.4, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0]])
    straight[0, [0, 2]] = 0.0, np.pi / 2  # the shaft across the view
    depth = renderer.depth_m(straight, 0.0)
    row, column = round(SMALL.cy), round(SMALL.cx) - 30
    assert depth[row, column] == pytest.approx(0.4 - 0.00415, abs=6e-5)
    assert depth[0, 0] == 0.0


@pytest.mark.slow
def test_the_other_eye_sees_points_with_the_disparity_of_their_depth(tiny: InstrumentDataset) -> None:
    sequence = tiny.sequence("000")
    view = sequence.auxiliary(EYE)
    for kind in ("left", "right", "both"):
        assert np.allclose(view.true_T_view_cam(kind)[0], eye_pose(Stereo()), atol=1e-12)
    # The mask in the right eye is that in the left one, moved by fx * baseline / depth, which is 4 to 9 px here.
    depth, seen, other = sequence.depth_m(0), sequence.clean_mask("both", 0), view.clean_mask("both", 0)
    assert depth is not None
    rows, columns = np.nonzero(seen)
    moved = np.rint(columns - SMALL.fx * Stereo().baseline_m / depth[rows, columns]).astype(int)
    inside = moved >= 0
    assert other[rows[inside], moved[inside]].mean() > 0.97
    # And so do the images: the right one, moved back, is more like the left one than without.
    left, right = sequence.image(0), view.image(0)
    assert left is not None
    assert right is not None
    grid = np.mgrid[: SMALL.height, : SMALL.width].astype(np.float32)
    back = cv2.remap(
        right, grid[1] - (SMALL.fx * Stereo().baseline_m / depth).astype(np.float32), grid[0], cv2.INTER_LINEAR
    )
    inner = (slice(4, -4), slice(14, -4))
    as_it_is, as_moved = (np.abs(one[inner].astype(float) - left[inner]).mean() for one in (right, back))
    assert as_moved < 0.8 * as_it_is


def test_vergence_turns_the_eye_inwards() -> None:
    ahead = eye_pose(Stereo(baseline_m=0.006, vergence_rad=0.05)) @ [0.0, 0.0, 0.12, 1.0]
    assert ahead[0] == pytest.approx(0.12 * np.sin(0.05) - 0.006 * np.cos(0.05))


@pytest.mark.slow
def test_markers_are_seen_where_their_places_project(instrument: Instrument) -> None:
    plain, marked = (rendered(one)[..., :3] for one in (instrument, with_markers(instrument)))
    # Steel and coat are grey.
    hues = [image.max(axis=2) - image.min(axis=2) > 0.4 * image.max(axis=2) for image in (plain, marked)]
    changed = hues[1] & ~hues[0] & (marked.max(axis=2) > 0.05)
    places = SMALL.project(instrument.points_cam(STATES, tuple(marker.point for marker in MARKERS)))
    rows, columns = np.nonzero(changed)
    off = np.linalg.norm(np.stack([columns, rows], axis=-1)[:, None] - places.reshape(1, -1, 2), axis=2)
    # A radius is 1.5 px here. Light that paint reflects reaches the steel beside it.
    assert changed.sum() > 20
    assert np.quantile(off.min(axis=1), 0.8) < 3.0


def test_markers_are_twelve_colours_and_leave_the_shape_alone(instrument: Instrument) -> None:
    colours = np.array([marker.colour for marker in MARKERS])
    apart = np.linalg.norm(colours[:, None] - colours, axis=2) + np.eye(len(colours))
    assert len(MARKERS) == 12
    assert apart.min() > 0.15
    mesh = instrument.meshes["jaw_left"]
    surface = link_surface(mesh, shaft=False)
    own = tuple(one for one in MARKERS if one.point.link == "jaw_left")
    bare, spots = painted(surface, own)

    def area(vertices: FloatArray) -> float:
        a, b, c = np.moveaxis(vertices.reshape(-1, 3, 3), 1, 0)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    areas = {name: area(spot.vertices_m) for name, spot in spots.items()}
    assert area(bare.vertices_m) + sum(areas.values()) == pytest.approx(area(surface.vertices_m))
    assert set(areas) == {marker.name for marker in own}
    assert min(areas.values()) > 1e-6  # one square millimetre


def test_trackers_are_told_what_is_painted_and_of_nothing_else(instrument: Instrument, tmp_path: Path) -> None:
    painted_instrument = with_markers(instrument)
    assert painted_instrument.spec.markers == MARKERS
    assert with_markers(painted_instrument) is painted_instrument
    assert without_markers(painted_instrument).spec == instrument.spec
    without = plan_dataset(TINY)
    images = TINY.images
    assert images is not None
    with_paint = TINY.model_copy(update={"images": images.model_copy(update={"markers": True})})
    there = plan_dataset(with_paint)
    changed = [path for path, data in there.instrument_files.items() if without.instrument_files[path] != data]
    assert changed == ["instruments/large_needle_driver/instrument.yaml"]
    for plan, expected in ((without, ()), (there, MARKERS)):
        save_instrument(plan.instrument, tmp_path)
        assert load_instrument(tmp_path / "instrument.yaml").spec.markers == expected
    # An instrument file's own markers are painted, or else not in the dataset's copy of it.
    few = instrument.spec.model_copy(update={"markers": MARKERS[:2]})
    save_instrument(Instrument(few, instrument.meshes), tmp_path)
    for preset, expected in ((TINY, ()), (with_paint, MARKERS[:2])):
        own = plan_dataset(preset.model_copy(update={"instrument": str(tmp_path / "instrument.yaml")}))
        assert own.instrument.spec.markers == own.real_instrument.spec.markers == expected


def test_a_link_that_is_elsewhere_is_not_painted(instrument: Instrument) -> None:
    mesh = instrument.meshes["wrist"]
    moved = LinkMesh(mesh.vertices_m + np.array([0.0, 0.0, 0.1]), mesh.faces)
    names = {marker.name for marker in with_markers(Instrument(instrument.spec, {"wrist": mesh})).spec.markers}
    assert names == {"wrist_1", "wrist_2", "wrist_3", "wrist_4"}
    assert with_markers(Instrument(instrument.spec, {"wrist": moved})).spec.markers == ()


# What a dataset with images holds


@pytest.mark.slow
def test_a_dataset_with_images_is_sound_and_reaches_trackers(tiny: InstrumentDataset, made: Path) -> None:
    from surgbench.tasks.instrument.units import UnitData

    assert not validate(made)
    sequence = tiny.sequence("000")
    image = sequence.image(1)
    assert image is not None
    assert image.shape == (SMALL.height, SMALL.width, 3)
    unit = tiny.units("dual")[0]
    views = UnitData(tiny, unit, "none", EYE).observation(1).views
    shown = [view.image() for view in views]
    assert shown[0] is not None
    assert shown[1] is not None
    assert np.array_equal(shown[0], image)
    assert not np.array_equal(shown[0], shown[1])


@pytest.mark.slow
def test_links_are_numbered_where_the_mask_is(tiny: InstrumentDataset) -> None:
    sequence = tiny.sequence("000")
    links = sequence.links(0)
    assert links is not None
    assert np.array_equal(links > 0, sequence.clean_mask("both", 0))
    assert set(np.unique(links % 64)) <= set(range(6))
    right = (links > 64) & ~sequence.clean_mask("left", 0)
    assert np.array_equal(right, sequence.clean_mask("right", 0) & ~sequence.clean_mask("left", 0))


@pytest.mark.slow
def test_the_look_in_the_truth_lies_in_its_ranges(tiny: InstrumentDataset) -> None:
    said = tiny.sequence("000").look()
    assert said is not None
    assert said["variant"] == "scalar_rgb"
    ranges = LookRanges()
    assert set(said["look"]) == set(LookRanges.model_fields)
    for name, value in said["look"].items():
        low, high = getattr(ranges, name)
        assert low <= value <= high


@pytest.mark.slow
def test_an_interrupted_generation_ends_with_the_same_bytes(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"
    plan = plan_dataset(TINY)
    with pytest.raises(KeyboardInterrupt):
        generate(plan, out, progress=_interrupt)
    assert not (out / MANIFEST_NAME).exists()
    assert generate(plan_dataset(TINY), out)
    assert contents(out) == contents(made)


def _interrupt(frames: float) -> None:
    raise KeyboardInterrupt


def test_presets_without_images_do_not_know_of_them() -> None:
    content = load_preset("paper").model_dump(mode="json")
    assert not {"images", "lengths"} & set(content)
    assert "lag_frames" not in content["readings"]
    assert "images_variant" not in plan_dataset(load_preset("mini")).marker


def test_sequences_may_have_lengths_of_their_own() -> None:
    preset = load_preset("markers")
    assert [entry.frames for entry in plan_dataset(preset).sequences] == [250, 311, 372, 432, 493, 554]
    assert [entry.frames for entry in plan_dataset(load_preset("markers", frames=300)).sequences][:3] == [250, 300, 300]


# Ranges


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"look": {"gap_m": [0.02, 0.01]}}, "least <= most"),
        ({"look": {"brightness": [0.2, 1.5]}}, "less than or equal to 1"),
        ({"look": {"steel_roughness": [0.0, 0.2]}}, "greater than or equal to 0.03"),
        ({"look": {"jpeg": [0, 90]}}, "greater than or equal to 1"),
        ({"backdrop": ["tissue", "tissue"]}, "twice"),
        ({"backdrop": ["moon"]}, "tissue"),
        ({"look": {"wetness": [0, 1]}}, "wetness"),
        ({"samples": 0}, "greater than or equal to 1"),
    ],
)
def test_a_bad_range_is_one_line(section: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        parse_model(Images, section, "mine.yaml")
    assert "\n" not in str(caught.value)


def test_a_look_depends_on_names_alone() -> None:
    one = draw_look(Images(), dataset=0, sequence="001")
    other = draw_look(Images(look=LookRanges(gap_m=(0.01, 0.03))), dataset=0, sequence="001")
    assert {name for name in one.values if one[name] != other[name]} == {"gap_m"}
    assert one.values != draw_look(Images(), dataset=0, sequence="002").values


def test_a_variant_that_does_not_load_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgbench.generators.looks.variants.loads", lambda variant: variant == "scalar_rgb")
    assert pick("auto") == "scalar_rgb"
    with pytest.raises(ConfigError, match="cuda_ad_rgb does not load"):
        pick("cuda_ad_rgb")


def test_the_scalar_variant_loads_everywhere() -> None:
    assert loads("scalar_rgb")


# Optics


def test_the_exposure_makes_the_first_frame_as_bright_as_the_look_says() -> None:
    rng = np.random.default_rng(0)
    light = rng.uniform(0.0, 40.0, (SMALL.height, SMALL.width, 3)).astype(np.float32)
    depth = np.full(light.shape[:2], 0.14)
    optics = Optics(SMALL, look(brightness=(0.4, 0.4)), jpeg=False)
    optics.expose(light, depth)
    image = optics.image(light, depth, 0.0, rng)
    assert image.max(axis=2).mean() / 255.0 == pytest.approx(0.4, abs=0.005)


def test_the_lens_is_taken_out_of_the_image_again() -> None:
    grid = np.mgrid[: SMALL.height, : SMALL.width]
    light = (1.0 + np.cos(grid[1] / 6.0) * np.cos(grid[0] / 6.0)).astype(np.float32)[..., None].repeat(3, axis=2)
    depth = np.full(light.shape[:2], 0.14)
    rng = np.random.default_rng(0)
    images = [Optics(SMALL, look(k1=(k1, k1)), jpeg=False).image(light, depth, 0.0, rng) for k1 in (0.0, -0.25)]
    assert np.abs(images[0].astype(float) - images[1]).mean() < 4.0


def test_what_is_in_focus_stays_sharp() -> None:
    light = np.zeros((40, 80, 3), np.float32)
    light[20, [20, 60]] = 100.0
    depth = np.full((40, 80), 0.14)
    depth[:, 40:] = 0.28
    blurred = defocused(light, depth, 0.14, 1.6)
    assert blurred[20, 20, 0] > 90.0
    assert blurred[20, 60, 0] < 12.0


def test_noise_differs_from_frame_to_frame_and_not_from_run_to_run() -> None:
    light = np.full((SMALL.height, SMALL.width, 3), 0.5, np.float32)
    depth = np.full(light.shape[:2], 0.14)
    optics = Optics(SMALL, look(noise=(4.0, 4.0), shot=(0.0, 0.0)), jpeg=False)
    images = [optics.image(light, depth, 0.0, np.random.default_rng(seed)).astype(float) for seed in (0, 0, 1)]
    assert np.array_equal(images[0], images[1])
    assert np.std(images[0] - images[2]) == pytest.approx(4.0 * np.sqrt(2), rel=0.05)


@pytest.mark.parametrize("name", ["smoke", "blood"])
def test_smoke_and_blood_are_seen(name: str) -> None:
    rng = np.random.default_rng(0)
    light = rng.uniform(0.0, 1.0, (SMALL.height, SMALL.width, 3)).astype(np.float32)
    depth = np.full(light.shape[:2], 0.14)
    clear, hazy = (Optics(SMALL, look(**ranges), jpeg=False) for ranges in ({}, {name: (0.6, 0.6)}))
    images = [optics.image(light, depth, 0.0, rng).astype(float) for optics in (clear, hazy)]
    if name == "smoke":
        later = hazy.image(light, depth, 2.0, rng)
        assert images[1].std() < 0.9 * images[0].std()
        assert np.abs(later - images[1]).mean() > 1.0
    else:
        redder = images[1][..., 0] / (images[1][..., 1] + 1.0) - images[0][..., 0] / (images[0][..., 1] + 1.0)
        assert (redder > 0.5).mean() > 0.4


def test_tissue_in_front_hides_what_is_behind_it_and_nothing_else() -> None:
    rng, hidden = np.random.default_rng(0), np.zeros((SMALL.height, SMALL.width), bool)
    hidden[20:50, 30:70] = True
    light = rng.uniform(0.1, 0.9, (*hidden.shape, 3)).astype(np.float32)
    other = light.copy()
    other[hidden] = rng.permutation(light[hidden])  # as bright, so that the tissue is too
    depth = np.full(hidden.shape, 0.14)
    optics = Optics(SMALL, look(), jpeg=False)
    bare, one, two = (
        optics.image(part, depth, 0.0, rng, cover).astype(int)
        for part, cover in ((light, None), (light, hidden), (other, hidden))
    )
    within = cv2.erode(hidden.astype(np.uint8), np.ones((5, 5))).astype(bool)
    beyond = cv2.dilate(hidden.astype(np.uint8), np.ones((5, 5))) == 0
    assert np.abs(one[within] - two[within]).max() <= 1
    assert np.array_equal(one[beyond], bare[beyond])
    assert (one[within, 0] > one[within, 1] + 20).all(), "tissue is red"
    # Round: the middle is brighter than the rim.
    rim = within & (cv2.erode(hidden.astype(np.uint8), np.ones((9, 9))) == 0)
    assert one[33:37, 45:55].mean() > 1.1 * one[rim].mean()


def test_a_third_tool_is_seen_where_its_mask_is(instrument: Instrument) -> None:
    images = Images(samples=1, variant="scalar_rgb", look=LookRanges(**PLAIN))
    sequence = SequenceLook(look(), STATES, np.zeros((1, 2, 9)), 0.2, None)
    writer = PictureWriter(images, "scalar_rgb", instrument, SMALL, 1 / 30, 0, third=True)
    third = np.array([0.1, 0.3, 1.5, 0.0, 0.004, 0.08, 0.1, 0.1, 0.3])
    without, seen = (
        decoded(writer.files("000", 0, STATES, sequence, state)[observed_path("000", IMAGE_KIND, 0)])
        for state in (None, third)
    )
    mask = MaskRenderer([instrument], SMALL).mask(third)
    changed = np.abs(seen.astype(int) - without).max(axis=2) > 3
    assert changed[mask].mean() > 0.8
    # Beyond it there are its shadow and its reflections.
    assert changed[~mask].mean() < 0.5 * changed[mask].mean()


def test_compression_loses_more_the_worse_its_quality() -> None:
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)
    losses = [np.abs(compressed(image, quality).astype(float) - image).mean() for quality in (95, 30)]
    assert 0.0 < losses[0] < losses[1]


# Small parts


def test_steps_go_the_shorter_way_round() -> None:
    states = np.zeros((3, 9))
    states[:, BETA] = [3.1, -3.1, -3.0]
    assert steps(states)[:, BETA] == pytest.approx([2 * np.pi - 6.2, (2 * np.pi - 6.2 + 0.1) / 2, 0.1])


def test_a_lag_moves_readings_back() -> None:
    values = np.arange(10.0)[:, None] * 0.1
    assert lagged(values, 2.5)[5, 0] == pytest.approx(0.25)
    assert lagged(values, -2.0)[5, 0] == pytest.approx(0.7)
    assert lagged(values, 3.0)[0, 0] == 0.0
    assert lagged(values, 0.0) is values


def test_noise_repeats_at_its_edges_and_thresholds_to_a_share() -> None:
    pattern = noise(128, 0.25, np.random.default_rng(0))
    assert np.abs(pattern[:, 0] - pattern[:, -1]).mean() < 0.3
    assert (threshold(pattern, 0.3, 0.01) > 0.5).mean() == pytest.approx(0.3, abs=0.01)
    assert not threshold(pattern, 0.0, 0.1).any()


def test_normals_are_round_on_the_shaft_and_sharp_at_its_end(instrument: Instrument) -> None:
    surface = link_surface(instrument.meshes["shaft"], shaft=True)
    along = surface.vertices_m[:, 2]
    side = (along < -0.01) & (along > -0.3)
    radial = surface.vertices_m[side] * [1.0, 1.0, 0.0]
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    assert (surface.normals[side] * radial).sum(axis=1).min() > 0.98
    assert np.allclose(np.linalg.norm(surface.normals, axis=1), 1.0)
