"""One trial: wires are drawn until one is constrained as often as the level says."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from surgbench.errors import ConfigError
from surgbench.generators.wire_chaser.hand import RingMotion, draw_travel, draw_truncated, lead_ring, lean, stretch_m
from surgbench.generators.wire_chaser.presets import Measurement, WireChaser
from surgbench.generators.wire_chaser.scene import TROCAR_M, draw_surroundings
from surgbench.generators.wire_chaser.wire import WireShape, search_wire, tool_axes
from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.randomness import generator
from surgbench.viewpoint.placement import naive_pose, violations
from surgbench.viewpoint.setting_up import rest
from surgbench.viewpoint.trial import Trial, TrialTruth, Wire

# Wires looked at before they, and what stands around them, are drawn anew.
WIRES_PER_SCENE = 500
# Ways of leading the ring along a wire that are tried.
LEADS = 4
MOST_PARTS = 4
# Places of the wire at which the constraints are looked at, each with some tilts of the ring.
LOOKED_AT, TILTS = 60, 2
# What a share that is wrong by 1 lacks, where a wire that is 1 cm out of its box lacks 1.
SHARE_WEIGHT = 4.0


class StoppedError(Exception):
    """Work was called off."""


def draw_samples(preset: WireChaser, trial_id: str) -> int:
    """How many samples a trial has."""
    rng = generator(dataset=preset.seed, sequence=trial_id, purpose="duration")
    drawn = round(draw_truncated(*preset.hand.duration_s, preset.hand.duration_range_s, rng) / preset.dt_s)
    return int(drawn if preset.samples is None else preset.samples)


def make_trial(preset: WireChaser, trial_id: str, go_on: Callable[[], bool] = lambda: True) -> Trial:
    """A trial, truth included.

    Args:
        preset: Everything that decides on it.
        trial_id: Its id, the other half of its seed.
        go_on: Asked now and then.

    Raises:
        ConfigError: No wire was found that is constrained as often as it should be.
        StoppedError: ``go_on`` said no.
    """
    rng = generator(dataset=preset.seed, sequence=trial_id, purpose="trial")
    samples = draw_samples(preset, trial_id)
    left = preset.tries
    while left > 0:
        if not go_on():
            raise StoppedError
        world = _World(preset, rng)
        wire, used = search_wire(preset.wire, world.lack, min(left, WIRES_PER_SCENE), rng)
        left -= used
        found = None if wire is None else world.trial(trial_id, wire.moved(world.around.T_world_box), samples, rng)
        if found is not None:
            return found
    low, high = preset.constrained
    raise ConfigError(
        f"preset '{preset.name}': trial '{trial_id}': none of {preset.tries} wires is as it should be and has "
        f"{low:.0%} to {high:.0%} constrained samples; widen wire.extent_m, wire.length_m or share, or raise tries"
    )


def measure(T_world_feature: FloatArray, settings: Measurement, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """Poses ``(T, 4, 4)`` as the robot reports them; NaN in gaps."""
    count = len(T_world_feature)
    # A Gaussian vector is as long as sqrt(8 / pi) standard deviations of its components in the mean.
    constant = rng.standard_normal((2, 3)) / np.sqrt(8.0 / np.pi)
    noise = rng.standard_normal((2, count, 3))
    turn = settings.constant_rad * constant[0] + settings.noise_rad * noise[0]
    shift = settings.constant_m * constant[1] + settings.noise_m * noise[1]
    rotation = T_world_feature[:, :3, :3] @ rotation_from_vector(turn)
    reported = rigid_transform(rotation, T_world_feature[:, :3, 3] + shift)
    begins = np.flatnonzero(rng.random(count) < settings.dropout)
    for begin, length in zip(begins, rng.exponential(settings.dropout_s / dt_s, len(begins)), strict=True):
        reported[begin : begin + max(1, round(length))] = np.nan
    return reported


class _World:
    """What stands around the wire, and wires in it."""

    def __init__(self, preset: WireChaser, rng: np.random.Generator) -> None:
        self.preset = preset
        self.arm = preset.arm
        self.around = draw_surroundings(preset, rng)
        self._tilts = np.mean(preset.hand.wobble_rad) / np.sqrt(2.0) * rng.standard_normal((LOOKED_AT * TILTS, 3))

    @cached_property
    def towards(self) -> FloatArray:
        """``(3,)`` unit vector from the box to the camera arm's remote centre."""
        away = self.around.T_world_base[:3, 3] - self.around.centre_m
        return np.asarray(away / np.linalg.norm(away))

    def side(self, wire: WireShape) -> float:
        """Along a wire in the world (1) or back along it (-1): where the normal is that the camera arm sees more of."""
        return 1.0 if wire.tangent.mean(axis=0) @ self.towards >= 0 else -1.0

    def share(self, T_world_feature: FloatArray) -> float:
        """Share of ``(T, 4, 4)`` poses at which rules speak against the best pose."""
        pose = naive_pose(T_world_feature, self.preset.rules.distance_m)
        place = T_world_feature[:, :3, 3]
        found = violations(pose, place, self.around.workspace, self.arm, self.around.registered)
        # An arm with locked joints hardly ever reaches the best pose itself: then the other rules make the share.
        against = found.stacked()[..., :-1].any(axis=-1) if self.arm.locked.any() else found.any
        return float(against.mean())

    def lack(self, wire: WireShape) -> float:
        """By how much a wire, in the box, misses the wanted share, wherever on it the ring may rest."""
        wire = wire.moved(self.around.T_world_box)
        evenly = np.linspace(0.0, wire.length_m, LOOKED_AT)
        places = np.searchsorted(wire.along_m, evenly).clip(0, len(wire.along_m) - 1).repeat(TILTS)
        normal = lean(self.side(wire) * wire.tangent[places], self.towards, self.preset.hand.lean) + self._tilts
        poses = np.tile(np.eye(4), (len(places), 1, 1))
        poses[:, :3, 1] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        poses[:, :3, 3] = wire.points_m[places]
        low, high = self.preset.constrained
        share = self.share(poses)
        return float(SHARE_WEIGHT * max(low - share, share - high, 0.0))

    def trial(self, trial_id: str, wire: WireShape, samples: int, rng: np.random.Generator) -> Trial | None:
        """The ring led along a wire in the world; ``None`` if it is not constrained as often as it should be."""
        preset, around = self.preset, self.around
        low, high = preset.constrained
        side = self.side(wire)
        tool = tool_axes(wire, around.centre_m + TROCAR_M)
        # A part of the wire is not as constrained as the whole: where there is time for a part only, try more of them.
        parts = np.ceil(wire.length_m / stretch_m(wire, samples * preset.dt_s, preset.hand))
        for _ in range(LEADS * int(min(parts, MOST_PARTS)) ** 2):
            travel = draw_travel(wire, samples, preset.dt_s, preset.hand, rng)
            motion = lead_ring(wire, side, tool, self.towards, travel, preset.dt_s, preset.wire, preset.hand, rng)
            reported = measure(motion.T_world_feature, preset.measurement, preset.dt_s, rng)
            seen = reported[np.isfinite(reported).all(axis=(1, 2))]
            if not len(seen) or not low <= self.share(seen) <= high:
                continue
            first = seen[0]
            start = rest(first, preset.rules.distance_m, around.workspace, self.arm, around.registered)
            if start is not None:
                return self._assemble(trial_id, wire, motion, reported, start)
        return None

    def _assemble(
        self, trial_id: str, wire: WireShape, motion: RingMotion, reported: FloatArray, start: FloatArray
    ) -> Trial:
        around, settings, rules = self.around, self.preset.wire, self.preset.rules
        drawn = Wire(wire.points_m, settings.radius_m, settings.ring_radius_m, settings.tube_radius_m)
        return Trial(
            trial_id,
            self.preset.dt_s,
            self.preset.dt_s * np.arange(len(reported)),
            reported,
            around.reported,
            around.touches,
            around.zone_m,
            start,
            TrialTruth(motion.T_world_feature, around.T_world_base, motion.contact, drawn),
            rules.distance_m,
            rules.floor_m,
            rules.proximity_m,
            rules.preferred_side,
            self.arm,
        )
