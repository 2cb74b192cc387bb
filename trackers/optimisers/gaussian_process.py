"""A Gaussian process on the unit cube, some of whose coordinates may be periodic. Needs the extra ``turbo``."""

from __future__ import annotations

import warnings

import gpytorch
import numpy as np
import torch
from botorch.models import SingleTaskGP
from botorch.optim.fit import fit_gpytorch_mll_scipy
from gpytorch.constraints import Interval
from gpytorch.kernels import MaternKernel, ProductKernel, ScaleKernel
from gpytorch.likelihoods import GaussianLikelihood
from gpytorch.mlls import ExactMarginalLogLikelihood
from numpy.typing import NDArray

from surgbench.geometry import FloatArray

LENGTHS = (0.005, 4.0)
NOISE = (1e-4, 0.2)  # of values with variance 1
FIT_STEPS = 20


class GaussianProcess:
    """Matern 5/2 with a length for each coordinate, fitted by maximum marginal likelihood.

    A periodic coordinate enters as a point on a circle of circumference 1, so that its length compares with those
    of the others.

    Args:
        points: ``(n, d)`` of the unit cube.
        values: ``(n,)``.
        periodic: ``(d,)`` which coordinates are.
        like: One of earlier points, whose fit this one begins at.
    """

    def __init__(
        self,
        points: FloatArray,
        values: FloatArray,
        periodic: NDArray[np.bool_],
        like: GaussianProcess | None = None,
    ) -> None:
        self._periodic = periodic
        straight = int((~periodic).sum())
        bounds = Interval(*LENGTHS)
        parts = [MaternKernel(ard_num_dims=straight, active_dims=range(straight), lengthscale_constraint=bounds)]
        for circle in range(int(periodic.sum())):
            first = straight + 2 * circle
            parts.append(MaternKernel(active_dims=(first, first + 1), lengthscale_constraint=Interval(*LENGTHS)))
        self._parts = parts if straight else parts[1:]
        for part in self._parts:
            part.lengthscale = 0.5
        self._model = SingleTaskGP(
            self._features(points),
            torch.from_numpy(values)[:, None],
            likelihood=GaussianLikelihood(noise_constraint=Interval(*NOISE)),
            covar_module=ScaleKernel(ProductKernel(*self._parts), outputscale_constraint=Interval(0.05, 20.0)),
        )
        if like is not None:
            self._model.covar_module.load_state_dict(like._model.covar_module.state_dict())
            self._model.likelihood.load_state_dict(like._model.likelihood.state_dict())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # stopping after FIT_STEPS is meant
            fit_gpytorch_mll_scipy(
                ExactMarginalLogLikelihood(self._model.likelihood, self._model), options={"maxiter": FIT_STEPS}
            )

    @property
    def lengths(self) -> FloatArray:
        """``(d,)`` length of each coordinate."""
        lengths = np.empty(len(self._periodic))
        found = np.concatenate([part.lengthscale.detach().numpy().reshape(-1) for part in self._parts])
        straight = int((~self._periodic).sum())
        lengths[~self._periodic], lengths[self._periodic] = found[:straight], found[straight:]
        return lengths

    def sample(self, points: FloatArray, normals: FloatArray) -> FloatArray:
        """Draws of the posterior.

        Args:
            points: ``(n, d)`` of the unit cube.
            normals: ``(draws, n)`` standard normal numbers.

        Returns:
            ``(draws, n)`` values at the points.
        """
        with torch.no_grad(), gpytorch.settings.max_cholesky_size(1 << 16):
            posterior = self._model.posterior(self._features(points))
            draws = posterior.rsample_from_base_samples(torch.Size([len(normals)]), torch.from_numpy(normals))
        return np.asarray(draws[..., 0].numpy(), dtype=np.float64)

    def _features(self, points: FloatArray) -> torch.Tensor:
        turn = 2 * np.pi * points[:, self._periodic]
        circles = 0.5 + np.stack([np.cos(turn), np.sin(turn)], axis=-1) / (2 * np.pi)
        return torch.from_numpy(np.concatenate([points[:, ~self._periodic], circles.reshape(len(points), -1)], axis=1))
