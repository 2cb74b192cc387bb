"""The simulated hand: ring and wire by geometry, what a picture shows, and a ring led along a wire."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector, rotation_vector
from surgbench.randomness import generator
from surgbench.registry import create, find
from surgbench.tasks.viewpoint.conformance.worlds import DT_S, feature_poses, make_trial
from surgbench.viewpoint.hand.contact import RingOnWire, lasting_contacts, settle
from surgbench.viewpoint.hand.operation import Operating, OperationError, WorksFrom
from surgbench.viewpoint.hand.performance import performance
from surgbench.viewpoint.hand.person import Hand, People, Seen, draw_person
from surgbench.viewpoint.hand.sight import AUXILIARY, ENDOSCOPE, Sight
from surgbench.viewpoint.hand.turns import turn_between, turned
from surgbench.viewpoint.optics.teleoperation import Teleoperation, TeleoperationSettings
from surgbench.viewpoint.placement import look_at
from surgbench.viewpoint.simulator import make_scene
from surgbench.viewpoint.trial import Trial, Wire

RADIUS_M, TUBE_M, WIRE_M = 0.004, 0.0008, 0.001
CLEARANCE_M = RADIUS_M - TUBE_M - WIRE_M
ALONG = np.arange(-0.05, 0.05001, 0.0005)
STRAIGHT = Wire(np.outer(ALONG, [0.0, 1.0, 0.0]), WIRE_M, RADIUS_M, TUBE_M)
turns = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


def ring_at(offset_m: FloatArray, tilt_rad: float = 0.0) -> FloatArray:
    """A ring off a wire along y, tilted about x."""
    return rigid_transform(rotation_from_vector(np.array([tilt_rad, 0.0, 0.0])), offset_m)


# Ring and wire


@given(st.floats(0.0, 0.003), st.floats(0, 2 * np.pi), st.floats(-0.03, 0.03))
def test_the_gap_to_a_straight_wire_is_the_clearance_less_the_offset(off: float, way: float, along: float) -> None:
    offset = np.array([off * np.cos(way), along, off * np.sin(way)])
    expected = CLEARANCE_M - off
    assert RingOnWire.of(STRAIGHT).gap_m(ring_at(offset)) == pytest.approx(expected, abs=2e-6)


@given(st.floats(0.0, 1.2))
def test_a_centred_ring_that_is_tilted_lets_the_wire_through_its_ellipse(tilt: float) -> None:
    """Its smaller half axis is the cosine's: where that is less than tube and wire are thick, they touch."""
    gap = RingOnWire.of(STRAIGHT).gap_m(ring_at(np.zeros(3), tilt))
    assert gap == pytest.approx(RADIUS_M * np.cos(tilt) - TUBE_M - WIRE_M, abs=2e-6)


@given(
    st.tuples(*[st.floats(-0.008, 0.008)] * 3).map(np.array),
    st.floats(-0.9, 0.9),
    st.floats(0.015, 0.05),
)
def test_the_wire_stays_within_the_ring_wherever_the_hand_would_have_it(
    wanted: FloatArray, tilt: float, bend_m: float
) -> None:
    """A wire that is bent, too: the ring is pushed out of it, and never off it."""
    angle = ALONG / bend_m
    points = bend_m * np.stack([1 - np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    ring = RingOnWire.of(Wire(points, WIRE_M, RADIUS_M, TUBE_M))
    low, high = ring.near(float(ring.along_m[len(ALONG) // 2]))
    normal = ring_at(np.zeros(3), tilt)[:3, 1].copy()
    centre = wanted.copy()
    pressed = settle(ring.points_m, low, high, normal, RADIUS_M, TUBE_M + WIRE_M, centre)
    # The hand may want it a little beyond what is near the middle: its plane may cut the wire there.
    near = ring.points_m[low - 10 : high + 11]
    # The wire passes through the ring's plane within its circle.
    height = (near - centre) @ normal
    crossing = np.flatnonzero(np.diff(np.sign(height)) != 0)
    across = [np.linalg.norm((near[k] - centre) - height[k] * normal) for k in crossing]
    assert min(across) < RADIUS_M
    if pressed < 0:
        np.testing.assert_array_equal(centre, wanted)
    else:
        assert np.linalg.norm(centre - wanted) <= pressed + 1e-9


def test_a_ring_pressed_against_a_straight_wire_is_held_back_by_as_much_as_it_is_pressed() -> None:
    ring = RingOnWire.of(STRAIGHT)
    low, high = ring.near(0.05)
    centre = np.array([CLEARANCE_M + 0.003, 0.001, 0.0])
    pressed = settle(ring.points_m, low, high, np.array([0.0, 1.0, 0.0]), RADIUS_M, TUBE_M + WIRE_M, centre)
    assert pressed == pytest.approx(0.003, abs=5e-6)
    np.testing.assert_allclose(centre, [CLEARANCE_M, 0.001, 0.0], atol=5e-6)


def test_short_contacts_and_short_gaps_do_not_count() -> None:
    pressed = np.full(100, -0.001)
    pressed[10:12] = 0.001  # too short
    pressed[30:60] = 0.001
    pressed[40:43] = -0.001  # too short to end it
    pressed[60:70] = -0.0001  # not far enough apart to end it
    contact = lasting_contacts(pressed, 0.01, 0.0002, 0.1)
    np.testing.assert_array_equal(np.flatnonzero(contact), np.arange(30, 70))


@given(turns, turns)
def test_turns_are_those_of_geometry(one: FloatArray, other: FloatArray) -> None:
    first, second = rotation_from_vector(one), rotation_from_vector(other)
    np.testing.assert_allclose(turned(one, second), first @ second, atol=1e-12)
    expected = rotation_from_vector(rotation_vector(second @ first.T))
    np.testing.assert_allclose(rotation_from_vector(turn_between(first, second)), expected, atol=1e-9)


# What a picture shows


def test_depth_is_seen_the_worse_the_farther_away_and_the_shorter_the_baseline() -> None:
    near, far = (Sight(AUXILIARY, RADIUS_M, 0.25, 0.005).uncertainty(depth, 2)[0] for depth in (0.1, 0.2))
    assert far[2] == pytest.approx(4 * near[2])
    assert far[0] == pytest.approx(2 * near[0])
    assert near[2] == pytest.approx(np.sqrt(2) * 0.1**2 * 0.25 / (AUXILIARY.left.fx * 0.0265), rel=1e-3)
    endoscope = Sight(ENDOSCOPE, RADIUS_M, 0.25, 0.005).uncertainty(0.1, 2)[0]
    assert endoscope[2] / endoscope[0] == pytest.approx(np.sqrt(2) * 0.1 / 0.005)
    assert Sight(AUXILIARY, RADIUS_M, 0.25, 0.005).uncertainty(0.1, 1)[0][2] == 0.005


def test_the_tool_hides_the_ring_from_behind_and_a_picture_ends_at_its_border() -> None:
    sight, ring = Sight(AUXILIARY, RADIUS_M, 0.25, 0.005), np.eye(4)

    def eyes(direction: FloatArray) -> tuple[int, int]:
        camera = look_at(0.11 * direction / np.linalg.norm(direction), np.zeros(3))
        return sight.eyes(camera, ring)

    assert eyes(np.array([0.0, 1.0, 0.0])) == (2, 2)  # along its normal
    assert eyes(np.array([0.0, 0.0, 1.0])) == (2, 2)  # from where the tool points
    inside, free = eyes(np.array([0.0, 0.05, -1.0]))  # along the tool's shaft
    assert inside == 2
    assert free < 2
    away = look_at(np.array([0.0, 0.11, 0.0]), np.array([0.0, 0.11, 0.2]))
    assert sight.eyes(away, ring) == (0, 0)


# The hand


def test_a_hand_corrects_what_it_saw_a_delay_ago() -> None:
    person = draw_person(People().exact, np.random.default_rng(0))
    hand = Hand(person, CLEARANCE_M, 0.2, DT_S, np.random.default_rng(1))
    seen = Seen(np.array([0.0005, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), 1.0)
    delay = round(person.delay_s / DT_S)
    for _ in range(delay):
        hand.step(seen)
    np.testing.assert_array_equal(hand.master, np.eye(4))
    hand.step(seen)
    speed = 2 * (CLEARANCE_M - 0.0005) / person.steering_s
    expected = np.array([person.gain_hz * 0.0005, 0.0, speed]) * DT_S / 0.2
    np.testing.assert_allclose(hand.master[:3, 3], expected, rtol=1e-6, atol=1e-12)


def test_a_hand_that_sees_nothing_waits_and_then_feels_its_way() -> None:
    people = People().exact
    person = draw_person(people, np.random.default_rng(0))
    hand = Hand(person, CLEARANCE_M, 0.2, DT_S, np.random.default_rng(1))
    seen = Seen(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), 1.0)
    for _ in range(round(person.delay_s / DT_S) + 5):
        hand.step(seen)
    for _ in range(round(person.delay_s / DT_S)):
        hand.step(None)
    place = hand.master[0, 3]
    for _ in range(round(0.9 * people.patience_s / DT_S)):
        hand.step(None)
    assert hand.master[0, 3] == place
    for _ in range(round(1.1 * people.patience_s / DT_S)):
        hand.step(None)
    assert 0 < hand.master[0, 3] - place < people.slowest_m_s / 0.2 * people.patience_s


def test_the_clutch_brings_the_master_back_within_its_reach() -> None:
    people = People().exact
    hand = Hand(draw_person(people, np.random.default_rng(0)), CLEARANCE_M, 0.2, DT_S, np.random.default_rng(1))
    seen = Seen(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), 1.0)
    clutched = []
    for _ in range(2000):
        hand.step(seen)
        clutched.append(hand.clutch)
        assert np.linalg.norm(hand.master[:3, 3]) < people.reach_m + 0.002
    assert 0.02 < np.mean(clutched) < 0.3


def straight_trial() -> Trial:
    """A straight wire that climbs above the zone's middle, and a ring led along it, towards the camera arm."""
    tangent = np.array([0.6, -0.45, 0.66])
    tangent /= np.linalg.norm(tangent)
    points = np.array([0.0, 0.0, 0.035]) + np.outer(np.arange(-0.03, 0.0301, 0.0005), tangent)
    trial = make_trial(feature_poses(points, np.broadcast_to(tangent, points.shape)))
    assert trial.truth is not None
    return replace(trial, truth=replace(trial.truth, wire=Wire(points, WIRE_M, RADIUS_M, TUBE_M)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("works_from", "controller", "steady"),
    [("endoscope", "static", False), ("auxiliary", "static", False), ("auxiliary", "gaze", True)],
)
def test_an_exact_hand_leads_the_ring_there_and_back_without_contact(
    works_from: WorksFrom, controller: str, steady: bool
) -> None:
    """From each view; the camera that moves does not turn the tool here, and then it disturbs no hand."""
    trial, settings = straight_trial(), TeleoperationSettings(turns_with_view=not steady)
    operation = Operating(
        create(find("tracker", controller), {}),
        trial,
        make_scene(trial),
        works_from,
        draw_person(People().exact, np.random.default_rng(0)),
        generator(purpose="controller"),
        generator(purpose="noise"),
        teleoperation=settings,
    ).run()
    found = performance(operation, trial.dt_s)
    assert found["unfinished"] == 0
    assert found["collisions"] == 0
    # 50 mm there and 50 mm back, and beyond the end by what it is late, at no more than 2.2 mm / 0.33 s * 2.
    assert found["path_m"] == pytest.approx(0.1, rel=0.1)
    assert 0.1 / (2 * CLEARANCE_M / 0.33) < found["task_time_s"] < 20
    assert operation.trial.truth is not None
    assert operation.trial.truth.wire is not None
    middle, along = operation.trial.truth.wire.points_m.mean(axis=0), trial.T_world_feature[0, :3, 1]
    off = operation.trial.truth.T_world_feature[operation.begun :, :3, 3] - middle
    sideways = np.linalg.norm(off - (off @ along)[:, None] * along, axis=1)
    assert sideways.max() < 0.3 * CLEARANCE_M


@pytest.mark.slow
def test_the_same_hand_goes_the_same_way_however_far_it_is_looked_at() -> None:
    trial = straight_trial()

    def way(steps: int) -> FloatArray:
        return (
            Operating(
                create(find("tracker", "gaze"), {}),
                trial,
                make_scene(trial),
                "auxiliary",
                draw_person(People(), generator(person=3)),
                generator(purpose="controller"),
                generator(purpose="noise"),
                steps,
            )
            .run()
            .trial.T_world_feature
        )

    np.testing.assert_array_equal(way(300), way(420)[:300])


def test_a_trial_without_a_wire_is_told_in_one_line() -> None:
    trial = straight_trial()
    assert trial.truth is not None
    bare = replace(trial, truth=replace(trial.truth, wire=None))
    person = draw_person(People(), generator(person=0))
    with pytest.raises(OperationError, match="a hand needs a wire"):
        Operating(
            create(find("tracker", "static"), {}), bare, make_scene(bare), "endoscope", person,
            generator(purpose="a"), generator(purpose="b"),
        )  # fmt: skip


# Alignment


@given(turns, turns, st.tuples(*[st.floats(-0.1, 0.1)] * 3).map(np.array))
def test_a_steady_tool_is_not_turned_by_the_view_and_follows_it_afterwards(
    camera_turn: FloatArray, later: FloatArray, moved: FloatArray
) -> None:
    """It keeps its place and its orientation where the view is taken anew; what the hand does then, the view turns."""
    operation = Teleoperation(TeleoperationSettings(mean_of=1, turns_with_view=False))
    start = rigid_transform(rotation_from_vector(np.array([0.3, -0.2, 0.1])), np.array([0.0, 0.0, 0.1]))
    operation.reset(np.eye(4), np.eye(4), start)
    other = rigid_transform(rotation_from_vector(camera_turn), np.array([0.03, 0.0, 0.0]))
    np.testing.assert_allclose(operation.step(np.eye(4), other), start, atol=1e-9)
    np.testing.assert_allclose(operation.view, other, atol=1e-12)
    master = rigid_transform(rotation_from_vector(later), moved)
    tool = operation.step(master, other)
    view = other[:3, :3]
    np.testing.assert_allclose(tool[:3, 3] - start[:3, 3], 0.2 * view @ moved, atol=1e-12)
    turn = view @ master[:3, :3] @ view.T
    np.testing.assert_allclose(tool[:3, :3], turn @ start[:3, :3], atol=1e-9)
