"""The strip below a film: errors over time, rules that were active and broken, and a cursor."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from surgbench.report.drawing import INK, Colour, Picture, strip, text_size, write_text
from surgbench.tasks.viewpoint.film.shot import ERRORS, Shot
from surgbench.tasks.viewpoint.rule_flags import RULE_NAMES, spans
from surgbench.viewpoint.placement import CONSTRAINTS

# In the order of the article's rules: red, green, blue, orange, cyan.
RULE_COLOURS: tuple[Colour, ...] = ((214, 39, 40), (44, 160, 44), (31, 119, 180), (255, 158, 27), (23, 160, 180))
BROKEN: Colour = (190, 0, 40)
GREY: Colour = (150, 155, 162)
PALE: Colour = (238, 240, 243)
LINE: Colour = (205, 209, 215)
CURVE_PX, BAR_PX, GAP_PX, TEXT_PX = 62, 9, 5, 10
LEFT_PX, RIGHT_PX, BOTTOM_PX = 108, 96, 22
# The scale holds all but this share of the values: those go through the roof.
ABOVE_SHARE = 0.005
NICE = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.5, 10.0)


class Strip:
    """Drawn once; then a cursor and values are laid over copies of it.

    Args:
        shots: Of one trial.
        width: Pixels.
        dt_s: Seconds between steps.
    """

    def __init__(self, shots: Sequence[Shot], width: int, dt_s: float) -> None:
        self._shots, self._dt_s, self._width = tuple(shots), dt_s, width
        self._steps = max(shot.steps for shot in shots)
        self._rows = _rows(shots)
        height = len(ERRORS) * (CURVE_PX + GAP_PX) + len(self._rows) * (BAR_PX + 3) + BOTTOM_PX + GAP_PX
        self._still = strip(width, height)
        self._tops: list[float] = []
        for number, (name, label, unit) in enumerate(ERRORS):
            self._curves(number, name, f"{label} [{unit}]")
        self._bars()
        self._explain()
        self._axis()

    @property
    def height(self) -> int:
        """Pixels."""
        return int(self._still.shape[0])

    def mark(self, steps: Sequence[int]) -> Picture:
        """With a line at each of some steps."""
        picture = self._still.copy()
        for step in steps:
            column = round(float(self._column(step)))
            cv2.line(picture, (column, GAP_PX), (column, self.height - BOTTOM_PX), INK, 1, cv2.LINE_AA)
        return picture

    def draw(self, step: int) -> Picture:
        """With the cursor at a step, and the values there."""
        picture = self.mark([step])
        for number, (name, _, _) in enumerate(ERRORS):
            top = GAP_PX + number * (CURVE_PX + GAP_PX)
            for place, shot in enumerate(self._shots):
                if step >= shot.steps:
                    continue
                value = shot.errors[name][step]
                text = "-" if np.isnan(value) else f"{value:.2f}"
                bottom = top + 13 + 15 * place
                if bottom < top + CURVE_PX + 8:
                    write_text(picture, text, self._width - RIGHT_PX + 10, bottom, TEXT_PX, shot.colour)
        return picture

    def _column(self, step: NDArray[np.int_] | int) -> NDArray[np.float64]:
        room = self._width - LEFT_PX - RIGHT_PX
        return np.asarray(LEFT_PX + room * np.asarray(step) / max(self._steps - 1, 1), dtype=np.float64)

    def _curves(self, number: int, name: str, label: str) -> None:
        picture, top = self._still, GAP_PX + number * (CURVE_PX + GAP_PX)
        values = np.concatenate([shot.errors[name] for shot in self._shots])
        values = values[np.isfinite(values)]
        most = _nice(float(np.quantile(values, 1.0 - ABOVE_SHARE)) if len(values) else 1.0)
        right = self._width - RIGHT_PX
        cv2.rectangle(picture, (LEFT_PX, top), (right, top + CURVE_PX), PALE, cv2.FILLED)
        cv2.line(picture, (LEFT_PX, top + CURVE_PX // 2), (right, top + CURVE_PX // 2), LINE, 1)
        cv2.rectangle(picture, (LEFT_PX, top), (right, top + CURVE_PX), LINE, 1)
        write_text(picture, label, 8, top + CURVE_PX // 2 + 5, TEXT_PX)
        for text, bottom in ((f"{most:g}", top + 10), ("0", top + CURVE_PX)):
            write_text(picture, text, LEFT_PX - 6 - text_size(text, 8)[0], bottom, 8, GREY)
        for shot in self._shots:
            error = shot.errors[name]
            height = CURVE_PX * (1.0 - np.minimum(error / most, 1.0))
            points = np.stack([self._column(np.arange(len(error))), top + height], axis=1)
            for piece in _pieces(points):
                cv2.polylines(picture, [np.rint(16 * piece).astype(np.int32)], False, shot.colour, 1, cv2.LINE_AA, 4)

    def _bars(self) -> None:
        top = GAP_PX + len(ERRORS) * (CURVE_PX + GAP_PX)
        for number, (label, colour, layers) in enumerate(self._rows):
            upper = top + number * (BAR_PX + 3)
            cv2.rectangle(self._still, (LEFT_PX, upper), (self._width - RIGHT_PX, upper + BAR_PX), PALE, cv2.FILLED)
            write_text(self._still, label, 8, upper + BAR_PX, 8, colour)
            for flags, shade in layers:
                for begin, end in spans(flags):
                    ends = self._column(np.array([begin, end]))
                    left, right = (round(float(value)) for value in ends)
                    corners = (left, upper), (max(right, left + 1), upper + BAR_PX)
                    cv2.rectangle(self._still, *corners, shade, cv2.FILLED)

    def _explain(self) -> None:
        """What the bars are of, beside them."""
        pale = "pale: active" if self._shots[0].rules.told else "pale: against"
        lines = [pale, "for it" if self._shots[0].rules.told else "naive pose", "red: broken"]
        if len(self._shots) > 1:
            lines = ["grey: naive pose", "not allowed", "red: broken"]
        top = GAP_PX + len(ERRORS) * (CURVE_PX + GAP_PX)
        for number, text in enumerate(lines):
            colour = BROKEN if text.startswith("red") else GREY
            write_text(self._still, text, self._width - RIGHT_PX + 8, top + 9 + 13 * number, 8, colour)

    def _axis(self) -> None:
        seconds = self._steps * self._dt_s
        every = next((step for step in (0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300) if seconds / step <= 16), 600)
        bottom = self.height - BOTTOM_PX
        for time_s in np.arange(0.0, seconds, every):
            column = round(float(self._column(round(time_s / self._dt_s))))
            cv2.line(self._still, (column, bottom), (column, bottom + 4), GREY, 1)
            text = f"{time_s:g} s"
            write_text(self._still, text, column - text_size(text, 8)[0] // 2, bottom + 16, 8, GREY)


Row = tuple[str, Colour, list[tuple[NDArray[np.bool_], Colour]]]


def _rows(shots: Sequence[Shot]) -> list[Row]:
    """Label, its colour, and what is laid into each row of bars."""
    rows: list[Row] = []
    if len(shots) == 1:
        shot = shots[0]
        flags = shot.rules.active if shot.rules.told else shot.rules.naive
        for number, name in enumerate(CONSTRAINTS):
            light = _light(RULE_COLOURS[number])
            bars = [(flags[:, number], light), (shot.rules.broken[:, number], BROKEN)]
            rows.append((RULE_NAMES[name], RULE_COLOURS[number], bars))
    else:
        rows.append(("constrained", GREY, [(np.asarray(shots[0].rules.naive.any(axis=1)), GREY)]))
        for shot in shots:
            label = shot.title if len(shot.title) < 14 else shot.title[:13]
            rows.append((label, shot.colour, [(np.asarray(shot.rules.broken.any(axis=1)), BROKEN)]))
    if any(shot.contact.any() for shot in shots):
        rows.append(("touches wire", INK, [(shots[0].contact, (90, 90, 90))]))
    unseen = np.asarray(~shots[0].seen.any(axis=1))
    if len(shots) == 1 and unseen.any():
        rows.append(("ring unseen", INK, [(unseen, INK)]))
    return rows


def _light(colour: Colour) -> Colour:
    red, green, blue = ((value + 2 * 255) // 3 for value in colour)
    return red, green, blue


def _nice(value: float) -> float:
    """The least round number that is not below a value."""
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * next(step for step in (*NICE, 20.0) if step * power >= value))


def _pieces(points: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Parts of a curve between missing values."""
    known = np.asarray(np.isfinite(points).all(axis=1))
    return [points[begin:end] for begin, end in spans(known) if end - begin > 1]
