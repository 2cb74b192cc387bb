"""The simulated operator: what people differ in, and how one of them moves the master by what is seen.

A hand does a handful of known things:

- it corrects what it sees in proportion, some 0.2 s late: the crossover model of manual control (McRuer and Jex 1967),
  ``omega_c`` 2 to 3 rad/s;
- along a way of a width W it goes at W / b: the steering law (Accot and Zhai 1997). W is what is left of the clearance
  on both sides of where the ring seems to be. b is such that a ring a third of the clearance off the wire goes at
  9 mm/s, the median speed of moving samples in AutoCam's developer logs;
- its movements err in proportion to their speed (Harris and Wolpert 1998), and it trembles at 8 to 12 Hz, 0.25 mm at
  the master, which the scale makes 50 um at the tool, as the generator of wire chasers has it;
- it looks ahead by its own delay, and turns the ring's normal along the wire, about the ring and not about the tool;
- where the tool hides the ring it goes by the tool, three times less exactly and at half the speed; where no picture
  has the ring it waits, and feels its way on after a second;
- it presses the clutch where the master has come to the end of its reach, and brings it back.

One constant is fitted, to the endoscope's condition alone and on wires that no table has: how exactly edges are seen
(``noise_px``), so that ring and wire touch for about as large a share of the time as in the article's ENDO (28 %;
``benchmarks/hand_noise.py``). It stands for all that people see depth by. The others were chosen before.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfilt, sosfilt_zi

from surgbench.config import NotNegative, Positive, Section
from surgbench.geometry import FloatArray, rigid_transform
from surgbench.viewpoint.hand.turns import turned

Spread = tuple[Positive, NotNegative]
TREMOR_HZ = (8.0, 12.0)
# Steps of tremor that are made at a time.
_AT_ONCE = 512
# People differ by no more standard deviations than this.
MOST_DEVIATIONS = 2.0


class People(Section):
    """What operators are like: mean and standard deviation over people, or one value for all.

    Attributes:
        delay_s: From the picture to the hand.
        gain_hz: Corrections go at so many times what is seen to be wrong, per second (rad/s of the crossover model).
        steering_s: b of the steering law.
        noise_px: How exactly an edge is located in each of the console's pictures.
        motor_noise: Deviation of a movement, as a share of its speed.
        clutch_s: How long the clutch is pressed.
        one_eye_m: How exactly depth is known where one picture alone shows the ring.
        hidden: So many times less exactly is the ring seen where the tool hides it.
        hidden_pace: Share of the usual speed then.
        widest_rad: Nobody sees the ring turned more wrongly than that (standard deviation).
        seeing_s: Time constant with which errors of seeing change.
        moving_s: Of those of movement.
        tremor_m: Root mean square at the master.
        slowest_m_s: Of the tool along the wire, also where ring and wire seem to touch.
        fastest_m_s: Of the tool.
        turning_rad_s: Fastest turn of the ring.
        tilt_rad: The more the ring seems tilted the slower it goes on, and at this it stands.
        patience_s: Where nothing is seen for so long, it feels its way on.
        reach_m: The master goes no farther than this from its place without the clutch.
        other_view_rad: By how much the picture of a view that the hand is not aligned to is turned wrongly in the mind,
            each of three components.
        other_view_pace: Share of the usual speed while it is looked at.
    """

    delay_s: Spread = (0.20, 0.03)
    gain_hz: Spread = (2.5, 0.4)
    steering_s: Spread = (0.33, 0.06)
    noise_px: Spread = (0.05, 0.01)
    motor_noise: Spread = (0.20, 0.04)
    clutch_s: Spread = (1.0, 0.2)
    one_eye_m: Positive = 0.005
    hidden: Positive = 3.0
    hidden_pace: Positive = 0.5
    widest_rad: Positive = 0.35
    seeing_s: Positive = 0.25
    moving_s: Positive = 0.10
    tremor_m: NotNegative = 0.00025
    slowest_m_s: Positive = 0.002
    fastest_m_s: Positive = 0.020
    turning_rad_s: Positive = 1.5
    tilt_rad: Positive = 0.8
    patience_s: Positive = 1.0
    reach_m: Positive = 0.15
    other_view_rad: NotNegative = 0.25
    other_view_pace: Positive = 0.5

    @property
    def exact(self) -> People:
        """The same without any noise: for tests of where the hand would go."""
        still = {name: (getattr(self, name)[0], 0.0) for name in ("delay_s", "gain_hz", "steering_s", "clutch_s")}
        quiet = {
            "noise_px": (1e-9, 0.0),
            "motor_noise": (1e-12, 0.0),
            "tremor_m": 0.0,
            "other_view_rad": 0.0,
            "widest_rad": 1e-9,
        }
        return self.model_copy(update={**still, **quiet, "one_eye_m": 1e-9})


@dataclass(frozen=True)
class Person:
    """One of them; attributes as of :class:`People`."""

    delay_s: float
    gain_hz: float
    steering_s: float
    noise_px: float
    motor_noise: float
    clutch_s: float
    people: People


def draw_person(people: People, rng: np.random.Generator) -> Person:
    """Someone."""

    def drawn(spread: tuple[float, float]) -> float:
        mean, deviation = spread
        return float(mean + deviation * np.clip(rng.standard_normal(), -MOST_DEVIATIONS, MOST_DEVIATIONS))

    return Person(
        delay_s=drawn(people.delay_s),
        gain_hz=drawn(people.gain_hz),
        steering_s=drawn(people.steering_s),
        noise_px=drawn(people.noise_px),
        motor_noise=drawn(people.motor_noise),
        clutch_s=drawn(people.clutch_s),
        people=people,
    )


@dataclass(frozen=True, eq=False)
class Seen:
    """What the picture shows at one moment, in the axes of the display (x right, y down, z away).

    Attributes:
        to_wire_m: ``(3,)`` from the ring's centre to the wire.
        ahead: ``(3,)`` unit vector: where the wire goes on from the place that will be reached.
        turn_rad: ``(3,)`` rotation vector that would have the ring as it should be.
        lever_m: ``(3,)`` from the tool's origin to the ring's centre.
        pace: Share of the usual speed.
    """

    to_wire_m: FloatArray
    ahead: FloatArray
    turn_rad: FloatArray
    lever_m: FloatArray
    pace: float


class Wandering:
    """Noise of unit variance that changes with a time constant, ``count`` components (Ornstein-Uhlenbeck)."""

    def __init__(self, count: int, time_constant_s: float, dt_s: float, rng: np.random.Generator) -> None:
        self._rng, self._keep = rng, float(np.exp(-dt_s / time_constant_s))
        self._fresh = float(np.sqrt(1.0 - self._keep**2))
        self._value = rng.standard_normal(count)

    def step(self) -> FloatArray:
        """The next one, ``(count,)``."""
        self._value = self._keep * self._value + self._fresh * self._rng.standard_normal(len(self._value))
        return self._value


class Hand:
    """Holds the master.

    Args:
        person: Whose.
        clearance_m: Of ring and wire.
        scale: The tool's way by the master's.
        dt_s: Seconds between steps.
        rng: For movements that err.

    Attributes:
        master: ``(4, 4)`` T_display_master.
        clutch: Whether it is pressed.
        speed_m_s: At which it means the tool to go along the wire.
    """

    def __init__(self, person: Person, clearance_m: float, scale: float, dt_s: float, rng: np.random.Generator) -> None:
        self.master = np.eye(4)
        self.clutch = False
        self.speed_m_s = 0.0
        self._person, self._clearance_m, self._scale, self._dt_s = person, clearance_m, scale, dt_s
        self._delay = max(1, round(person.delay_s / dt_s))
        self._pictures: deque[Seen | None] = deque([None] * self._delay, self._delay)
        self._last: Seen | None = None
        self._unseen_s = 0.0
        self._clutched_s = 0.0
        self._noise = Wandering(6, person.people.moving_s, dt_s, rng)
        self._rng = rng
        self._tremble = _Tremor(person.people.tremor_m, dt_s, rng)

    def step(self, seen: Seen | None) -> None:
        """Move the master by what was seen a delay ago.

        Args:
            seen: What the picture shows now; ``None`` where the ring is not in it.
        """
        before = self._pictures[0]
        self._pictures.append(seen)
        velocity, turning = self._wanted(before)
        noise = self._person.motor_noise * self._noise.step()
        velocity = velocity + math.sqrt(velocity @ velocity) * noise[:3]
        turning = turning + math.sqrt(turning @ turning) * noise[3:]
        tremor_m = self._tremble.step()
        if self._use_clutch():
            return
        moved_m = velocity * (self._dt_s / self._scale) + tremor_m
        rotation = turned(turning * self._dt_s, self.master[:3, :3])
        self.master = rigid_transform(rotation, self.master[:3, 3] + moved_m)

    def _wanted(self, seen: Seen | None) -> tuple[FloatArray, FloatArray]:
        """Velocity (m/s) and turn (rad/s) of the tool that the hand means, in the display's axes."""
        person, people = self._person, self._person.people
        if seen is None:
            self._unseen_s += self._dt_s
            self.speed_m_s = 0.0
            if self._last is None or self._unseen_s < people.patience_s:
                return np.zeros(3), np.zeros(3)
            self.speed_m_s = people.slowest_m_s
            return people.slowest_m_s * self._last.ahead, np.zeros(3)
        self._unseen_s, self._last = 0.0, seen
        ahead = seen.ahead
        sideways = seen.to_wire_m - (seen.to_wire_m @ ahead) * ahead
        width_m = 2.0 * max(self._clearance_m - math.sqrt(sideways @ sideways), 0.0)
        speed = min(max(width_m / person.steering_s, people.slowest_m_s), people.fastest_m_s)
        tilt = math.sqrt(seen.turn_rad @ seen.turn_rad)
        self.speed_m_s = speed * max(1.0 - tilt / people.tilt_rad, 0.0) * seen.pace
        turning = person.gain_hz * seen.turn_rad
        fastest = person.gain_hz * tilt
        if fastest > people.turning_rad_s:
            turning = turning * (people.turning_rad_s / fastest)
        # The tool turns about its own origin: it has to go along for the ring to stay where it is.
        (a, b, c), (x, y, z) = turning.tolist(), seen.lever_m.tolist()
        carried = np.array([b * z - c * y, c * x - a * z, a * y - b * x])
        return person.gain_hz * sideways + self.speed_m_s * ahead - carried, turning

    def _use_clutch(self) -> bool:
        """Bring the master back with the clutch pressed, where it has come too far; whether that was this step."""
        people, place = self._person.people, self.master[:3, 3]
        if not self.clutch and place @ place > people.reach_m**2:
            self.clutch, self._clutched_s = True, 0.0
            self._home_m_s = -place / self._person.clutch_s
        if not self.clutch:
            return False
        self._clutched_s += self._dt_s
        if self._clutched_s > self._person.clutch_s:
            self.clutch = False
            return False
        self.master = rigid_transform(self.master[:3, :3], place + self._home_m_s * self._dt_s)
        return True


class _Tremor:
    """Increments of a displacement within a band of frequencies, three components; its length has the given rms."""

    def __init__(self, rms_m: float, dt_s: float, rng: np.random.Generator) -> None:
        self._filter = butter(2, TREMOR_HZ, "bandpass", fs=1.0 / dt_s, output="sos")
        self._state = np.repeat(sosfilt_zi(self._filter)[:, :, None], 3, axis=2) * 0.0
        # What a filter leaves of white noise: the sum of its impulse response's squares.
        impulse = sosfilt(self._filter, np.append(1.0, np.zeros(round(10.0 / dt_s))))
        self._gain = rms_m / float(np.sqrt(3.0 * (impulse**2).sum()))
        self._rng, self._last, self._ahead = rng, np.zeros(3), np.empty((0, 3))

    def step(self) -> FloatArray:
        """How much farther it is than at the last step, ``(3,)`` metres."""
        if not len(self._ahead):
            white = self._rng.standard_normal((_AT_ONCE, 3))
            out, self._state = sosfilt(self._filter, white, axis=0, zi=self._state)
            places = np.concatenate([self._last[None], self._gain * out])
            self._ahead, self._last = np.diff(places, axis=0), places[-1]
        moved, self._ahead = self._ahead[0], self._ahead[1:]
        return np.asarray(moved)
