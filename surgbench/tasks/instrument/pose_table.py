"""Poses and joints of instruments as a table that any program can write: a row per arm and frame.

Columns have their unit in their name. Of a pose there is the place of the wrist-pitch frame's origin (``x_m`` or
``x_mm``, ...) and its rotation, in one of four forms: a quaternion, a rotation vector, a matrix row by row, or the
look-at angles of the state; of the joints ``q1``, ``q2`` and ``q3``, or for the last the whole angle between the jaws.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from surgbench.errors import DatasetError
from surgbench.geometry import FloatArray, look_at_angles, look_at_rotation, rotation_angle, rotation_from_vector
from surgbench.tasks.instrument.tables import STATE_COLUMNS

PLACE, QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")
LOOK_AT, VECTOR = ("alpha", "beta", "gamma"), ("rx", "ry", "rz")
MATRIX = tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3))
LENGTHS, ANGLES = {"m": 1.0, "mm": 1e-3}, {"rad": 1.0, "deg": np.pi / 180.0}
DEVIATION_COLUMNS = tuple(f"sd_{name}" for name in STATE_COLUMNS)
TIP_COLUMNS = tuple(f"tip{tip}_{axis}_m" for tip in (1, 2) for axis in "xyz")
# What is written, besides what says which arm and frame it is.
POSE_COLUMNS = (
    *(f"{name}_m" for name in PLACE), *QUATERNION, *(f"{name}_rad" for name in LOOK_AT), "q1_rad", "q2_rad", "q3_rad",
)  # fmt: skip

# A quaternion's length and a matrix may be rounded by so much; more is another thing.
ROUNDING = 1e-3
# Two forms of one rotation agree to this, rad.
AGREEMENT_RAD = 1e-4
# An instrument further away, or a joint turned further, is told in another unit.
FARTHEST_M, MOST_RAD = 2.0, np.pi
# All of them nearer than that is within the lens: metres that are called millimetres.
NEAREST_M = 2e-3
# Look-at angles and rotation vectors may have gone round a few times, but not as far as degrees go.
MOST_TURNS_RAD = 4.0 * np.pi


def quaternions(rotation: FloatArray) -> FloatArray:
    """``(..., 4)`` w, x, y, z of ``(..., 3, 3)`` rotation matrices, w not negative."""
    flat = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(canonical=True, scalar_first=True)
    return np.asarray(flat, dtype=np.float64).reshape(*rotation.shape[:-2], 4)


def pose_columns(states: FloatArray) -> FloatArray:
    """``(T, 9)`` states as ``POSE_COLUMNS``, ``(T, 13)``."""
    rotation = quaternions(look_at_rotation(states[:, :3]))
    return np.concatenate([states[:, 3:6], rotation, states[:, :3], states[:, 6:]], axis=1)


class PoseTable:
    """Named columns of numbers, looked up by what they mean.

    Args:
        name: Of the file, for messages.
        columns: Their names, as they stand in its header.
        values: ``(rows, columns)``; NaN where a cell is empty.
        lines: ``(rows,)`` line of each row in the file.
    """

    def __init__(self, name: str, columns: Sequence[str], values: FloatArray, lines: Sequence[int]) -> None:
        self.name, self._lines, self._values = name, lines, values
        self._places = {column: place for place, column in enumerate(columns)}

    def states(self) -> FloatArray:
        """``(rows, 9)`` states.

        Raises:
            DatasetError: A column or number is missing, or means something else than its name says; one line that says
                what would be right.
        """
        place = np.stack([self._measured(name, LENGTHS) for name in PLACE], axis=1)
        self._refuse_by(
            np.abs(place).max(axis=1),
            FARTHEST_M,
            "is {:g} m away; for millimetres name the columns 'x_mm', 'y_mm', 'z_mm'",
        )
        return np.concatenate([self._angles(), place, self._joints()], axis=1)

    def check_place(self, place: FloatArray) -> None:
        """See that a camera could have seen some of the estimates; single ones may have gone astray.

        Args:
            place: ``(rows, 3)`` of the wrist, m; at least one.

        Raises:
            DatasetError: It could not; one line that says what would be right.
        """
        if (place[:, 2] < 0).all():
            raise DatasetError(
                f"{self.name}: every wrist is behind the camera (z below 0); its frame is OpenCV's, z forward and y "
                "down (of OpenGL's, turn y and z and the rotation by half a turn about x)"
            )
        farthest = float(np.linalg.norm(place, axis=1).max())
        if farthest < NEAREST_M:
            raise DatasetError(
                f"{self.name}: no wrist is further than {1e3 * farthest:.3g} mm from the camera; for metres name the "
                "columns 'x_m', 'y_m', 'z_m'"
            )

    def column(self, name: str) -> FloatArray | None:
        """``(rows,)`` of a column; ``None`` where it is not there."""
        return self._values[:, self._places[name]] if name in self._places else None

    def numbers(self, name: str) -> FloatArray:
        """``(rows,)`` of a column that must have a number in every row.

        Raises:
            DatasetError: It is not there, or has not.
        """
        values = self.column(name)
        if values is None:
            raise DatasetError(f"{self.name}: has no column '{name}'")
        self._refuse(
            ~np.isfinite(values),
            lambda row: f"'{name}' must be a number (a frame without an estimate repeats the last one, with lost 1)",
        )
        return values

    def _measured(self, name: str, units: dict[str, float]) -> FloatArray:
        """A column whose name ends in one of some units, in SI."""
        found = [unit for unit in units if f"{name}_{unit}" in self._places]
        names = " or ".join(f"'{name}_{unit}'" for unit in units)
        if len(found) != 1:
            problem = "has no column" if not found else "must have one column only of"
            unnamed = f" (not '{name}': the name says the unit)" if not found and name in self._places else ""
            raise DatasetError(f"{self.name}: {problem} {names}{unnamed}")
        return units[found[0]] * self.numbers(f"{name}_{found[0]}")

    def _angles(self) -> FloatArray:
        """``(rows, 3)`` look-at angles. Given beside another form they are taken as they are, to the last bit."""
        forms: list[FloatArray] = []
        look_at = None
        if self._has(LOOK_AT, ANGLES):
            look_at = self._turned(LOOK_AT)
            forms.append(look_at_rotation(look_at))
        if self._has(QUATERNION):
            forms.append(self._from_quaternion())
        if self._has(VECTOR, ANGLES):
            forms.append(rotation_from_vector(self._turned(VECTOR)))
        if self._has(MATRIX):
            forms.append(self._from_matrix())
        if not forms:
            raise DatasetError(
                f"{self.name}: has no rotation; give qw, qx, qy, qz (quaternion), rx_rad, ry_rad, rz_rad (rotation "
                "vector), r11, r12, ... r33 (matrix), or alpha_rad, beta_rad, gamma_rad"
            )
        for other in forms[1:]:
            self._refuse_by(
                rotation_angle(np.swapaxes(forms[0], -1, -2) @ other),
                AGREEMENT_RAD,
                "its rotations differ by {:.3g} rad; give one form, or the same",
            )
        return look_at_angles(forms[0]) if look_at is None else look_at

    def _has(self, names: Sequence[str], units: Sequence[str] | dict[str, float] = ()) -> bool:
        """Whether any of a form's columns is there."""
        return any(column in self._places for name in names for column in (name, *(f"{name}_{u}" for u in units)))

    def _turned(self, names: Sequence[str]) -> FloatArray:
        angles = np.stack([self._measured(name, ANGLES) for name in names], axis=1)
        degrees = ", ".join(f"{name}_deg" for name in names)
        self._refuse_by(
            np.abs(angles).max(axis=1),
            MOST_TURNS_RAD,
            f"an angle is {{:g}} rad; for degrees name the columns {degrees}",
        )
        return angles

    def _from_quaternion(self) -> FloatArray:
        values = np.stack([self.numbers(name) for name in QUATERNION], axis=1)
        length = np.linalg.norm(values, axis=1)
        self._refuse(
            np.abs(length - 1.0) > ROUNDING,
            lambda row: f"the quaternion qw, qx, qy, qz has the length {length[row]:.4g}; must be 1",
        )
        return np.asarray(Rotation.from_quat(values, scalar_first=True).as_matrix(), dtype=np.float64)

    def _from_matrix(self) -> FloatArray:
        values = np.stack([self.numbers(name) for name in MATRIX], axis=1).reshape(-1, 3, 3)
        off = np.abs(values @ np.swapaxes(values, 1, 2) - np.eye(3)).max(axis=(1, 2))
        self._refuse(
            (off > ROUNDING) | (np.linalg.det(values) < 0), lambda row: "r11, r12, ... r33 is no rotation matrix"
        )
        return np.asarray(Rotation.from_matrix(values).as_matrix(), dtype=np.float64)

    def _joints(self) -> FloatArray:
        """``(rows, 3)``, the last from the whole angle of the jaws where that is given."""
        whole = self._has(("jaw",), ANGLES)
        if whole and self._has(("q3",), ANGLES):
            raise DatasetError(f"{self.name}: has both 'q3' (of each jaw) and 'jaw' (the whole angle); give one")
        columns = []
        for name in ("q1", "q2", "jaw" if whole else "q3"):
            values = self._measured(name, ANGLES)
            self._refuse_by(
                np.abs(values), MOST_RAD, f"'{name}' is {{:g}} rad; for degrees name the column '{name}_deg'"
            )
            columns.append(0.5 * values if name == "jaw" else values)
        return np.stack(columns, axis=1)

    def _refuse_by(self, values: FloatArray, most: float, problem: str) -> None:
        """Refuse rows whose value is larger than the most there can be; the text has a place for it."""
        self._refuse(values > most, lambda row: problem.format(values[row]))

    def _refuse(self, wrong: NDArray[np.bool_], problem: Callable[[int], str]) -> None:
        if wrong.any():
            row = int(np.argmax(wrong))
            raise DatasetError(f"{self.name}: line {self._lines[row]}: {problem(row)}")
