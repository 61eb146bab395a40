"""A solution with some parameters of its given lens released: what the traffic asks for, and the plane with that."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.solution import Solution, same_change
from autocalib_ros.lens.camera import Camera


@dataclass(frozen=True)
class ReleasedLens:
    """The solution with some parameters of the given lens free."""

    given: Camera
    fit: Adjustment

    @property
    def camera(self) -> Camera:
        """The lens that the traffic asks for."""
        return self.fit.state.camera

    def change(self, function: Callable[[Camera], np.ndarray]) -> tuple[np.ndarray, float]:
        """Return the change (n,) of a function of the lens, and its length in standard deviations."""
        change = function(self.camera) - function(self.given)
        covariance = self.fit.covariance_of(lambda state: function(state.camera))
        if not np.isfinite(covariance).all():
            return change, 0.0
        # the smallest eigenvalues of a singular covariance are of a direction that is not free
        return change, float(np.sqrt(max(change @ np.linalg.pinv(covariance, rcond=1e-9) @ change, 0.0)))

    @cached_property
    def focal_change(self) -> tuple[float, float]:
        """Change of the log focal length, and its absolute value in standard deviations."""
        change, sigmas = self.change(lambda camera: np.array([np.log(camera.focal_px)]))
        return float(change[0]), sigmas


def released_lens(lens: Camera, found: Solution, tracks: TrackSet, sigma: Sequence[float]) -> ReleasedLens:
    """Adjust with parameters of the given lens free; `sigma` is of the `LENS_PARAMETERS`."""
    fit = found.of_traffic or found.fit
    config = replace(fit.problem.config, prior=LensPrior('known', lens, np.array(sigma)))
    return ReleasedLens(lens, adjust(fit.state, tracks, config, refine=True, warm_start=fit.problem.warm_start))


def step_to_released(found: Solution, release: ReleasedLens) -> np.ndarray:
    """Return the step (parameters,) of a solution to the plane that it has with the released lens."""
    turned = replace(release.fit.state, camera=release.given)
    return same_change(found.fit, (found.of_traffic or found.fit).state, turned)


def step_of_released(found: Solution, release: ReleasedLens, step: np.ndarray) -> np.ndarray:
    """Return the step (parameters,) by which the plane of a solution turns as with a step of the released one."""
    before, after = release.fit.state, release.fit.problem.parameters.state(step)
    return same_change(found.fit, before, replace(after, camera=before.camera))


def step_with_focal_length(found: Solution, release: ReleasedLens) -> np.ndarray:
    """Return the step (parameters,) of a solution that covers the plane with the focal length of the traffic.

    A difference within the tolerance may be a fault of either, and the plane turns with it. What exceeds the error of
    the traffic is taken for the error of the lens (moment estimator of DerSimonian and Laird 1986, for one difference).
    """
    _, sigmas = release.focal_change
    return np.sqrt(max(1.0 - 1.0 / max(sigmas, 1.0) ** 2, 0.0)) * step_to_released(found, release)
