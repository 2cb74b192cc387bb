"""Our optimisers step by step against the packages that others know them from: the same samples in, the same out."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from surgbench.geometry import FloatArray
from surgbench.trackers.optimisers.adam import Adam
from surgbench.trackers.optimisers.cma import CMA
from surgbench.trackers.optimisers.cma_settings import (
    joint_settings,
    package_settings,
    released_settings,
    tutorial_settings,
)
from surgbench.trackers.optimisers.xnes import XNES


def ellipsoid(samples: FloatArray) -> FloatArray:
    """Condition number 1000, minimum at 3."""
    return np.asarray(((samples - 3.0) ** 2) @ np.logspace(0, 3, samples.shape[1]))


def slope(samples: FloatArray) -> FloatArray:
    """Linear: the step size grows, and long paths make h_sigma zero."""
    return samples[:, 0].copy()


def package_search(start: FloatArray, sigma: float, population: int, rng: np.random.Generator, **options: Any) -> Any:
    """The package's search; its variances begin a little apart, so that its eigenvectors are defined: not here."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Could not import matplotlib")
        import cma
    search = cma.CMAEvolutionStrategy(
        start,
        sigma,
        {
            "popsize": population,
            "randn": lambda count, size: rng.standard_normal((count, size)),
            "seed": np.nan,
            "verbose": -9,
            "verb_log": 0,
            **options,
        },
    )
    search.sm.C[:], search.sm.B[:], search.sm.D[:] = np.eye(len(start)), np.eye(len(start)), 1.0
    return search


@pytest.mark.slow
@pytest.mark.parametrize("loss", [ellipsoid, slope])
@pytest.mark.parametrize("active", [True, False])
@pytest.mark.parametrize(("size", "population"), [(2, 6), (5, 7), (9, 10), (9, 70), (18, 70)])
def test_cma_is_the_package_cma_step_by_step(loss: Any, active: bool, size: int, population: int) -> None:
    """Its defaults are ours: mean, covariance and step size are the same, generation after generation."""
    rng = np.random.default_rng(size)
    start = rng.normal(size=size)
    theirs = package_search(start, 0.7, population, rng, **({} if active else {"CMA_active": False}))
    settings = None if active else package_settings(size, population, active=False)
    ours = CMA(start, 0.7, population, settings=settings)
    waits = 0
    for _ in range(20):
        asked = theirs.ask()
        samples = np.array(asked)
        losses = loss(samples)
        theirs.tell(asked, losses.tolist())
        ours.tell(samples, losses)
        waits += not theirs.adapt_sigma.hsig(theirs)
        scale = np.abs(theirs.sm.C).max()
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-10, atol=1e-10 * theirs.sigma)
        np.testing.assert_allclose(ours.covariance, theirs.sm.C, rtol=0, atol=1e-10 * scale)
        assert ours.sigma == pytest.approx(theirs.sigma, rel=1e-10)
    if loss is slope and (size, population) == (9, 70):
        assert waits > 0  # or the two definitions of h_sigma would not have been compared


def test_samples_have_the_covariance_that_they_should() -> None:
    """Whatever the root of the covariance is."""
    rng = np.random.default_rng(0)
    for settings in (package_settings(3, 12), tutorial_settings(3, 12)):
        search = CMA(np.zeros(3), 1.0, 12, settings=settings)
        for _ in range(5):
            samples = search.ask(rng.standard_normal((12, 3)))
            search.tell(samples, ellipsoid(samples))
        drawn = search.ask(np.vstack([np.eye(3), -np.eye(3)])) - search.mean
        np.testing.assert_allclose(drawn.T @ drawn / 2, search.sigma**2 * search.covariance, atol=1e-12)


class Released:
    """The released CMA-ES of Hu et al. 2026 (CMAES_cus), written from what is known of it, in plain loops.

    The formulas are the package evotorch's; c_m is 2, c_mu four times its default, the best 15 move the mean.
    """

    def __init__(self, mean: FloatArray, sigma: float, population: int, covariance_rate: float = 4.0) -> None:
        d = self.d = len(mean)
        self.mean, self.sigma = mean.copy(), sigma
        self.C: FloatArray = np.eye(d)
        self.A: FloatArray = np.eye(d)
        self.p_sigma, self.p_c, self.generation = np.zeros(d), np.zeros(d), 0
        raw = [math.log((population + 1) / 2) - math.log(i + 1) for i in range(population)]
        mu = population // 2
        positive, negative = sum(raw[:mu]), sum(raw[mu:])
        self.mu_eff = positive**2 / sum(w**2 for w in raw[:mu])
        bad_eff = negative**2 / sum(w**2 for w in raw[mu:])
        self.c_sigma = (self.mu_eff + 2) / (d + self.mu_eff + 3)
        self.damp = 1 + 2 * max(0.0, math.sqrt((self.mu_eff - 1) / (d + 1)) - 1) + self.c_sigma
        self.c_c = (4 + self.mu_eff / d) / (d + 4 + 2 * self.mu_eff / d)
        self.c_1 = 2 / ((d + 1.3) ** 2 + self.mu_eff)
        self.c_mu = covariance_rate * 2 * (0.25 + self.mu_eff - 2 + 1 / self.mu_eff) / ((d + 2) ** 2 + self.mu_eff)
        scale = min(
            1 + self.c_1 / self.c_mu,
            1 + 2 * bad_eff / (self.mu_eff + 2),
            (1 - self.c_1 - self.c_mu) / (d * self.c_mu),
        )
        self.weights = [w / positive for w in raw[:mu]] + [w / -negative * scale for w in raw[mu:]]

    def tell(self, normals: FloatArray, losses: FloatArray) -> None:
        d = self.d
        self.generation += 1
        ranked = np.argsort(losses)
        z, y = normals[ranked], normals[ranked] @ self.A.T
        local = sum(self.weights[i] * z[i] for i in range(15))
        shaped = sum(self.weights[i] * y[i] for i in range(15))
        self.mean = self.mean + 2.0 * self.sigma * shaped
        pull = math.sqrt(self.c_sigma * (2 - self.c_sigma) * self.mu_eff)
        self.p_sigma = (1 - self.c_sigma) * self.p_sigma + pull * local
        squared = self.p_sigma @ self.p_sigma / (1 - (1 - self.c_sigma) ** (2 * self.generation))
        rising = squared / d - 1 < 1 + 4 / (d + 1)
        pull = math.sqrt(self.c_c * (2 - self.c_c) * self.mu_eff)
        self.p_c = (1 - self.c_c) * self.p_c + (pull * shaped if rising else 0.0)
        c_1a = self.c_1 * (1 - (0 if rising else 1) * self.c_c * (2 - self.c_c))
        C: FloatArray = (1 - c_1a - self.c_mu * sum(self.weights)) * self.C + self.c_1 * np.outer(self.p_c, self.p_c)
        for i, weight in enumerate(self.weights):
            counted = weight if weight >= 0 else weight * d / (z[i] @ z[i])
            C = C + self.c_mu * counted * np.outer(y[i], y[i])
        self.C = C
        expected = math.sqrt(d) * (1 - 1 / (4 * d) + 1 / (21 * d**2))
        self.sigma *= math.exp(self.c_sigma / self.damp * (np.linalg.norm(self.p_sigma) / expected - 1))
        self.A = np.asarray(np.linalg.cholesky(self.C), dtype=np.float64)


@pytest.mark.parametrize("loss", [ellipsoid, slope])
def test_released_settings_are_the_released_search_step_by_step(loss: Callable[[FloatArray], FloatArray]) -> None:
    rng = np.random.default_rng(4)
    start = rng.normal(size=9)
    theirs, ours = Released(start, 0.7, 70), CMA(start, 0.7, 70, settings=released_settings(9, 70))
    for _ in range(6):
        normals = rng.standard_normal((70, 9))
        samples = ours.ask(normals)
        losses = loss(samples)
        theirs.tell(normals, losses)
        ours.tell(samples, losses)
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-9, atol=1e-9 * theirs.sigma)
        np.testing.assert_allclose(ours.covariance, theirs.C, rtol=0, atol=1e-9 * np.abs(theirs.C).max())
        assert ours.sigma == pytest.approx(theirs.sigma, rel=1e-9)


class Blocks:
    """Eq. 16 in plain loops: one ranking, one step size and its path; a covariance for each block, rates of d = 9."""

    def __init__(self, mean: FloatArray, sigma: float, population: int) -> None:
        self.rates = Released(mean[:9], sigma, population)
        self.mean, self.sigma, self.generation = mean.copy(), sigma, 0
        self.C: list[FloatArray] = [np.eye(9), np.eye(9)]
        self.p_sigma, self.p_c = np.zeros(18), np.zeros(18)

    def tell(self, normals: FloatArray, losses: FloatArray) -> None:
        rates = self.rates
        self.generation += 1
        z = normals[np.argsort(losses)]
        roots = [np.linalg.cholesky(block) for block in self.C]
        y = np.hstack([z[:, :9] @ roots[0].T, z[:, 9:] @ roots[1].T])
        local, shaped = (sum(rates.weights[i] * steps[i] for i in range(15)) for steps in (z, y))
        self.mean = self.mean + 2.0 * self.sigma * shaped
        pull = math.sqrt(rates.c_sigma * (2 - rates.c_sigma) * rates.mu_eff)
        self.p_sigma = (1 - rates.c_sigma) * self.p_sigma + pull * local
        squared = self.p_sigma @ self.p_sigma / (1 - (1 - rates.c_sigma) ** (2 * self.generation))
        rising = squared / 18 - 1 < 1 + 4 / 19
        pull = math.sqrt(rates.c_c * (2 - rates.c_c) * rates.mu_eff)
        self.p_c = (1 - rates.c_c) * self.p_c + (pull * shaped if rising else 0.0)
        c_1a = rates.c_1 * (1 - (0 if rising else 1) * rates.c_c * (2 - rates.c_c))
        for block, (a, b) in enumerate(((0, 9), (9, 18))):
            C = (1 - c_1a - rates.c_mu * sum(rates.weights)) * self.C[block]
            C = C + rates.c_1 * np.outer(self.p_c[a:b], self.p_c[a:b])
            for i, weight in enumerate(rates.weights):
                counted = weight if weight >= 0 else weight * 9 / (z[i, a:b] @ z[i, a:b])
                C = C + rates.c_mu * counted * np.outer(y[i, a:b], y[i, a:b])
            self.C[block] = C
        expected = math.sqrt(18) * (1 - 1 / (4 * 18) + 1 / (21 * 18**2))
        self.sigma *= math.exp(rates.c_sigma / rates.damp * (np.linalg.norm(self.p_sigma) / expected - 1))


@pytest.mark.parametrize("population", [70, 200])  # bad samples weigh next to nothing, and something
@pytest.mark.parametrize("loss", [ellipsoid, slope])
def test_two_arms_are_one_search_in_blocks_step_by_step(
    loss: Callable[[FloatArray], FloatArray], population: int
) -> None:
    rng = np.random.default_rng(5)
    start = rng.normal(size=18)
    settings = joint_settings(released_settings(9, population, covariance_rate=1.0 if population > 70 else 4.0), 18)
    theirs, ours = Blocks(start, 0.7, population), CMA(start, 0.7, population, settings=settings, blocks=(9, 9))
    if population > 70:  # with a raised c_mu there would be no negative weights
        theirs.rates = Released(start[:9], 0.7, population, covariance_rate=1.0)
        assert min(theirs.rates.weights) < -1e-3
    for _ in range(6):
        normals = rng.standard_normal((population, 18))
        samples = ours.ask(normals)
        losses = loss(samples)
        theirs.tell(normals, losses)
        ours.tell(samples, losses)
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-9, atol=1e-9 * theirs.sigma)
        whole = np.zeros((18, 18))
        whole[:9, :9], whole[9:, 9:] = theirs.C
        np.testing.assert_allclose(ours.covariance, whole, rtol=0, atol=1e-9 * np.abs(whole).max())
        assert ours.sigma == pytest.approx(theirs.sigma, rel=1e-9)


def test_released_rates_are_the_figures_that_are_known_of_them() -> None:
    """Nine dimensions, 70 samples: computed from the released code's formulas by its readers."""
    settings = released_settings(9, 70)
    assert settings.effective == pytest.approx(19.19, abs=0.005)
    assert settings.step_path_rate == pytest.approx(0.679, abs=5e-4)
    assert settings.step_damping == pytest.approx(2.377, abs=1e-3)
    assert settings.path_rate == pytest.approx(0.355, abs=5e-4)
    assert settings.rank_one_rate == pytest.approx(0.016, abs=5e-4)
    assert settings.rank_mu_rate == pytest.approx(0.998, abs=5e-4)
    assert len(settings.mean_weights) == 15
    assert settings.mean_weights.sum() == pytest.approx(0.782, abs=5e-4)
    assert settings.mean_rate * settings.mean_weights.sum() == pytest.approx(1.56, abs=5e-3)
    assert (settings.weights > 0).all()  # those of bad samples have turned, and are tiny
    assert settings.weights[35:].sum() == pytest.approx(0.0016, abs=1e-4)


def test_elites_do_not_change_the_rates() -> None:
    """The rates are those of half the population, whatever counts."""
    few, default = tutorial_settings(9, 70, elites=15), tutorial_settings(9, 70)
    assert len(few.weights) == 15
    assert len(default.weights) == 35
    assert (few.effective, few.rank_mu_rate) == (default.effective, default.rank_mu_rate)
    raised = tutorial_settings(9, 70, covariance_rate=100.0)
    assert raised.rank_mu_rate + raised.rank_one_rate == pytest.approx(1.0)


@pytest.mark.parametrize(("size", "population"), [(2, 6), (9, 70), (18, 71)])
def test_xnes_is_that_of_the_package_cmaes_step_by_step(size: int, population: int) -> None:
    import cmaes

    rng = np.random.default_rng(1)
    start = rng.normal(size=size)
    theirs, ours = cmaes.XNES(start, 0.7, population_size=population), XNES(start, 0.7, population)
    for _ in range(20):
        samples = ours.ask(rng.standard_normal((population, size)))
        losses = ellipsoid(samples)
        theirs.tell(list(zip(samples, losses.tolist(), strict=True)))
        ours.tell(samples, losses)
        np.testing.assert_allclose(ours.mean, theirs._mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(ours.scale, theirs._sigma * theirs._B, rtol=1e-9, atol=1e-9)


def test_xnes_finds_a_minimum_and_counts_nan_as_worst() -> None:
    rng = np.random.default_rng(0)
    search = XNES(np.zeros(4), 1.0, 20)
    for _ in range(150):
        samples = search.ask(rng.standard_normal((20, 4)))
        losses = ellipsoid(samples)
        losses[0] = np.nan
        search.tell(samples, losses)
    assert np.abs(search.mean - 3.0).max() < 1e-2


@pytest.mark.slow
def test_adam_is_that_of_torch_step_by_step() -> None:
    start = np.array([1.0, -2.0, 0.5])
    theirs = torch.tensor(start, requires_grad=True)
    optimiser = torch.optim.Adam([theirs], lr=0.1)
    ours = Adam(start, 0.1)
    rng = np.random.default_rng(0)
    for _ in range(15):
        gradient = 1e4 * rng.normal(size=3)
        theirs.grad = torch.tensor(gradient)
        optimiser.step()
        ours.tell(gradient)
        np.testing.assert_allclose(ours.point, theirs.detach().numpy(), rtol=1e-12)


def test_adam_first_steps_as_far_as_it_may() -> None:
    """Its second step follows .9 g + .1 g', made up for by 1 - .9^2, over the root of the mean square."""
    search = Adam(np.array([1.0, 1.0]), 0.1)
    search.tell(np.array([5.0, -700.0]))
    np.testing.assert_allclose(search.point, [0.9, 1.1])
    search.tell(np.array([-5.0, -700.0]))
    np.testing.assert_allclose(search.point, [0.9 + 0.1 * (0.1 - 0.09) / (1 - 0.9**2), 1.2])


def test_adam_does_not_care_about_the_size_of_the_gradient_nor_about_nan() -> None:
    one, other = Adam(np.zeros(3), 0.1), Adam(np.zeros(3), 0.1)
    for gradient in ([1.0, -2.0, np.nan], [2.0, 1.0, np.inf], [0.5, -1.0, 0.0]):
        one.tell(np.array(gradient))
        other.tell(1e6 * np.array(gradient))
    np.testing.assert_allclose(one.point, other.point, rtol=1e-6)
    assert one.point[2] == 0.0
