"""Values that the steps of the estimator share: what they observe, and what they found."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from autocalib_ros.config import GateOptions
from autocalib_ros.estimation.adjustment.bundle_adjustment import Adjustment
from autocalib_ros.estimation.adjustment.lens_prior import LensPrior
from autocalib_ros.estimation.adjustment.parameters import AdjustmentState
from autocalib_ros.estimation.certainty import certainty_of_lengths
from autocalib_ros.estimation.lanes.lane_dashes import LanePattern
from autocalib_ros.estimation.lanes.lane_spacing import LaneSpacing
from autocalib_ros.estimation.observations.track_set import TrackSet
from autocalib_ros.estimation.observations.two_frame_windows import ResampledTracks, TwoFrameWindows
from autocalib_ros.estimation.verification.ground_normal import PlaneEstimate
from autocalib_ros.estimation.verification.scale import UNIT_SCALE, Scale
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.results.refusals import OR, TELL_LENS, Reason
from autocalib_ros.results.statements import Statement
from autocalib_ros.results.verification_table import VerificationRow

MAX_SUBSAMPLE_TRACKS = 200
"""Tracks, evenly spaced in the list of all, by which initial solutions are made and compared. The adjustment itself
uses every track."""
SHARP_FOCAL_SIGMA, SHARP_PLANE_SIGMA_DEG = 0.05, 1.5
"""Standard deviations of the focal length (relative) and of tilt or roll up to which a solution is not completed by
further strategies. Judgement."""
MIN_MEASURED_SHARE = 0.8
"""Standard deviation of a focal length over that with which it was told, above which nothing has measured it."""


@dataclass(frozen=True)
class Observations:
    """Evidence as the estimator reads it, with the priors and gates that apply."""

    tracks: TrackSet
    windows: TwoFrameWindows
    instants: ResampledTracks
    priors: list[LensPrior]
    """Lens families, the preferred one first."""
    gate: GateOptions
    evidence: Evidence
    generator: np.random.Generator
    unmeasured_aspect_sigma: float = 0.0
    """Standard deviation of the log pixel aspect where the traffic cannot measure it."""

    @property
    def subsample(self) -> TrackSet:
        """At most `MAX_SUBSAMPLE_TRACKS` of the tracks."""
        return self.tracks.at_most(MAX_SUBSAMPLE_TRACKS)


@dataclass(frozen=True)
class Solution:
    """A lens, the ground plane and its roads; with a reason if there is no ground plane."""

    fit: Adjustment
    plane: PlaneEstimate
    along: np.ndarray
    """Unit vector (3,), camera frame, along the road with the most vehicles."""
    flow: TrackSet
    """Tracks that follow that road straight; empty if no road is straight."""
    assumptions: tuple[Statement, ...]
    checks: tuple[Statement, ...]
    plane_refusal: Reason | None
    lens_refusal: Reason | None = None
    """Why the traffic alone does not determine the lens; lane markings may complete it."""
    reduced: bool = False
    """Whether the plane rests on less than crossing roads or turning vehicles, without an assumption in `plane`."""
    single_road: bool = False
    """Whether lens and plane come from one road and wide priors; the pixel aspect is in the covariance."""
    from_markings: bool = False
    """Whether lens and plane come from the lane markings."""
    of_traffic: Adjustment | None = None
    """The adjustment of the traffic that lane markings replaced; None if `fit` is it, or there is none."""
    with_free_aspect: Adjustment | None = None
    """The adjustment of lane markings alone with the pixel aspect free; None where the traffic measures it."""
    clearly_cut: bool = False
    """Whether the traffic shows a picture that was cut off, so that its centre tells nothing of the principal point."""
    lanes: LanePattern | None = None
    """The dashes of lane lines on the road; None if they show no period."""
    spacing: LaneSpacing | None = None
    """Lines or vehicles at equal spacing, where a width of lanes is told and dashes do not show it; None without."""
    vehicles: Scale | None = None
    """The scale by the size of the vehicles; None if it is not needed, or too few are seen whole."""
    comparisons: tuple[VerificationRow, ...] = ()
    """Comparisons between sources that speak of the same thing, as rows of the verification table."""

    def compared(self, *rows: VerificationRow) -> Solution:
        """Return the solution with further comparisons; one of a kind that it has replaces it."""
        kinds = {row.kind for row in rows}
        return replace(self, comparisons=(*(row for row in self.comparisons if row.kind not in kinds), *rows))

    @property
    def by_traffic(self) -> bool:
        """Whether roads or turning vehicles give lens and plane, alone or together with lane markings."""
        return not self.single_road and (not self.from_markings or self.of_traffic is not None)

    @property
    def assumed(self) -> bool:
        """Whether the plane rests on one of the assumptions."""
        return self.plane.assumed is not None or self.reduced

    @property
    def rests_on_told_focal(self) -> bool:
        """Whether lane markings give the plane for a focal length that was told and that they hardly measure."""
        prior = self.fit.problem.config.prior
        told = prior.focal_known and prior.sigma[0] > 0
        return bool(self.from_markings and told and self.fit.focal_sigma > MIN_MEASURED_SHARE * prior.sigma[0])

    def covering(self, step: np.ndarray) -> Solution:
        """Return the solution with a covariance that covers a step (parameters,) besides."""
        fit = replace(self.fit, covariance=self.fit.covariance + np.outer(step, step))
        return replace(self, fit=fit, plane=replace(self.plane, fit=fit))

    @property
    def uncertainty(self) -> tuple[float, float]:
        """Standard deviation of lengths on the road for a known height, then of the plane, degrees; inf if unknown."""
        certainty = certainty_of_lengths(self.plane, UNIT_SCALE)
        return np.inf if certainty is None else certainty.ground_sigma.worst, self.plane.worst_sigma_deg

    @property
    def full(self) -> bool:
        """Whether crossing roads or turning vehicles determine all of it, with certainty."""
        return self.plane_refusal is None and self.lens_refusal is None and not self.assumed and self.sharp

    @property
    def sharp(self) -> bool:
        """Whether lens and plane are so certain that no further strategy needs to be tried."""
        return self.fit.focal_sigma <= SHARP_FOCAL_SIGMA and self.plane.worst_sigma_deg <= SHARP_PLANE_SIGMA_DEG


def accepted(found: Solution | Reason) -> Solution | Reason:
    """Return a solution that determines the lens, else the reason why it does not."""
    return found if isinstance(found, Reason) else found.lens_refusal or found


def is_better(other: Solution | Reason, found: Solution | Reason) -> bool:
    """Whether `other` gives more than `found`: any solution, then a plane, then more certain lengths on the road.

    These are what the grade is about: a plane that is certain through a lens that is not gives no certain lengths.
    """
    if isinstance(other, Reason) or isinstance(found, Reason):
        return isinstance(other, Solution)
    if other.plane_refusal or found.plane_refusal:
        return other.plane_refusal is None
    return other.uncertainty < found.uncertainty


def append_reason(found: Solution | Reason, further: Reason, *, asks_less: bool = False) -> Solution | Reason:
    """Add to the reason why something is missing, if anything is, why a further strategy failed too.

    Where the further strategy `asks_less` of the traffic than what was found lacks, its remedy is the one to give: any
    strategy suffices, and this one is the nearest to success. A told lens shows straight roads, and no more vehicles.
    """
    if isinstance(found, Solution):
        refusal = found.plane_refusal
        return found if refusal is None else replace(found, plane_refusal=_joined(refusal, further, asks_less))
    return _joined(found, further, asks_less)


def _joined(first: Reason, further: Reason, asks_less: bool) -> Reason:
    numbers = {f'further_{name}': value for name, value in further.values.items()}
    values = {**first.values, **numbers, 'further': further.code}
    remedy = first.remedy
    if asks_less:
        told = TELL_LENS in first.remedy and further.code != 'too_few_vehicles'
        remedy = further.remedy + (OR + TELL_LENS if told else '')
    if first.code == further.code:  # told once, by the number that is nearer to its limit
        return replace(further if asks_less else first, values=values)
    return replace(first, message=f'{first.message}; {further.message}', remedy=remedy, values=values)


def same_change(fit: Adjustment, before: AdjustmentState, after: AdjustmentState) -> np.ndarray:
    """Return the step (parameters,) of a fit that changes lens and plane as from one state to another."""
    camera, point = fit.state.camera, np.subtract(after.camera.principal_point_px, before.camera.principal_point_px)
    k = np.add(camera.k, np.subtract(after.camera.k, before.camera.k))
    moved = replace(
        camera,
        focal_px=camera.focal_px * after.camera.focal_px / before.camera.focal_px,
        principal_point_px=tuple(np.add(camera.principal_point_px, point).tolist()),
        k=tuple(k.tolist()),
        pixel_aspect=camera.pixel_aspect * after.camera.pixel_aspect / before.camera.pixel_aspect,
    )
    rotation = after.rotation @ before.rotation.T @ fit.state.rotation
    return fit.problem.parameters.step_to(replace(fit.state, camera=moved, rotation=rotation))
