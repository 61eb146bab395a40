"""Stub of the table of refusal codes, until the lead's own replaces it."""

from __future__ import annotations

from typing import NamedTuple


class RefusalCode(NamedTuple):
    """A refusal code: what causes it, the limit that decides, and the remedy."""

    code: str
    cause: str
    limit: str
    remedy: str


REFUSALS = (
    RefusalCode(
        'camera_moving',
        'The camera moves: the background has drifted in the image.',
        'gate.max_drift_px, 3 px at an image width of 1280 px (scaled with the width)',
        'Fix the camera to a rigid mount and record again.',
    ),
    RefusalCode(
        'no_motion',
        'No moving object was tracked.',
        'at least one track',
        'Check that the camera sees traffic and that the images are neither frozen nor dark.',
    ),
    RefusalCode(
        'too_few_tracks',
        'Too few tracks, or too few that are long enough. With method paper: no track fills the observation interval.',
        'gate.min_tracks, 40; with method paper paper.min_lifetime (80 %) of paper.window_s (6 s)',
        'Wait for more traffic or record for longer. With method paper: record slower traffic, shorten '
        'paper.window_s, or use method joint.',
    ),
    RefusalCode(
        'poor_coverage',
        'Traffic crosses too small a part of the image.',
        'gate.min_coverage, 15 % of the image cells',
        'Turn the camera so that the road fills more of the image, or use a longer lens.',
    ),
    RefusalCode(
        'no_direction',
        'No road direction found: the straight tracks have no common vanishing point.',
        'no fixed limit: a consensus search must return a direction',
        'Wait for straight traffic, or turn the camera towards a straight road.',
    ),
    RefusalCode(
        'no_agreement',
        'The focal length is not identifiable: the best candidate explains hardly more straight traffic than '
        'the median candidate.',
        'support at the best focal length at least 1.3 times the median',
        'Wait for straight traffic, above all near the borders of the image. The traffic may be turning, or '
        'the lens may have no distortion: then set joint.road_angle or joint.focal_prior_px.',
    ),
    RefusalCode(
        'turning_traffic',
        'Too few vehicles follow the straight roads that were found: the traffic turns, or the road bends.',
        'at least 25 % of the vehicles on two or more roads, 75 % on a single road (50 % if at least 80 % of '
        'those keep to it)',
        'Wait for straight traffic, or turn the camera towards a straight road.',
    ),
    RefusalCode(
        'horizon',
        'Tracked points lie above the horizon of the estimated plane, so the tracks do not belong to one plane.',
        'at least 95 % of the tracked points below the horizon',
        'Wait for more traffic.',
    ),
    RefusalCode(
        'too_little_curvature',
        'The focal length is uncertain: straight traffic shows too little lens curvature.',
        'gate.max_sigma_focal_rel, 5 % (one sigma); or a focal length above 1.5 image diagonals; or a '
        'distortion-free lens without a known road angle',
        'Wait for traffic nearer the borders of the image. For a lens without distortion give the angle '
        'between two roads (joint.road_angle) or the focal length (joint.focal_prior_px).',
    ),
    RefusalCode(
        'too_little_turning',
        'The focal length is uncertain: too few vehicles turn, or they turn too little.',
        '3 % of the focal length (one sigma), or gate.max_sigma_focal_rel if that is smaller',
        'Wait for more turning vehicles, or for straight traffic.',
    ),
    RefusalCode(
        'one_centre',
        'All vehicles turn about one point, as on one ring or bend, which constrains the focal length too weakly.',
        '2 % of the focal length (one sigma), if half of the turning centres lie within 50 % of the turning radius',
        'Wait for vehicles that turn elsewhere, enter, leave or drive straight.',
    ),
    RefusalCode(
        'lens_model',
        'The estimated distortion k1 is too far from the assumed lens family.',
        '3.5 times joint.k1_sigma (0.03)',
        'Increase joint.k1_sigma if the lens is known to differ.',
    ),
    RefusalCode(
        'halves_disagree',
        'Cross-validation in time failed: the earlier and the later half of the traffic give different results.',
        '3 % in focal length and 1.5 degrees in the ground normal, or 3.5 sigma if that is larger',
        'Record for longer, and check that the camera is firmly fixed.',
    ),
    RefusalCode(
        'one_direction',
        'No ground plane: a single road direction leaves the rotation about that road free. With method '
        'paper: the orientation histogram has fewer than two peaks.',
        'gate.min_tracks_per_road, 10 tracks on each of two roads',
        'Wait for traffic across the main road or for turning traffic, or set joint.roll_prior_deg.',
    ),
    RefusalCode(
        'plane_uncertain',
        'The ground normal is too uncertain, or two estimates of it disagree.',
        'gate.max_sigma_tilt_deg, 1.5 degrees (one sigma); three times that for a plane that rests on an assumption',
        'Wait for more traffic on the quieter road. If vehicle edges and a level camera disagree, set '
        'joint.roll_prior_deg to 0 or to the roll that is possible.',
    ),
    RefusalCode(
        'no_markings',
        'Lane markings do not give a lens and a plane: there are too few, or they fit two planes, two focal '
        'lengths or no right angle. Reported inside the message of another code.',
        'at least 10 % of the lines along each of two directions, in at least 5 places; a right angle within '
        '2.5 degrees',
        'Wait for more traffic.',
    ),
    RefusalCode(
        'markings_contradicted',
        'The plane from the lane markings contradicts the traffic.',
        '3 sigma or 1.5 degrees, whichever is larger',
        'Wait for more traffic. If the markings are not square to each other, set joint.road_markings to false.',
    ),
    RefusalCode(
        'markings_unconfirmed',
        'Lane markings give a lens and a plane, but the traffic is too sparse to confirm them.',
        '4.5 degrees (one sigma) for the plane or the road from traffic',
        'Wait for more traffic, straight or turning.',
    ),
    RefusalCode(
        'no_height',
        'No ground plane: the scale is unknown, because no camera height was given.',
        'camera_height above 0',
        'Give camera_height in metres, or a distance on the road or the mean traffic speed (scale_from), or '
        'set allow_unit_scale for a plane in units of the camera height.',
    ),
    RefusalCode(
        'scale_off_road',
        'A pixel of scale.distance_px is not on the road, or the lens images nothing there.',
        'at least 1.7 degrees below the horizon (33 camera heights away)',
        'Choose two pixels on the road surface, near the camera.',
    ),
    RefusalCode(
        'too_few_vehicles',
        'Too few vehicles drive straight along the busiest road to measure its mean speed.',
        '10 vehicles',
        'Wait for more traffic or record for longer.',
    ),
    RefusalCode(
        'scale_uncertain',
        'The camera height that follows from the given scale is too uncertain.',
        'gate.max_sigma_height_rel, 20 % (one sigma)',
        'Give a longer distance on the road nearer to the camera, wait for more traffic, or give the camera height.',
    ),
    RefusalCode(
        'vanishing_points_disagree',
        'Method paper only: no focal length makes the two vanishing points perpendicular.',
        'the focal length squared must be positive',
        'The roads are not perpendicular, or the lens is wrong: use method joint.',
    ),
    RefusalCode(
        'distortion_model',
        'The distortion model that was asked for cannot represent the lens.',
        '0.5 px anywhere in the image',
        'Set distortion_model to one of the models that the message names; equidistant always fits.',
    ),
)
"""Every code."""
