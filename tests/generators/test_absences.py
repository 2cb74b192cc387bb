"""Instruments that leave the picture along their shafts and come back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from surgbench.generators.absences import way_out_m, with_absences
from surgbench.generators.generate import plan_dataset
from surgbench.generators.place import Place
from surgbench.generators.presets import Motion, Preset, load_preset
from surgbench.generators.sections import Absences
from surgbench.generators.sequence import make_tables
from surgbench.generators.trajectories import make_pair
from surgbench.geometry import FloatArray, look_at_rotation
from surgbench.instrument import Instrument, load_instrument
from surgbench.metrics import OUT_OF_VIEW_SHARE
from surgbench.randomness import generator
from surgbench.silhouette import Reference, SilhouetteEvaluator
from surgbench.state import ANGLES, POSITION
from surgbench.tasks.instrument.format import ARMS

FRAMES = 300
OFTEN = Absences(every_frames=(40, 60), out_frames=(10, 30), travel_frames=(20, 30))


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    return load_instrument("large_needle_driver")


@pytest.fixture(scope="module")
def preset() -> Preset:
    return load_preset("in-and-out")


@pytest.fixture(scope="module")
def places(instrument: Instrument, preset: Preset) -> list[Place]:
    return [Place(arm, preset.workspace, preset.camera, instrument) for arm in ARMS]


@pytest.fixture(scope="module")
def staying(instrument: Instrument) -> FloatArray:
    """States of a pair that never leaves, ``(FRAMES, 2, 9)``."""
    pair: FloatArray = make_pair(load_preset("paper-wide"), instrument, "nominal", FRAMES, generator(test="absences"))
    return pair


@pytest.fixture(scope="module")
def leaving(places: list[Place], staying: FloatArray) -> FloatArray:
    """The same pair, with absences."""
    states: FloatArray | None = with_absences(OFTEN, places, staying, generator(test=0))
    assert states is not None
    return states


def pixels(preset: Preset, instrument: Instrument, states: FloatArray) -> Any:
    nothing = Reference(np.zeros((preset.camera.height, preset.camera.width), dtype=bool))
    return SilhouetteEvaluator((instrument,), preset.camera).score(states, nothing).area


@pytest.mark.slow
def test_nothing_shows_of_an_arm_that_is_drawn_back_all_the_way_and_something_before(
    places: list[Place], staying: FloatArray, preset: Preset, instrument: Instrument
) -> None:
    for index, place in enumerate(places):
        own = staying[::10, index]
        axis = look_at_rotation(own[:, ANGLES])[..., 2]
        way = way_out_m(place, own)
        for share, seen in ((1.0, False), (0.8, True)):
            back = own.copy()
            back[:, POSITION] -= share * way[:, None] * axis
            assert ((pixels(preset, instrument, back) > 0) == seen).all()


def test_instruments_move_along_their_shafts_and_in_nothing_else(staying: FloatArray, leaving: FloatArray) -> None:
    difference = leaving - staying
    assert (np.delete(difference, np.r_[POSITION], axis=-1) == 0).all()
    moved = difference[..., POSITION]
    axis = look_at_rotation(staying[..., ANGLES])[..., 2]
    back = -(moved * axis).sum(axis=-1)
    np.testing.assert_allclose(moved, -back[..., None] * axis, atol=1e-12)
    assert back.min() > -1e-12
    # Each arm on its own, and both in their place at first.
    assert (back[:40] == 0).all()
    assert ((back[:, 0] > 0) != (back[:, 1] > 0)).any()


def test_arms_leave_several_times_and_stay_out_as_long_as_asked(
    leaving: FloatArray, preset: Preset, instrument: Instrument
) -> None:
    few = OUT_OF_VIEW_SHARE * preset.camera.width * preset.camera.height
    for index in range(2):
        out = pixels(preset, instrument, leaving[:, index]) < few
        turns = np.flatnonzero(np.diff(out.astype(int)))
        starts, ends = turns[::2], turns[1::2]
        assert len(ends) >= 2
        stays = ends - starts[: len(ends)]
        assert stays.min() >= OFTEN.out_frames[0]
        # The ways begin and end slowly: some of their frames show nothing either.
        assert stays.max() <= OFTEN.out_frames[1] + OFTEN.travel_frames[1]


def test_instruments_come_and_go_smoothly(leaving: FloatArray) -> None:
    speed = np.linalg.norm(np.diff(leaving[..., POSITION], axis=0), axis=-1)
    assert speed.max() < 0.012
    assert np.abs(np.diff(leaving[..., POSITION], n=2, axis=0)).max() < 0.0015


def test_a_preset_with_absences_makes_them(preset: Preset, instrument: Instrument) -> None:
    states = make_pair(preset, instrument, "fast", 200, generator(test=0))
    for index in range(2):
        assert (pixels(preset, instrument, states[:, index]) == 0).sum() >= preset.motion.absences.out_frames[0]
    assert states[..., POSITION][..., 2].min() > 0
    same = make_pair(preset, instrument, "fast", 200, generator(test=0))
    assert np.array_equal(states, same)


def test_no_absence_near_the_camera_is_made_to_fit(places: list[Place], staying: FloatArray) -> None:
    near = staying.copy()
    near[..., POSITION] *= 0.3
    assert with_absences(OFTEN, places, near, generator(test=0)) is None


def test_a_sequence_may_end_on_the_way_out(places: list[Place], staying: FloatArray) -> None:
    for frames in (41, 60, 75):
        settings = Absences(every_frames=(40, 40), travel_frames=(30, 30))
        states = with_absences(settings, places, staying[:frames], generator(test=0))
        assert states is not None
        assert states.shape == (frames, 2, 9)
        assert not np.array_equal(states, staying[:frames])


@pytest.mark.slow
def test_a_part_of_a_sequence_has_the_absences_of_the_whole(preset: Preset, instrument: Instrument) -> None:
    whole = plan_dataset(preset).sequences[-1]
    part = whole.model_copy(update={"frames": 150})
    made, first = (make_tables(preset, entry, instrument, preset.camera) for entry in (whole, part))
    np.testing.assert_array_equal(first.states, made.states[:150])
    for name, values in first.observed.items():
        np.testing.assert_array_equal(values, made.observed[name][:150])
    # A tip outside the picture is no keypoint.
    assert np.isnan(made.observed["left_u1_px"]).mean() > 0.1


def test_presets_without_absences_know_nothing_of_them() -> None:
    assert "absences" not in load_preset("paper").model_dump()["motion"]
    assert load_preset("in-and-out").model_dump(mode="json")["motion"]["absences"]["every_frames"] == [40, 100]


def test_wrong_absences_are_refused() -> None:
    with pytest.raises(ValidationError, match=r"out_frames must be \[fewest, most\]"):
        Absences(out_frames=(5, 4))
    with pytest.raises(ValidationError, match="absences needs kind: free"):
        Motion(kind="rcm", absences=Absences())
