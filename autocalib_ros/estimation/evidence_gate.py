"""Is there enough evidence to try: reasons not to, with numbers, in words an installer understands."""

from __future__ import annotations

from autocalib_ros.calibration import Reason
from autocalib_ros.config import GateOptions
from autocalib_ros.evidence import Evidence

REFERENCE_WIDTH_PX = 1280
"""Image width for which `max_drift_px` is given; it scales with the width."""


def shortfall(evidence: Evidence, gate: GateOptions) -> Reason | None:
    """Return the first reason why nothing can be estimated from the evidence, or None."""
    width, height = evidence.image_size
    limit = gate.max_drift_px * width / REFERENCE_WIDTH_PX
    if evidence.drift_px > limit:
        return Reason(
            'camera_moving', f'the camera moves: the background drifted by {evidence.drift_px:.1f} px, and up to '
            f'{limit:.1f} px pass for standing still', 'fix the camera to something rigid and record again')
    if not evidence.track_count:
        return Reason(
            'no_motion', f'nothing moved in {evidence.frames} images over {evidence.seconds:.0f} s',
            'check that the camera sees traffic and that the images are not frozen or dark')
    if evidence.track_count < gate.min_tracks:
        return Reason(
            'too_few_tracks', f'{evidence.track_count} tracks of the {gate.min_tracks} needed after '
            f'{evidence.seconds:.0f} s', 'wait for more traffic, or record for longer')
    if evidence.coverage < gate.min_coverage:
        return Reason(
            'poor_coverage', f'traffic crossed {evidence.coverage:.0%} of the image, {gate.min_coverage:.0%} is needed',
            'turn the camera so that the road fills more of the image, or choose a longer lens')
    return None
