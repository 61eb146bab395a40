"""What a refusal means at the road, in a few words for a person who sees it; the message has the numbers."""

from __future__ import annotations

from collections.abc import Mapping

from autocalib_ros.results.statements import Value

ROAD_WORDS = {
    'camera_moving': 'the camera does not stand still',
    'no_motion': 'nothing moves in the picture',
    'too_few_tracks': 'too little traffic was seen',
    'too_few_tracks/curved': 'the road bends, or all vehicles turn',
    'too_few_tracks/far': 'vehicles are followed only far away',
    'poor_coverage': 'the traffic crosses too little of the picture',
    'no_direction': 'no straight road is seen: the road bends, or all vehicles turn',
    'no_agreement': 'no lens curvature is visible',
    'turning_traffic': 'most vehicles turn, or the road bends',
    'horizon': 'the road bends: its traffic would reach above the horizon',
    'too_little_curvature': 'no lens curvature is visible',
    'too_little_turning': 'too few vehicles turn',
    'lens_model': 'the traffic shows a lens unlike any usual one',
    'halves_disagree': 'earlier and later traffic show different roads, as if the camera had moved',
    'given_lens': 'the given lens is not that of these images',
    'pixel_aspect': 'the picture may be squeezed',
    'one_direction': 'all traffic follows one road',
    'grade_too_low': 'lengths on the road are known only roughly',
    'plane_uncertain': 'the slope of the road against the camera is not clear',
    'no_markings': 'lane markings show no road',
    'markings_contradicted': 'lane markings and traffic show different roads',
    'markings_unconfirmed': 'lane markings show a road that no traffic confirms',
    'no_height': 'no length is known at the road',
    'implausible': 'vehicles would have an unusual size or speed',
    'scale_off_road': 'an end of the known length is not on the road',
    'too_few_vehicles': 'too few vehicles follow one straight road',
    'scale_uncertain': 'the known length is too uncertain',
    'vanishing_points_disagree': 'the two roads do not cross at a right angle',
    'distortion_model': 'the distortion model that was asked for does not fit the lens',
}
"""By code, or by code/cause where a cause has words of its own."""


def in_road_words(code: str, values: Mapping[str, Value]) -> str:
    """Return what a refusal with its numbers means at the road; '' for an unknown code."""
    parts = [ROAD_WORDS.get(f'{code}/{values.get("cause", "")}', ROAD_WORDS.get(code, ''))]
    further = ROAD_WORDS.get(str(values.get('further', '')), '')
    if further and further not in parts:
        parts.append(further)
    return ', and '.join(filter(None, parts))
