"""The catalogue: figures of the dVRK's table, bodies that are closed, tips on them, symmetry as silhouettes have it."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import label

from surgbench.camera import Camera
from surgbench.config import packaged_names
from surgbench.instrument import Instrument, load_instrument, save_instrument
from surgbench.instrument.inspection import MANY_TRIANGLES, ON_BODY_M, inspect
from surgbench.instrument.measures import SAME_IOU, measured_symmetry, shaft_diameter_m, triangles, wrist_length_m
from surgbench.instrument.meshes import signed_volume
from surgbench.instrument.plausibility import exact_distance_to_body
from surgbench.silhouette import SilhouetteEvaluator

NAMES = packaged_names("instruments")

STANDARD = (-1.5632, 0, 0, 0, 0, 1.0186, 0, 0, 0, -0.8306, 0.6089, 0.6089, 0, 0, -1.2177, 1.2177)
BIPOLAR = (-1.563233, 0, 0, 0, 0, 1, 0, 0, 0, -0.630273, 0.457982, 0.457982, 0, 0, -0.915964, 0.915964)
MEGA = (-1.5575, 0, 0, 0, 0, 1, 0, 0, 0, -0.456081, 0.368243, 0.368243, 0, 0, -0.736486, 0.736486)
PROGRASP = (-1.5631, 0, 0, 0, 0, 1, 0, 0, 0, -0.5068, -0.5135, -0.5135, 0, 0, -0.5279, 0.5279)
CAUTERY = (-1.5632, 0, 0, 0, 0, 1.1353, 0, 0, 0, 0.7827, -1.0582, 0, 0, 0, 0, 1)
# Of the dVRK's files share/tool/*.json: number of the S model (the Si's is 20000 more), pitch to yaw axis, limits of
# pitch and yaw (to either side) and of the whole jaw, coupling.
TABLE: dict[str, tuple[int, float, float, float, tuple[float, float], tuple[float, ...]]] = {
    "mega_needle_driver": (400194, 0.0112, 1.2217, 1.39626, (-0.349066, 1.39626), MEGA),
    "prograsp_forceps": (400093, 0.0107, 1.39626, 1.39626, (-0.349066, 1.39626), PROGRASP),
    "cadiere_forceps": (400049, 0.0091, 1.39626, 1.39626, (-0.349066, 1.39626), STANDARD),
    "fenestrated_bipolar_forceps": (400205, 0.0107, 1.2217, 1.5708, (-0.698132, 1.39626), BIPOLAR),
    "maryland_bipolar_forceps": (400172, 0.0107, 1.2217, 1.5708, (-0.349066, 1.39626), BIPOLAR),
    "debakey_forceps": (400036, 0.0091, 1.39626, 1.39626, (-0.349066, 1.39626), STANDARD),
    "long_tip_forceps": (400048, 0.0091, 1.39626, 1.39626, (-0.349066, 1.39626), STANDARD),
    "monopolar_curved_scissors": (400179, 0.0091, 1.39626, 1.39626, (-0.349066, 1.39626), STANDARD),
    "round_tip_scissors": (400007, 0.0091, 1.39626, 1.39626, (-0.698132, 0.698132), STANDARD),
    "permanent_cautery_hook": (400183, 0.0093, 1.39626, 1.4835, (0.0, 0.5), CAUTERY),
    "permanent_cautery_spatula": (400184, 0.0093, 1.39626, 1.4835, (0.0, 0.5), CAUTERY),
}


@cache
def loaded(name: str) -> Instrument:
    return load_instrument(name)


def test_the_set_is_whole() -> None:
    assert set(NAMES) == {*TABLE, "large_needle_driver", "suction_irrigator"}


@pytest.mark.parametrize("name", TABLE)
def test_kinematics_are_those_of_the_table(name: str) -> None:
    number, pitch_to_yaw_m, pitch, yaw, jaw, coupling = TABLE[name]
    instrument = loaded(name)
    assert wrist_length_m(instrument) == pytest.approx(pitch_to_yaw_m, abs=1e-12)
    limits = instrument.generate_limits
    np.testing.assert_allclose(limits.upper_rad, [pitch, yaw, jaw[1] / 2], atol=1e-5)
    np.testing.assert_allclose(limits.lower_rad, [-pitch, -yaw, 0.0], atol=1e-5)
    generations = {"Classic, S": (number, 0.4162), "Si": (number + 20000, 0.467)}
    assert [model.generation for model in instrument.spec.models] == list(generations)
    for model in instrument.spec.models:
        assert (int(model.number), model.roll_d_m) == generations[model.generation]
        assert model.wrist_pitch_rad == (-pitch, pitch)
        assert model.wrist_yaw_rad == (-yaw, yaw)
        assert model.jaw_rad == jaw
        np.testing.assert_array_equal(np.ravel(np.array(model.coupling)), coupling)


@pytest.mark.parametrize("name", NAMES)
def test_bodies_are_light_face_outward_and_bear_the_tips(name: str) -> None:
    instrument = loaded(name)
    assert triangles(instrument) <= MANY_TRIANGLES
    assert shaft_diameter_m(instrument) == pytest.approx(0.0083, abs=1e-4)
    for link, mesh in instrument.meshes.items():
        assert signed_volume(mesh.vertices_m, mesh.faces) > 0, link
    for tip in instrument.spec.tips:
        assert exact_distance_to_body(instrument.meshes[tip.link], np.array(tip.point_m)) < ON_BODY_M
    assert not inspect(name).wrong


@pytest.mark.parametrize("name", NAMES)
def test_the_declared_symmetry_is_that_of_the_silhouettes(name: str) -> None:
    seen = measured_symmetry(loaded(name), count=40)
    declared = loaded(name).symmetry
    assert (seen.axis >= SAME_IOU) == (declared == "axis")
    assert (seen.twin >= SAME_IOU) == (declared != "none")


def test_what_tools_have_not_is_not_seen() -> None:
    assert loaded("permanent_cautery_hook").observable == {"roll", "wrist_pitch", "wrist_yaw"}
    assert loaded("suction_irrigator").observable == set()
    one_tip = {name for name in NAMES if not loaded(name).has_two_tips}
    assert one_tip == {"permanent_cautery_hook", "permanent_cautery_spatula", "suction_irrigator"}


@pytest.mark.parametrize("name", ["cadiere_forceps", "prograsp_forceps", "fenestrated_bipolar_forceps"])
def test_windows_are_seen_through(name: str) -> None:
    instrument = loaded(name)
    jaw: Any = next(part for part in instrument.spec.links[-1].parts if part.kind == "jaw")
    hole = jaw.holes[0]
    # Seen along y of the wrist-pitch frame, across which the jaws lie flat; nothing but one jaw.
    camera = Camera(width=400, height=400, fx=2000, fy=2000, cx=200, cy=200)
    alone = Instrument(instrument.spec, {"jaw_left": instrument.meshes["jaw_left"]})
    middle = wrist_length_m(instrument) or 0.0
    half_way = middle + (hole.from_m + hole.to_m) / 2
    # alpha turns the shaft so that its z is the image's up or down: the jaw's flat side is to the eye.
    mask = SilhouetteEvaluator([alone], camera).mask(np.array([np.pi / 2, 0, 0, 0, half_way, 0.15, 0, 0, 0]))
    parts, _ = label(mask == 0)
    inside = parts == parts[200, 200]
    assert mask[200, 200] == 0
    assert parts[200, 200] != parts[0, 0]
    expected_m2 = hole.width_m * (hole.to_m - hole.from_m) - (1 - np.pi / 4) * hole.width_m**2
    assert inside.sum() * (0.15 / 2000) ** 2 == pytest.approx(expected_m2, rel=0.06)


@pytest.mark.parametrize("name", ["cadiere_forceps", "suction_irrigator"])
def test_a_saved_copy_is_the_same_to_the_bit(name: str, tmp_path: Any) -> None:
    save_instrument(loaded(name), tmp_path)
    copy = load_instrument(tmp_path / "instrument.yaml")
    assert copy.spec.models == loaded(name).spec.models
    assert copy.symmetry == loaded(name).symmetry
    for link, mesh in loaded(name).meshes.items():
        np.testing.assert_array_equal(copy.meshes[link].vertices_m, mesh.vertices_m)
        np.testing.assert_array_equal(copy.meshes[link].faces, mesh.faces)
