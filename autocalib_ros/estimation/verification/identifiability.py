"""Fix parameters that the evidence does not determine at their prior mean, and report them."""

from __future__ import annotations

from dataclasses import replace

from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment, adjust, evaluate_with
from autocalib_ros.estimation.adjustment.covariance import sigma_without_prior
from autocalib_ros.estimation.adjustment.lens_prior import LENS_PARAMETERS, LensPrior
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.lens.camera import Camera
from autocalib_ros.results.statements import Statement, assumption


def free_k2(fit: Adjustment, tracks: TrackSet) -> Adjustment:
    """Free k2 within its prior: no lens follows its family exactly. A single road does not determine it."""
    config = fit.problem.config
    if config.prior.sigma[3] <= 0 or config.prior.sigma[4] > 0 or not fit.plane_known:
        return fit
    freed = replace(config, prior=config.prior.with_free_k2())
    return adjust(fit.state, tracks, freed, refine=True, warm_start=fit.problem.warm_start)


def fix_unidentifiable(fit: Adjustment, tracks: TrackSet) -> tuple[Adjustment, tuple[str, ...]]:
    """Fix the lens parameters that the evidence does not determine at their prior; and their names."""
    config, fixed = fit.problem.config, _unidentifiable(fit)
    if not fixed:
        return fit, ()
    at_prior = config.prior.start(fit.state.camera.focal_px)
    camera = fit.state.camera
    for name in fixed:
        camera = _restored(camera, at_prior, name)
    solved = adjust(
        replace(fit.state, camera=camera),
        tracks,
        replace(config, prior=config.prior.with_fixed(fixed)),
        refine=True,
        warm_start=fit.problem.warm_start,
    )
    return evaluate_with(solved, tracks, config), fixed


def _unidentifiable(fit: Adjustment) -> tuple[str, ...]:
    """Names of the lens parameters whose sigma from the evidence alone exceeds that of the prior."""
    prior = fit.problem.config.prior
    _, known = fit.problem.parameters.prior_gradient(fit.state)
    sigmas = sigma_without_prior(fit.information, known)
    names = [LENS_PARAMETERS[parameter] for parameter in prior.free]
    return tuple(name for name, sigma, is_known in zip(names, sigmas, known, strict=False) if is_known and sigma > 1.0)


def _restored(camera: Camera, prior: Camera, name: str) -> Camera:
    """Return the camera with one parameter at its prior mean."""
    (cx, cy), (k1, k2, *rest) = camera.principal_point_px, camera.k
    if name == 'focal length':
        return replace(camera, focal_px=prior.focal_px)
    if name == 'principal point x':
        return replace(camera, principal_point_px=(prior.principal_point_px[0], cy))
    if name == 'principal point y':
        return replace(camera, principal_point_px=(cx, prior.principal_point_px[1]))
    k3, k4 = rest
    return replace(camera, k=(prior.k[0], k2, k3, k4) if name == 'k1' else (k1, prior.k[1], k3, k4))


def given_focal_assumption(prior: LensPrior) -> Statement:
    """Return the focal length, or the field of view, that is given."""
    if prior.view_deg > 0:
        return assumption('view_given', view_deg=prior.view_deg, sigma_deg=prior.sigma[0] * prior.view_deg)
    focal_px = prior.centre.focal_px
    return assumption('focal_given', focal_px=focal_px, sigma_px=prior.sigma[0] * focal_px)


def principal_point_assumption(prior: LensPrior) -> Statement:
    """Return where the principal point was assumed; a picture that does not fill the images is named."""
    sigma_px, down_px = prior.sigma[1:3]
    more: dict[str, object] = {}
    if prior.picture is not None and not prior.picture.fills_image:
        more |= {'picture': str(prior.picture), 'covered': prior.picture.is_covered}
    if down_px != sigma_px:
        more['sigma_down_px'] = down_px
    return assumption('principal_point', sigma_px=sigma_px, **more)


def lens_assumptions(fit: Adjustment, fixed: tuple[str, ...]) -> tuple[Statement, ...]:
    """Return what was assumed of the lens, with the parameters that were fixed at their prior."""
    prior = fit.problem.config.prior
    if prior.family == 'known':
        return (assumption('lens_given'),)
    statements = [
        assumption('lens_family', family=prior.family, k1_sigma=prior.sigma[3]),
        principal_point_assumption(prior),
    ]
    if prior.focal_known:
        statements.append(given_focal_assumption(prior))
    # what is taken of the pixels has a statement of its own
    names = [name for name in fixed if name != 'pixel aspect']
    return (*statements, *(assumption('parameter_fixed', parameter=name) for name in names))
