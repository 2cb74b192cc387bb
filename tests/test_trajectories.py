from __future__ import annotations

import numpy as np
import pytest

from surgbench.errors import ConfigError
from surgbench.generators.place import clearance_m
from surgbench.generators.presets import Preset, Workspace, load_preset
from surgbench.generators.trajectories import make_pair, ornstein_uhlenbeck
from surgbench.geometry import FloatArray, look_at_rotation, wrap_angle
from surgbench.instrument import Instrument, load_instrument
from surgbench.randomness import generator
from surgbench.state import ALPHA, ANGLES, BETA, GAMMA, JOINTS, POSITION

FRAMES = 200
SEEDS = range(2)


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    return load_instrument("large_needle_driver")


@pytest.fixture(scope="module")
def preset() -> Preset:
    return load_preset("paper")


@pytest.fixture(scope="module")
def pairs(instrument: Instrument, preset: Preset) -> dict[str, list[FloatArray]]:
    return {
        speed: [make_pair(preset, instrument, speed, FRAMES, generator(test=seed)) for seed in SEEDS]
        for speed in ("nominal", "fast")
    }


def test_tips_and_wrist_are_inside_the_image_in_every_frame(
    pairs: dict[str, list[FloatArray]], instrument: Instrument, preset: Preset
) -> None:
    margin_px = preset.workspace.tip_margin * preset.camera.height
    for states in [*pairs["nominal"], *pairs["fast"]]:
        tips = preset.camera.project(instrument.tips_cam(states))
        assert tips.shape == (FRAMES, 2, 2, 2)
        assert preset.camera.contains(tips, margin_px).all()
        assert preset.camera.contains(preset.camera.project(states[..., POSITION])).all()


def test_joints_stay_within_their_limits_and_use_them(
    pairs: dict[str, list[FloatArray]], instrument: Instrument
) -> None:
    limits = instrument.generate_limits
    joints = np.concatenate([*pairs["nominal"], *pairs["fast"]])[..., JOINTS]
    assert (joints >= limits.lower_rad).all()
    assert (joints <= limits.upper_rad).all()
    assert (np.ptp(joints, axis=(0, 1)) > 0.6 * (limits.upper_rad - limits.lower_rad)).all()


@pytest.mark.parametrize(("arm", "edge"), [(0, "left"), (1, "right")])
def test_shafts_enter_from_their_own_side(
    pairs: dict[str, list[FloatArray]], instrument: Instrument, preset: Preset, arm: int, edge: str
) -> None:
    camera = preset.camera
    for pair in pairs["nominal"]:
        for state in pair[::20, arm]:
            axis = look_at_rotation(state[ANGLES])[:, 2]
            back = state[POSITION] - np.linspace(0, 0.3, 20_000)[:, None] * axis
            pixels = camera.project(back)
            first_outside = pixels[np.argmin(camera.contains(pixels))]
            assert 0 < first_outside[1] < camera.height - 1
            assert first_outside[0] < 0 if edge == "left" else first_outside[0] > camera.width - 1


def test_arms_keep_apart_and_are_mostly_side_by_side(
    pairs: dict[str, list[FloatArray]], instrument: Instrument, preset: Preset
) -> None:
    for states in [*pairs["nominal"], *pairs["fast"]]:
        assert clearance_m(instrument, states[:, 0], states[:, 1]).min() >= preset.workspace.clearance_m
        left, right = preset.camera.project(states[..., POSITION])[..., 0].T
        assert (left < right).mean() > 0.8


def test_clearance_is_the_distance_between_centre_lines(instrument: Instrument) -> None:
    state = np.array([0.3, 0.4, 0.8, 0.0, 0.0, 0.13, 0.0, 0.0, 0.0])
    axis = look_at_rotation(state[ANGLES])
    beside = state.copy()
    beside[POSITION] += 0.02 * axis[:, 0]
    assert clearance_m(instrument, state, state) == pytest.approx(0.0, abs=1e-7)
    assert clearance_m(instrument, state, beside) == pytest.approx(0.02, abs=1e-3)


def test_waypoints_keep_distance_and_elevation(instrument: Instrument, preset: Preset) -> None:
    motion = preset.motion.model_copy(
        update={"ou_sigma_angles_rad": (0.0, 0.0, 0.0), "ou_sigma_position_m": 0.0, "ou_sigma_joints_rad": 0.0}
    )
    still = preset.model_copy(update={"motion": motion})
    states = make_pair(still, instrument, "nominal", 401, generator(test="waypoints"))[::50]
    elevation = np.arcsin(look_at_rotation(states[..., ANGLES])[..., 2, 2])
    distance = np.linalg.norm(states[..., POSITION], axis=-1)
    # The low-pass filter rounds the waypoints off a little.
    assert ((elevation > np.radians(29.5)) & (elevation < np.radians(60.5))).all()
    assert ((distance > 0.0995) & (distance < 0.1705)).all()


def test_motion_is_smooth_and_fast_is_about_twice_nominal(pairs: dict[str, list[FloatArray]]) -> None:
    speed = {}
    for name, group in pairs.items():
        change = np.concatenate([np.diff(states, axis=0) for states in group])
        change[..., ANGLES] = wrap_angle(change[..., ANGLES])
        speed[name] = np.linalg.norm(change[..., POSITION], axis=-1)
        assert np.abs(change[..., [ALPHA, GAMMA]]).max() < 0.04
        assert np.abs(change[..., BETA]).max() < 0.08
        assert np.abs(change[..., JOINTS]).max() < 0.06
    assert 0.3e-3 < speed["nominal"].mean() < 0.9e-3
    assert speed["nominal"].max() < 2e-3
    assert 1.6 < speed["fast"].mean() / speed["nominal"].mean() < 2.2


def test_angles_are_wrapped(pairs: dict[str, list[FloatArray]]) -> None:
    states = np.concatenate(pairs["fast"])
    assert np.abs(states[..., ANGLES]).max() <= np.pi
    assert np.abs(states[..., ALPHA]).max() <= np.pi / 2


def test_the_generator_alone_decides(instrument: Instrument, preset: Preset) -> None:
    one, same, other = (make_pair(preset, instrument, "fast", 60, generator(test=seed)) for seed in (0, 0, 1))
    assert np.array_equal(one, same)
    assert not np.allclose(one[0], other[0])


@pytest.mark.parametrize("frames", [2, 3, 25, 51])
def test_short_trajectories(instrument: Instrument, preset: Preset, frames: int) -> None:
    assert make_pair(preset, instrument, "nominal", frames, generator(test=0)).shape == (frames, 2, 9)


def test_an_impossible_workspace_is_one_clear_line(instrument: Instrument, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surgbench.generators.trajectories.PATHS", 2)
    preset = Preset(name="tight", pairs=1, frames=3, workspace=Workspace(clearance_m=0.5))
    with pytest.raises(ConfigError, match=r"^preset 'tight': no feasible nominal trajectory of 3 frames[^\n]*$"):
        make_pair(preset, instrument, "nominal", 3, generator(test=0))


def test_ornstein_uhlenbeck_is_stationary_and_correlated() -> None:
    noise = ornstein_uhlenbeck((400, 2000), 0.9, generator(test="ou"))
    assert noise[0].std() == pytest.approx(1.0, abs=0.06)
    assert noise[-1].std() == pytest.approx(1.0, abs=0.06)
    assert np.mean(noise[10] * noise[9]) == pytest.approx(0.9, abs=0.08)
    assert np.mean(noise[20] * noise[10]) == pytest.approx(0.9**10, abs=0.08)
