from __future__ import annotations

import numpy as np
import pytest

from surgbench.errors import ConfigError
from surgbench.generators.place import Place, clearance_m
from surgbench.generators.presets import Preset, Workspace, load_preset
from surgbench.generators.trajectories import PairMotion, low_pass, make_motion, make_pair, ornstein_uhlenbeck
from surgbench.geometry import FloatArray, look_at_rotation, wrap_angle
from surgbench.instrument import Instrument, load_instrument
from surgbench.randomness import generator
from surgbench.state import ALPHA, ANGLES, BETA, GAMMA, JOINTS, POSITION
from surgbench.tasks.instrument.format import ARMS

FRAMES = 200
SEEDS = range(2)


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    return load_instrument("large_needle_driver")


@pytest.fixture(scope="module")
def preset() -> Preset:
    return load_preset("paper-wide")


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


@pytest.mark.slow
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


@pytest.fixture(scope="module")
def published(instrument: Instrument) -> dict[str, list[FloatArray]]:
    """Both halves of ``paper``, four waypoints of each."""
    preset = load_preset("paper")
    frames = {"nominal": 201, "fast": 401}
    return {
        speed: [make_pair(preset, instrument, speed, frames[speed], generator(test=seed)) for seed in SEEDS]
        for speed in frames
    }


@pytest.mark.slow
def test_the_articles_fast_half_goes_further_but_not_faster_a_frame(published: dict[str, list[FloatArray]]) -> None:
    """Its waypoints are those of fast recordings, stretched to twice as many frames."""
    way, step = {}, {}
    for speed, interval in (("nominal", 50), ("fast", 100)):
        places = np.stack(published[speed])[..., POSITION]
        way[speed] = np.linalg.norm(np.diff(places[:, ::interval], axis=1), axis=-1).mean()
        step[speed] = np.linalg.norm(np.diff(places, axis=1), axis=-1).mean()
    assert way["fast"] > 1.15 * way["nominal"]
    assert step["fast"] < step["nominal"]


@pytest.mark.slow
def test_the_articles_joints_are_where_surgpose_commands_them(published: dict[str, list[FloatArray]]) -> None:
    """Wrist pitch 0 to 0.6, yaw ±0.6, half jaw 0 to 0.25 rad, but for the noise of 0.02 rad."""
    joints = np.concatenate([*published["nominal"], *published["fast"]])[..., JOINTS].reshape(-1, 3)
    assert (joints > np.array([0.0, -0.6, 0.0]) - 0.06).all()
    assert (joints < np.array([0.6, 0.6, 0.25]) + 0.06).all()
    assert (np.ptp(joints, axis=0) > [0.35, 0.6, 0.12]).all()


def test_one_euro_smoothing_answers_a_step_as_a_low_pass_of_first_order() -> None:
    """``1 - exp(-2 pi f t)`` in the limit of many frames a second; a constant stays, and no value knows later ones."""
    motion = load_preset("paper").motion
    rate_hz = 3000.0
    step = np.repeat([[0.0], [1.0]], [10, 3000], axis=0)
    answer = low_pass(step, motion, rate_hz)[10:, 0]
    expected = 1.0 - np.exp(-2.0 * np.pi * 0.75 * np.arange(1, 3001) / rate_hz)
    np.testing.assert_allclose(answer, expected, atol=2e-3)
    np.testing.assert_allclose(low_pass(np.full((50, 2), 3.0), motion, 30.0), 3.0, rtol=1e-12)
    assert (low_pass(step, motion, 30.0)[:10] == 0.0).all()


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


@pytest.mark.slow
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


# Whole arms about fixed remote centres


@pytest.fixture(scope="module")
def rcm() -> Preset:
    return load_preset("paper-rcm")


@pytest.fixture(scope="module")
def moved(instrument: Instrument, rcm: Preset) -> list[PairMotion]:
    speeds = ["nominal"] * len(SEEDS) + ["fast"] * len(SEEDS)
    return [
        make_motion(rcm, instrument, speed, 400, generator(test=seed))
        for speed, seed in zip(speeds, [*SEEDS, *SEEDS], strict=True)
    ]


def test_all_shafts_of_an_arm_pass_through_its_remote_centre(moved: list[PairMotion], rcm: Preset) -> None:
    for motion in moved:
        for index, robot in enumerate(motion.arms):
            assert robot is not None
            states = motion.states[:, index]
            axis = look_at_rotation(states[:, ANGLES])[..., 2]
            # The point nearest to all shafts, from the states alone.
            across = np.eye(3) - axis[:, :, None] * axis[:, None]
            centre = np.linalg.solve(across.sum(axis=0), (across @ states[:, POSITION, None]).sum(axis=0)[:, 0])
            assert np.linalg.norm(across @ (centre - states[:, POSITION])[..., None], axis=1).max() < 1e-9
            np.testing.assert_allclose(centre, robot.T_cam_base[:3, 3], atol=1e-9)
            assert not rcm.camera.contains(rcm.camera.project(centre))


def test_arm_joints_are_within_limits_and_give_the_states(moved: list[PairMotion]) -> None:
    for motion in moved:
        for index, robot in enumerate(motion.arms):
            assert robot is not None
            assert robot.arm.within_limits(robot.arm_joints).all()
            depth_m = robot.arm.depth_m(robot.arm_joints[:, 2])
            assert depth_m.min() > 0.05
            assert depth_m.max() < 0.3237
            wrist = robot.T_cam_base @ robot.arm.forward(robot.arm_joints)
            states = motion.states[:, index]
            np.testing.assert_allclose(wrist[:, :3, :3], look_at_rotation(states[:, ANGLES]), atol=1e-9)
            np.testing.assert_allclose(wrist[:, :3, 3], states[:, POSITION], atol=1e-12)


def test_whole_arms_keep_all_bounds_in_every_frame(
    moved: list[PairMotion], instrument: Instrument, rcm: Preset
) -> None:
    space, limits = rcm.workspace, instrument.generate_limits
    for motion in moved:
        states = motion.states
        for index, arm in enumerate(ARMS):
            place = Place(arm, space, rcm.camera, instrument)
            assert place.in_workspace(states[:, index]).all()
            assert place.allows(states[:, index], space.tip_margin).all()
        assert clearance_m(instrument, states[:, 0], states[:, 1]).min() >= space.clearance_m
        assert ((states[..., JOINTS] >= limits.lower_rad) & (states[..., JOINTS] <= limits.upper_rad)).all()
        assert np.abs(states[..., ANGLES]).max() <= np.pi


def test_whole_arms_move_about_as_fast_as_free_ones(moved: list[PairMotion]) -> None:
    def speed(motion: PairMotion) -> float:
        return float(np.linalg.norm(np.diff(motion.states[..., POSITION], axis=0), axis=-1).mean())

    nominal, fast = np.mean([speed(motion) for motion in moved[:2]]), np.mean([speed(motion) for motion in moved[2:]])
    assert 0.3e-3 < nominal < 0.9e-3
    assert 1.6 < fast / nominal < 2.2
    # Each arm visits a good part of the workspace, and not the same for all.
    for motion in moved:
        assert (np.ptp(motion.states[..., POSITION], axis=0) > 0.015).all()
    centres = np.array([[robot.T_cam_base[:3, 3] for robot in motion.arms if robot] for motion in moved[:2]])
    assert (np.linalg.norm(centres[0] - centres[1], axis=-1) > 0.005).all()


def test_a_workspace_that_no_arm_reaches_is_one_clear_line(
    instrument: Instrument, rcm: Preset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("surgbench.generators.trajectories.PATHS", 2)
    tight = rcm.model_copy(update={"workspace": Workspace(reach=(0.99, 1.0))})
    with pytest.raises(ConfigError, match=r"^preset 'paper-rcm': no feasible nominal trajectory of 3 frames[^\n]*$"):
        make_motion(tight, instrument, "nominal", 3, generator(test=0))
