"""How masks are coded: decided once over a whole recording, said aloud, and refused where nothing fits.

Nothing is guessed that would matter. What is taken without being told: one value or colour beside 0; all colours beside
black, with a warning; and where edges are smeared (JPEG, video, 16-bit probabilities), but nearly all pixels are at one
end of the range or the other, what is in its upper half, with a warning. All else is refused with the option that tells
it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import ConfigError, DatasetError
from surgbench.recordings.labels import (
    COLOUR,
    brightest,
    colourfulness,
    pixel_codes,
    write_code,
    write_codes,
    write_instances,
)
from surgbench.recordings.survey import Channel, MaskSource, Survey, Tally, coded_plane

Mask = NDArray[np.bool_]
# More different values than these are no labels, but degrees.
MOST_LABELS = 16
# Smeared masks reach this share of the full range, and have fewer pixels between a quarter and three quarters of it
# than above.
REACHED = 0.9
# More of the pixels than this are no instrument, as a rule, but what is around it.
MOST_INSTRUMENT = 0.5
# Smeared grey pixels get a little colour, of the full range at most this share.
NEARLY_GREY = 0.15
WHOLE = ""


@dataclass(frozen=True)
class Told:
    """What is told of a recording's masks; see ``docs/recordings.md``.

    Attributes:
        label: Codes that are instrument.
        instances: Arm to its codes.
        ignore: Codes that are neither instrument nor to be wondered at.
        threshold: Pixels of at least this value are instrument.
        invert: Instrument is what would be taken for its surroundings.
        channel: Where masks are coded.
        several: Several objects in one mask are as it should be.
    """

    label: frozenset[int] = frozenset()
    instances: Mapping[str, frozenset[int]] | None = None
    ignore: frozenset[int] = frozenset()
    threshold: int | None = None
    invert: bool = False
    channel: Channel = "auto"
    several: bool = False

    def check(self) -> None:
        """See that no two of these contradict each other.

        Raises:
            ConfigError: They do.
        """
        ways = {
            "--label": bool(self.label), "--instances": bool(self.instances), "--threshold": self.threshold is not None,
        }  # fmt: skip
        given = [option for option, is_given in ways.items() if is_given]
        if len(given) > 1:
            raise ConfigError(f"{given[0]} and {given[1]} cannot both tell what is instrument")
        if self.invert and given and given[0] != "--threshold":
            raise ConfigError(f"--invert says nothing beside {given[0]}, which names what is instrument")
        named = self.label.union(*(self.instances or {}).values())
        if named & self.ignore:
            raise ConfigError(f"{given[0]} and --ignore both name {write_codes(named & self.ignore)}")


@dataclass(frozen=True)
class Coding:
    """What a pixel of a recording's masks means.

    Attributes:
        channel: Where masks are coded.
        groups: What each part of the instruments consists of: arm to codes, or :data:`WHOLE`.
        threshold: Pixels of at least this value are instrument; then ``groups`` names no codes.
        inverted: Those below it are.
        ignored: Codes that are not, whatever the threshold.
        said: Values, and which of them are instrument, a few words.
        warnings: One line each.
    """

    channel: Literal["colour", "alpha"]
    groups: Mapping[str, frozenset[int]]
    threshold: int | None = None
    inverted: bool = False
    ignored: frozenset[int] = frozenset()
    said: str = ""
    warnings: tuple[str, ...] = ()

    def masks(self, picture: NDArray[Any]) -> dict[str, Mask]:
        """Masks that a decoded picture of the recording shows, ``(height, width)`` bool, for each of ``groups``."""
        plane = coded_plane(picture, self.channel)
        if self.threshold is None:
            codes = pixel_codes(plane)
            return {name: _among(codes, own) for name, own in self.groups.items()}
        light = plane.max(axis=2) if plane.ndim == 3 else plane
        mask = (light >= self.threshold) != self.inverted
        if self.ignored:
            mask &= ~_among(pixel_codes(plane), self.ignored)
        return dict.fromkeys(self.groups, mask)


def read_coding(source: MaskSource, told: Told, progress: Callable[[float], None] = lambda masks: None) -> Coding:
    """Look at all masks of a recording, and decide how they are coded.

    Args:
        source: The masks.
        told: What is known of them.
        progress: Takes a number of masks just looked at.

    Raises:
        ConfigError: What is told contradicts itself or the masks, or more must be told; one line that names the option.
        DatasetError: A mask is damaged, of another size, or none shows an instrument; one line.
    """
    told.check()
    survey = Survey(source, told.channel, progress)
    return _Decision(source, told, survey).coding()


class _Decision:
    """From what is told and what was seen to what is meant."""

    def __init__(self, source: MaskSource, told: Told, survey: Survey) -> None:
        self._source, self._told, self._survey = source, told, survey
        self._tally: Tally = survey.tally
        self._codes = sorted(set(self._tally.pixels) - told.ignore)
        self._values = f"values {{{write_codes(self._tally.pixels)}}}"
        if len(self._tally.pixels) > MOST_LABELS:
            self._values += f" ({len(self._tally.pixels)} different)"

    def coding(self) -> Coding:
        told = self._told
        self._check_present(told.ignore, "--ignore")
        if told.label:
            self._check_present(told.label, "--label")
            return self._labels({WHOLE: told.label}, f"{write_codes(told.label)} is instrument")
        if told.instances:
            self._check_present(frozenset().union(*told.instances.values()), "--instances")
            return self._labels(told.instances, write_instances(told.instances))
        if told.threshold is not None:
            return self._above(told.threshold, ())
        if len(self._codes) < 2:
            only = f"every pixel is {write_code(self._codes[0])}" if self._codes else "every pixel is ignored"
            raise DatasetError(
                f"{self._source.place}: no instrument in any of {len(self._source.numbers)} masks: {only} "
                f"({self._values})"
            )
        if self._source.several is not None and not told.several:
            raise ConfigError(
                f"{self._source.place}: {self._source.several}; one instrument in pieces is told with --label "
                f"{write_codes((code for code in self._codes if code), ',')}, two instruments with --arms both"
            )
        coding = self._two() if len(self._codes) == 2 and self._codes[0] == 0 else self._many()
        share = self._share(coding)
        if share > MOST_INSTRUMENT and not told.invert:
            raise ConfigError(
                f"{self._source.place}: {100 * share:.1f} % of all pixels would be instrument ({self._values}); "
                f"where it is the dark part, --invert; where this is right, {self._as_told(coding)}"
            )
        return coding

    def _two(self) -> Coding:
        """Nothing, and one value or colour beside it."""
        chosen = self._codes[0] if self._told.invert else self._codes[1]
        # Of 0 and 1, or 0 and 255, the other is nothing that anybody wonders about.
        plain = chosen in (1, self._tally.full)
        return self._labels({WHOLE: frozenset((chosen,))}, "" if plain else f"{write_code(chosen)} is instrument")

    def _many(self) -> Coding:
        tinge = NEARLY_GREY * self._tally.full if self._source.lossy is not None else 0
        colours = [code for code in self._codes if code >= COLOUR and colourfulness(code) > tinge]
        degrees = len(self._codes) > MOST_LABELS or self._source.lossy is not None
        if degrees and not colours and self._tally.depths == 1 and self._is_smeared():
            half = (self._tally.full + 1) // 2
            cause = "" if self._source.lossy is None else f", as {self._source.lossy} smears edges"
            side = "below" if self._told.invert else "of at least"
            warning = (
                f"{self._source.place}: {self._values}{cause}: pixels {side} {half} are taken for instrument "
                "(--threshold says otherwise)"
            )
            return self._above(half, (warning,))
        if degrees:
            raise ConfigError(
                f"{self._source.place}: {self._values} are neither labels nor nearly black and white; --threshold "
                f"{(self._tally.full + 1) // 2} takes pixels of at least that value for instrument, --label "
                f"{write_code(max(self._codes, key=self._weight))} those of one (pictures "
                "of a camera have to be segmented first)"
            )
        if colours and self._codes[0] == 0 and not self._told.invert:
            chosen = frozenset(self._codes[1:])
            warning = (
                f"{self._source.place}: all colours but black are taken for parts of one instrument; --label or "
                f"--instances {self._two_arms()} says otherwise"
            )
            return self._labels({WHOLE: chosen}, "all but 0 is instrument", (warning,))
        raise ConfigError(
            f"{self._source.place}: {self._values}: which are instrument? {self._rare()}--label "
            f"{write_codes(self._foreground(), ',')} for parts of one instrument, --instances {self._two_arms()} "
            "for two arms, --ignore for what is neither"
        )

    def _labels(self, groups: Mapping[str, frozenset[int]], said: str, warnings: tuple[str, ...] = ()) -> Coding:
        words = f"{self._values}, {said}" if said else self._values
        ignored = self._told.ignore
        return Coding(self._survey.channel, groups, None, False, ignored, self._where(words), warnings)

    def _above(self, threshold: int, warnings: tuple[str, ...]) -> Coding:
        words = f"{self._values}, {'below' if self._told.invert else 'at least'} {threshold} is instrument"
        coding = Coding(
            self._survey.channel, {WHOLE: frozenset()}, threshold, self._told.invert, self._told.ignore,
            self._where(words), warnings,
        )  # fmt: skip
        if self._share(coding) == 0.0:
            largest = max(map(brightest, self._tally.pixels))
            raise ConfigError(
                f"--threshold {threshold}: no pixel of the masks in {self._source.place} would be instrument (their "
                f"largest value is {largest})"
            )
        return coding

    def _where(self, words: str) -> str:
        return f"{words} (transparency)" if self._survey.channel == "alpha" else words

    def _is_smeared(self) -> bool:
        """Whether nearly all pixels are at one end of the range or the other."""
        full = self._tally.full
        levels = [(brightest(code), n) for code, n in self._tally.pixels.items()]
        between = sum(n for level, n in levels if full / 4 <= level < 3 * full / 4)
        above = sum(n for level, n in levels if level >= 3 * full / 4)
        return max(level for level, _ in levels) >= REACHED * full and between < min(above, self._tally.total - above)

    def _share(self, coding: Coding) -> float:
        """Of all pixels of the recording that are instrument."""
        if coding.threshold is None:
            chosen = frozenset().union(*coding.groups.values())
        else:
            codes = [code for code in self._tally.pixels if code not in coding.ignored]
            chosen = frozenset(c for c in codes if (brightest(c) >= coding.threshold) != coding.inverted)
        return sum(self._tally.pixels.get(code, 0) for code in chosen) / self._tally.total

    def _as_told(self, coding: Coding) -> str:
        """The option that says what was decided."""
        if coding.threshold is not None:
            return f"--threshold {coding.threshold}"
        return f"--label {write_codes(frozenset().union(*coding.groups.values()), ',')}"

    def _check_present(self, codes: frozenset[int], option: str) -> None:
        missing = codes - set(self._tally.pixels) if self._tally.complete else frozenset()
        if missing:
            raise ConfigError(
                f"{option}: {write_codes(missing)} is in none of the masks in {self._source.place} ({self._values})"
            )

    def _weight(self, code: int) -> int:
        return self._tally.pixels[code] if code else 0

    def _foreground(self) -> list[int]:
        """All but what surrounds the instrument: 0, or else what most pixels are."""
        around = 0 if 0 in self._codes else max(self._codes, key=lambda code: self._tally.pixels[code])
        return [code for code in self._codes if code != around]

    def _two_arms(self) -> str:
        largest = sorted(sorted(self._foreground(), key=self._weight)[-2:])
        if len(largest) < 2:
            return "1=left,2=right"
        return f"{write_code(largest[0])}=left,{write_code(largest[1])}=right"

    def _rare(self) -> str:
        """Which value is in few masks, as by a slip of whoever drew them; and how to do without it."""
        rarest = min(self._foreground(), key=self._weight)
        pixels, masks = self._tally.pixels[rarest], self._tally.frames[rarest]
        if masks > max(1, len(self._source.numbers) // 4):
            return ""
        where = f"{masks} masks" if masks > 1 else f"the mask of frame {self._tally.first[rarest]}"
        others = [code for code in self._foreground() if code != rarest]
        without = f"; without: --label {write_codes(others, ',')}" if others else ""
        return f"({write_code(rarest)} are {pixels} pixels in {where}{without}) "


def _among(codes: NDArray[Any], wanted: Iterable[int]) -> Mask:
    found: Mask = np.zeros(codes.shape, dtype=bool)
    for code in wanted:
        found |= codes == code
    return found
