"""What pixels of masks say, as numbers, and how they are written on the command line.

A grey pixel is its value; one of colour is written ``red/green/blue``, as in ``--label 64/0/0``. A grey pixel of a
colour picture is the same as that of a grey one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgbench.errors import ConfigError

COLOUR = 1 << 48
_BITS = 16
_PART = re.compile(r"(\d{1,5})(?:/(\d{1,5})/(\d{1,5}))?")
_LARGEST = (1 << _BITS) - 1
# As many are named in a message.
_SHOWN = 8


def colour_code(red: int, green: int, blue: int) -> int:
    """The number that stands for a colour; of a grey one its value."""
    return red if red == green == blue else COLOUR | red << 2 * _BITS | green << _BITS | blue


def brightest(code: int) -> int:
    """The value of a pixel's brightest channel."""
    return code if code < COLOUR else max(code >> shift & _LARGEST for shift in (0, _BITS, 2 * _BITS))


def colourfulness(code: int) -> int:
    """By how much the channels of a pixel differ; 0 of a grey one."""
    parts = [code >> shift & _LARGEST for shift in (0, _BITS, 2 * _BITS)]
    return 0 if code < COLOUR else max(parts) - min(parts)


def pixel_codes(plane: NDArray[Any]) -> NDArray[Any]:
    """``(height, width)`` numbers of pixels, see :func:`colour_code`.

    Args:
        plane: ``(height, width)``, or ``(height, width, 3)`` BGR, uint8 or uint16.
    """
    if plane.ndim == 2:
        return plane
    blue, green, red = (plane[..., k] for k in range(3))
    if np.array_equal(blue, green) and np.array_equal(green, red):
        return red
    wide = plane.astype(np.int64)
    codes = COLOUR | wide[..., 2] << 2 * _BITS | wide[..., 1] << _BITS | wide[..., 0]
    return np.asarray(np.where((blue == green) & (green == red), wide[..., 0], codes))


def write_code(code: int) -> str:
    """A pixel's number as the command line has it.

    Example:
        >>> from surgbench.recordings.labels import colour_code, write_code
        >>> write_code(5), write_code(colour_code(64, 0, 0))
        ('5', '64/0/0')
    """
    if code < COLOUR:
        return str(code)
    return "/".join(str(code >> shift & _LARGEST) for shift in (2 * _BITS, _BITS, 0))


def write_codes(codes: Iterable[int], separator: str = ", ") -> str:
    """Several of them in order, those in the middle left out where there are many."""
    ordered = sorted(codes)
    if len(ordered) <= _SHOWN:
        return separator.join(map(write_code, ordered))
    shown = [*map(write_code, ordered[: _SHOWN - 2]), "...", write_code(ordered[-1])]
    return separator.join(shown)


def parse_codes(text: str | None, option: str) -> frozenset[int]:
    """Values or colours after an option, separated by commas.

    Raises:
        ConfigError: It is something else; one line with an example.
    """
    if text is None:
        return frozenset()
    return frozenset(_parse(part, option) for part in text.split(","))


def parse_instances(text: str | None, option: str, names: Iterable[str]) -> dict[str, frozenset[int]]:
    """What belongs to which arm, as in ``1=left,2=right``.

    Args:
        text: After the option.
        option: For the message.
        names: Of the arms.

    Returns:
        Arm to its codes, in the order of ``names``; empty where nothing is told.

    Raises:
        ConfigError: It is something else, or a value belongs to two arms; one line with an example.
    """
    if text is None:
        return {}
    known = tuple(names)
    found: dict[str, set[int]] = {}
    for part in text.split(","):
        value, equals, arm = part.strip().partition("=")
        if not equals or arm.strip() not in known:
            raise ConfigError(f"{option}: must be like 1=left,2=right or 255/0/0=left,0/0/255=right, not '{text}'")
        found.setdefault(arm.strip(), set()).add(_parse(value, option))
    codes = [code for own in found.values() for code in own]
    for code in codes:
        if codes.count(code) > 1:
            raise ConfigError(f"{option}: {write_code(code)} cannot be of two arms")
    return {arm: frozenset(found[arm]) for arm in known if arm in found}


def write_instances(groups: Mapping[str, frozenset[int]]) -> str:
    """What :func:`parse_instances` reads."""
    return ",".join(f"{write_code(code)}={arm}" for arm, codes in groups.items() for code in sorted(codes))


def _parse(text: str, option: str) -> int:
    match = _PART.fullmatch(text.strip())
    parts = () if match is None else tuple(int(part) for part in match.groups() if part is not None)
    if not parts or max(parts) > _LARGEST:
        raise ConfigError(
            f"{option}: must be values (5 or 1,2) or colours as red/green/blue (64/0/0 or 255/0/0,0/0/255), not "
            f"'{text.strip()}'"
        )
    return parts[0] if len(parts) == 1 else colour_code(*parts)
