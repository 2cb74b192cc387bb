"""How a hand leads the ring along the wire: sub-movements and rests, wobble, play, tremor, contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter, sosfiltfilt

from surgbench.generators.wire_chaser.presets import Hand, WireSettings
from surgbench.generators.wire_chaser.wire import WireShape
from surgbench.geometry import FloatArray, rigid_transform, rotation_from_vector
from surgbench.viewpoint.hand.contact import lasting_contacts

# A movement's pace turns on and off over this time.
EASE_S = 0.15
# Wire at either end of the way of a short trial, at least, where there is that much.
WARM_UP = 8.0


@dataclass(frozen=True)
class Travel:
    """How far the ring is, T samples.

    Attributes:
        along_m: ``(T,)`` length of wire from its start.
        pace: ``(T,)`` how fast all that is not the way itself goes on: 1 in a movement, less at rest, 0 with the clutch
            pressed.
    """

    along_m: FloatArray
    pace: FloatArray


@dataclass(frozen=True)
class RingMotion:
    """How the ring moves, T samples.

    Attributes:
        T_world_feature: ``(T, 4, 4)``; y axis along the normal.
        contact: ``(T,)`` whether it touches the wire.
        offset_m: ``(T,)`` from the wire's centre line to the ring's centre.
        limit_m: ``(T,)`` how far that may be in this direction, with this tilt.
    """

    T_world_feature: FloatArray
    contact: NDArray[np.bool_]
    offset_m: FloatArray
    limit_m: FloatArray


def draw_truncated(mean: float, deviation: float, bounds: tuple[float, float], rng: np.random.Generator) -> float:
    """A normally distributed number, drawn again until it is within the bounds, which hold the mean."""
    while True:
        value = mean + deviation * rng.standard_normal()
        if bounds[0] <= value <= bounds[1]:
            return float(value)


def stretch_m(wire: WireShape, time_s: float, hand: Hand) -> float:
    """How much of the wire the ring goes along, there and back."""
    return float(min(wire.length_m, hand.speed_m_s * time_s / 2))


def draw_travel(wire: WireShape, samples: int, dt_s: float, hand: Hand, rng: np.random.Generator) -> Travel:
    """There and back along the wire, or a part of it where time is short.

    Movements have the least jerk (``10 t^3 - 15 t^4 + 6 t^5``) in a measure of the way that is the longer the more the
    wire is bent, so that the speed follows the curvature's power.
    """
    total_s = (samples - 1) * dt_s
    stretch = stretch_m(wire, total_s, hand)
    start = rng.uniform(0.0, wire.length_m - stretch)
    moving_s = (1.0 - rng.uniform(*hand.rest_share)) * total_s
    ways = [_movements(moving_s / 2, hand, rng) for _ in range(2)]
    durations = np.concatenate([durations for durations, _ in ways])
    shares = np.concatenate([shares / 2 for _, shares in ways])
    rests, clutched = _rests(len(durations) + 1, total_s - durations.sum(), hand, rng)
    begins = np.cumsum(rests)[:-1] + np.append(0.0, np.cumsum(durations)[:-1])
    time: FloatArray = dt_s * np.arange(samples, dtype=np.float64)
    progress = np.clip((time[:, None] - begins) / durations, 0.0, 1.0)
    travelled = (progress**3 * (10.0 - 15.0 * progress + 6.0 * progress**2)) @ shares
    pace = _pace(time, begins, durations, clutched, dt_s, hand)

    # The measure of the way: along the stretch, then back.
    inside = (wire.along_m >= start) & (wire.along_m <= start + stretch)
    places = np.unique(np.concatenate([[start], wire.along_m[inside], [start + stretch]]))
    bend = np.interp(places, wire.along_m, wire.curvature) / np.median(wire.curvature)
    weight = np.clip(bend, *hand.curvature_range) ** hand.curvature_power
    measure = np.append(0.0, np.cumsum((weight[1:] + weight[:-1]) / 2 * np.diff(places)))
    measure /= measure[-1]
    folded = 1.0 - np.abs(2.0 * np.clip(travelled, 0.0, 1.0) - 1.0)
    return Travel(np.interp(folded, measure, places), pace)


def lead_ring(
    wire: WireShape,
    side: float,
    tool: FloatArray,
    towards: FloatArray,
    travel: Travel,
    dt_s: float,
    settings: WireSettings,
    hand: Hand,
    rng: np.random.Generator,
) -> RingMotion:
    """Where the ring is, sample by sample.

    The ring's centre would be where the hand has it, beside the wire; where that is farther than tube and wire let it
    be, they touch, and it is there. A ring tilted by theta against the wire lets the wire through an ellipse whose
    smaller half axis is ``ring_radius_m cos(theta)``, less the radii of tube and wire.

    Args:
        wire: The wire in the world.
        side: 1 where the ring's normal goes along the wire, -1 where it goes back along it.
        tool: ``(n, 3)`` where the tool points that holds the ring, by the wire's places, square to the wire.
        towards: ``(3,)`` unit vector: whither the hand leans the normal.
        travel: How far it is.
        dt_s: Seconds between samples.
        settings: The radii.
        hand: How steady it is.
        rng: The only source of randomness.
    """
    count = len(travel.along_m)
    clock = np.append(0.0, np.cumsum(travel.pace[1:]) * dt_s)
    axes = CubicSpline(wire.along_m, np.hstack([wire.points_m, side * wire.tangent, tool]))(travel.along_m)
    centre, y, z = axes[:, :3], axes[:, 3:6], axes[:, 6:]
    y = y / np.linalg.norm(y, axis=1, keepdims=True)
    z = z - (z * y).sum(axis=1, keepdims=True) * y
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    square = np.stack([np.cross(y, z), y, z], axis=-1)

    sigma = rng.uniform(*hand.wobble_rad) / np.sqrt(2.0)  # of each of two tilts
    turn = wandering(clock, hand.wobble_s, dt_s, 3, rng) * [sigma, hand.twist_rad, sigma]
    held = lean(y, towards, hand.lean)
    rotation = rotation_between(y, held) @ square @ rotation_from_vector(turn)

    mean, deviation = hand.play
    share = draw_truncated(mean, deviation, (0.3 * mean, 1.7 * mean), rng)
    wanted = share * settings.clearance_m * wandering(clock, hand.play_s, dt_s, 2, rng)
    tremor = _tremor(count, dt_s, hand, rng) * np.minimum(travel.pace / max(hand.resting_pace, 1e-9), 1.0)[:, None]
    wanted = wanted + tremor[:, :2]
    # The normal in the square frame: its components along x and z say where to, and y how much, it is tilted.
    tilted = (np.swapaxes(square, 1, 2) @ rotation[:, :, 1, None])[:, [0, 2], 0]
    cos = np.sqrt(np.maximum(1.0 - (tilted**2).sum(axis=1), 0.0))
    length = np.linalg.norm(wanted, axis=1)
    along = (wanted * tilted).sum(axis=1) / np.maximum(length * np.linalg.norm(tilted, axis=1), 1e-15)
    ellipse = settings.ring_radius_m * cos / np.sqrt(along**2 + cos**2 * (1.0 - along**2))
    limit = ellipse - settings.tube_radius_m - settings.radius_m
    offset = wanted * np.minimum(1.0, limit / np.maximum(length, 1e-15))[:, None]
    position = centre + offset[:, :1] * square[:, :, 0] + offset[:, 1:] * z + tremor[:, 2:] * y
    contact = lasting_contacts(length - limit, dt_s, hand.release_m, hand.shortest_contact_s)
    return RingMotion(rigid_transform(rotation, position), contact, np.linalg.norm(offset, axis=1), limit)


def lean(normal: FloatArray, towards: FloatArray, weight: float) -> FloatArray:
    """Unit vectors ``(n, 3)``, drawn towards another by less than ``weight``, which is below 1, radians or so."""
    drawn = normal + weight * towards
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def rotation_between(start: FloatArray, end: FloatArray) -> FloatArray:
    """``(n, 3, 3)`` the shortest rotations from unit vectors ``(n, 3)`` to others, not their opposites."""
    axis = np.cross(start, end)
    sin = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sin, (start * end).sum(axis=1, keepdims=True))
    return rotation_from_vector(axis * np.divide(angle, sin, out=np.ones_like(sin), where=sin > 0))


def wandering(
    clock_s: FloatArray, time_constant_s: float, dt_s: float, components: int, rng: np.random.Generator
) -> FloatArray:
    """Smooth stationary noise of unit variance: an Ornstein-Uhlenbeck process, filtered by itself once more.

    The rate of change of each component has a standard deviation of one per time constant.

    Args:
        clock_s: ``(T,)`` not decreasing, from 0: when it is looked at.
        time_constant_s: Of both filters.
        dt_s: Step at which it is made.
        components: How many.
        rng: The only source of randomness.

    Returns:
        ``(T, components)``.
    """
    rho = np.exp(-dt_s / time_constant_s)
    lead = int(np.ceil(WARM_UP * time_constant_s / dt_s))
    drive = rng.standard_normal((lead + int(np.ceil(clock_s[-1] / dt_s)) + 2, components))
    drive *= np.sqrt((1.0 - rho**2) ** 3 / (1.0 + rho**2))
    noise = lfilter([1.0], [1.0, -2.0 * rho, rho**2], drive, axis=0)[lead:]
    return np.asarray(CubicSpline(dt_s * np.arange(len(noise)), noise)(clock_s))


def _movements(time_s: float, hand: Hand, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Durations of sub-movements that fill a time, and which share of the way each goes."""
    mean, deviation = hand.movement_s
    durations: list[float] = []
    while sum(durations) < time_s or not durations:
        value = rng.gamma((mean / deviation) ** 2, deviation**2 / mean)
        if hand.movement_range_s[0] <= value <= hand.movement_range_s[1]:
            durations.append(value)
    lengths = np.array(durations)
    lengths *= time_s / lengths.sum()
    peaks = np.maximum(1.0 + hand.peak_spread * rng.standard_normal(len(lengths)), 0.2)
    return lengths, peaks * lengths / (peaks @ lengths)


def _rests(count: int, time_s: float, hand: Hand, rng: np.random.Generator) -> tuple[FloatArray, NDArray[np.bool_]]:
    """How long each of the rests between movements is, and which are with the clutch pressed."""
    clutched = np.zeros(count, dtype=bool)
    rests = np.zeros(count)
    wanted = rng.poisson(max(time_s, 0.0) / max(np.mean(hand.rest_share) * hand.clutch_every_s, 1e-9))
    for place in rng.permutation(count)[:wanted]:
        pause = rng.uniform(*hand.clutch_s)
        # The hand does not only rest when it clutches.
        if rests.sum() + pause <= 0.6 * time_s:
            rests[place] = pause
            clutched[place] = True
    short = rng.exponential(size=count) * ~clutched
    return rests + short * (time_s - rests.sum()) / max(short.sum(), 1e-12), clutched


def _pace(
    time: FloatArray, begins: FloatArray, durations: FloatArray, clutched: NDArray[np.bool_], dt_s: float, hand: Hand
) -> FloatArray:
    after = np.searchsorted(begins, time, side="right")  # the rest or movement that a sample is in or after
    moving = (after > 0) & (time <= (begins + durations)[np.maximum(after - 1, 0)])
    pace = np.where(moving, 1.0, np.where(clutched[after], 0.0, hand.resting_pace))
    width = max(1, round(EASE_S / dt_s))
    kernel = np.hanning(width + 2)[1:-1]
    padded = np.pad(pace, (width // 2, width - 1 - width // 2), mode="edge")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")


def _tremor(count: int, dt_s: float, hand: Hand, rng: np.random.Generator) -> FloatArray:
    """``(count, 3)`` noise within a band; its length has the wanted root mean square."""
    lead = round(1.0 / dt_s)
    white = rng.standard_normal((count + 2 * lead, 3))
    band = sosfiltfilt(butter(2, hand.tremor_hz, "bandpass", fs=1.0 / dt_s, output="sos"), white, axis=0)
    band = band[lead:-lead]
    return np.asarray(band * hand.tremor_m / np.sqrt((band**2).sum(axis=1).mean()))
