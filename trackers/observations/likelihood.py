"""How well projected features explain detected ones (the observation models of Richter et al.)."""

from __future__ import annotations

import numpy as np

from surgbench.geometry import FloatArray


def association_likelihood(costs: FloatArray, threshold: float) -> FloatArray:
    """Likelihood of each particle, up to a factor, from the costs of pairing its features with the detected ones.

    The sum of ``exp(-C)`` over the pairs of the cheapest association; a feature without a partner, or with one that
    costs more than the threshold, adds ``exp(-threshold)``.

    Args:
        costs: ``(particles, 2, detected)`` with 0, 1 or 2 detected features; NaN where a feature cannot be seen.
        threshold: Cost beyond which a pair is none.

    Returns:
        ``(particles,)`` in (0, 2].
    """
    missed = np.exp(-threshold)
    # A pair that costs more than the threshold counts as much as no pair, and must not steer the other's choice.
    capped = np.where(costs < threshold, costs, threshold)
    if costs.shape[2] == 0:
        return np.full(len(costs), 2 * missed)
    if costs.shape[2] == 1:
        return np.asarray(np.exp(-capped[:, :, 0].min(axis=1)) + missed)
    straight = np.stack([capped[:, 0, 0], capped[:, 1, 1]], axis=1)
    swapped = np.stack([capped[:, 0, 1], capped[:, 1, 0]], axis=1)
    cheaper = (straight.sum(axis=1) <= swapped.sum(axis=1))[:, None]
    return np.asarray(np.exp(-np.where(cheaper, straight, swapped)).sum(axis=1))


def point_costs(projected_px: FloatArray, detected_px: FloatArray, rate: float) -> FloatArray:
    """Costs ``rate * distance`` of points.

    Args:
        projected_px: ``(particles, 2, 2)``; NaN for points behind the camera.
        detected_px: ``(detected, 2)``.
        rate: gamma, per pixel.

    Returns:
        ``(particles, 2, detected)``.
    """
    difference = projected_px[:, :, None] - detected_px
    return np.asarray(rate * np.hypot(difference[..., 0], difference[..., 1]))


def identified_likelihood(
    projected_px: FloatArray, detected_px: FloatArray, rate: float, threshold: float
) -> FloatArray:
    """Likelihood of each particle, up to a factor, from points of which it is known which is which.

    The sum of ``exp(-rate * distance)``; a point that would cost more than the threshold adds ``exp(-threshold)``.

    Args:
        projected_px: ``(particles, n, 2)``; NaN for points behind the camera.
        detected_px: ``(n, 2)``.
        rate: gamma, per pixel.
        threshold: Cost beyond which a pair is none.

    Returns:
        ``(particles,)`` in (0, n].
    """
    difference = projected_px - detected_px
    costs = rate * np.hypot(difference[..., 0], difference[..., 1])
    return np.asarray(np.exp(-np.where(costs < threshold, costs, threshold)).sum(axis=1))


def line_costs(projected: FloatArray, detected: FloatArray, rho_rate: float, theta_rate: float) -> FloatArray:
    """Costs ``rho_rate |d rho| + theta_rate |d theta|`` of lines ``n . (u, v) = rho`` with ``n = (cos, sin)(theta)``.

    ``(n, rho)`` and ``(-n, -rho)`` are the same line: the nearer of the two is compared, so that nothing jumps where
    rho changes sign or theta wraps.

    Args:
        projected: ``(particles, 2, 3)``: n and rho; NaN for edges that cannot be seen.
        detected: ``(detected, 3)``.
        rho_rate: Per pixel.
        theta_rate: Per radian.

    Returns:
        ``(particles, 2, detected)``.
    """
    p, d = projected[:, :, None], detected
    along = p[..., 0] * d[:, 0] + p[..., 1] * d[:, 1]
    across = p[..., 0] * d[:, 1] - p[..., 1] * d[:, 0]
    rho = np.abs(np.where(along < 0, -1.0, 1.0) * p[..., 2] - d[:, 2])
    theta = np.arctan2(np.abs(across), np.abs(along))
    return np.asarray(rho_rate * rho + theta_rate * theta)
