"""The refusal codes: what each means, the limit that decides, the remedy, and the words of its messages.

`reason` makes the refusal of a code from its numbers. The log, the report, the documentation and the tests read the
same table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from autocalib_ros.results.statements import Value, in_words, plain_values


@dataclass(frozen=True)
class Reason:
    """Why something is not given: a code for programs, numbers in words, and a remedy."""

    code: str
    message: str
    remedy: str
    values: Mapping[str, Value] = field(default_factory=dict, compare=False)
    """The numbers of the message and the limit that they missed, by the names in the table, and the `cause` if the
    code has several; `further` is the code of a strategy that failed too, and `further_NAME` its numbers."""


@dataclass(frozen=True, kw_only=True)
class RefusalCode:
    """One refusal code; texts are templates for str.format."""

    code: str
    cause: str
    limit: str
    """The option or constant that decides, with its value."""
    remedy: str
    """What helps; alternatives are separated by '; or '. A test tries each one on simulated traffic that is refused."""
    missing: str
    """The name of the requirement that was not met, for tables."""
    message: str
    variants: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    """Message and remedy ('' for the usual one) of further causes with the same code, by the name of the cause."""


def reason(code: str, cause: str = '', **values: object) -> Reason:
    """Return the refusal of a code with its numbers; `cause` names one of its variants."""
    entry, plain = BY_CODE[code], plain_values(values)
    message, remedy = entry.variants[cause] if cause else (entry.message, '')
    told = {**plain, 'cause': cause} if cause else plain
    return Reason(code, in_words(message, plain), in_words(remedy or entry.remedy, plain), told)


OR = '; or '
"""Separates the alternatives of a remedy, each of which helps by itself."""
WAIT = 'wait for more traffic, or record for longer'
WAIT_STRAIGHT = 'wait for vehicles that drive straight'
STRAIGHT_ROAD = 'turn the camera towards a straight road'
TELL_LENS = 'give the focal length or field of view of the lens, as its data sheet says (--focal-px, --hfov-deg)'
SECOND_ROAD = 'wait for traffic on a second road, or for vehicles that turn'

REFUSALS = (
    RefusalCode(
        code='camera_moving',
        cause='The camera moves: the background is displaced in the image for good. Or the view changes, by cuts, '
        'zooms or motion, and no part of the recording stands still for long enough. Sway about a rest position is '
        'compensated up to 4.5 px, or 0.35 % of the image width if that is more.',
        limit='gate.max_drift_px, 3 px at an image width of 1280 px (scaled with the width, at least 1.5 px); a still '
        'part of at least 10 s where the view changes',
        remedy='fix the camera to a rigid mount and record again',
        missing='a camera that stands still',
        message='the camera moves: the background drifted by {drift_px:.1f} px (limit {limit_px:.1f} px)',
        variants={
            'always': (
                'the camera moves all the time: the picture moved by {travel_px:.0f} px in {seconds:.0f} s; its '
                'longest still part lasts {part_s:.1f} s (at least {limit_s:.0f} s needed)',
                '',
            ),
            'turned': (
                'the camera was moved at {time_s:.1f} s: the picture was displaced by {moved_px:.1f} px; the still '
                'part lasts {part_s:.1f} s (at least {limit_s:.0f} s needed)',
                'record for longer while the camera stands, on a rigid mount',
            ),
            'zoom': (
                'the picture was zoomed by {factor:.2f} between {from_s:.1f} and {to_s:.1f} s (zooms in all: {count}); '
                'the still part lasts {part_s:.1f} s (at least {limit_s:.0f} s needed)',
                'record for longer without a zoom, and switch off an automatic zoom',
            ),
            'cut': (
                'the view was cut at {time_s:.1f} s (cuts, title cards or other cameras in all: {count}); the still '
                'part lasts {part_s:.1f} s (at least {limit_s:.0f} s needed)',
                'record one view of the road for longer',
            ),
        },
    ),
    RefusalCode(
        code='no_motion',
        cause='No moving object was tracked.',
        limit='at least one track',
        remedy='check that the camera sees traffic and that the images are neither frozen nor dark',
        missing='traffic',
        message='no moving object in {frames} images over {seconds:.0f} s',
    ),
    RefusalCode(
        code='too_few_tracks',
        cause='Too few tracks, or too few that are long enough. Method paper: no track fills the observation interval.',
        limit='gate.min_tracks, 40; method paper: paper.min_lifetime (80 %) of paper.window_s (6 s)',
        remedy=WAIT,
        missing='tracks that are long enough',
        message='{tracks} tracks after {seconds:.0f} s (at least {limit} needed)',
        variants={
            'short': ('{tracks} tracks are long enough (at least {limit} needed)', ''),
            'curved': (
                '{tracks} of {all} tracks are nearly straight (at least {limit} needed): the traffic turns, or the '
                'road bends',
                WAIT_STRAIGHT + OR + STRAIGHT_ROAD,
            ),
            'far': (
                'vehicles are followed over short ways only, as far away: {tracks} of {all} tracks are long enough (at '
                'least {limit} needed)',
                'turn the camera towards a nearer part of the road' + OR + 'use a longer lens',
            ),
            'paper': (
                'no track lasted for {lifetime:.0%} of an interval of {window_s:g} s with a path of at most '
                '{path_ratio:g} times its displacement',
                'shorten paper.window_s' + OR + 'use method joint',
            ),
        },
    ),
    RefusalCode(
        code='poor_coverage',
        cause='Traffic crosses too small a part of the image.',
        limit='gate.min_coverage, 15 % of the image cells',
        remedy='turn the camera so that the road fills more of the image' + OR + 'use a longer lens',
        missing='traffic in enough of the image',
        message='traffic crossed {coverage:.0%} of the image (at least {limit:.0%} needed)',
    ),
    RefusalCode(
        code='no_direction',
        cause='No road direction found: the straight tracks have no common vanishing point.',
        limit='no fixed limit: the consensus search must return a direction',
        remedy=WAIT_STRAIGHT + OR + STRAIGHT_ROAD,
        missing='tracks along a common direction',
        message='{tracks} tracks have no common vanishing point',
    ),
    RefusalCode(
        code='no_agreement',
        cause='The focal length is not identifiable: the best candidate explains hardly more straight traffic than '
        'the median candidate.',
        limit='support at the best focal length at least 1.3 times the median (MIN_FOCAL_CONTRAST)',
        remedy=WAIT_STRAIGHT + OR + TELL_LENS,
        missing='an identifiable focal length',
        message='focal length not identifiable: support of straight traffic at the best candidate is {contrast:.2f} '
        'times the median (at least {limit:g} needed)',
    ),
    RefusalCode(
        code='turning_traffic',
        cause='Too few vehicles follow the straight roads that were found: the traffic turns, or the road bends.',
        limit='at least 25 % of the vehicles on two or more roads, 75 % on a single road (50 % if at least 80 % of '
        'those keep to it)',
        remedy=WAIT_STRAIGHT + OR + STRAIGHT_ROAD,
        missing='straight traffic',
        message='{fraction:.0%} of the vehicles follow the {roads} straight roads that fit best (at least {limit:.0%} '
        'needed): the traffic turns, or the road bends',
        variants={
            'one_road': (
                '{fraction:.0%} of the vehicles follow the one straight road that was found (at least {limit:.0%} '
                'needed): the traffic turns, or the road bends',
                '',
            )
        },
    ),
    RefusalCode(
        code='horizon',
        cause='Tracked points lie above the horizon of the estimated plane, so the tracks do not belong to one plane.',
        limit='at least 95 % of the tracked points below the horizon',
        remedy=WAIT_STRAIGHT + OR + STRAIGHT_ROAD,
        missing='traffic below the horizon',
        message='{fraction:.0%} of the tracked points lie above the horizon of the estimated plane (limit {limit:.0%})',
        variants={
            'upside_down': (
                'through the ground plane that fits the traffic the camera would hang upside down (roll '
                '{roll_deg:.0f} degrees): the picture is, or the roads that were found are none',
                '',
            )
        },
    ),
    RefusalCode(
        code='too_little_curvature',
        cause='The focal length is uncertain: straight traffic shows too little lens curvature.',
        limit='gate.max_sigma_focal_rel, 25 % (one sigma); or a focal length above 1.5 image diagonals; or a '
        'distortion-free lens without a known road angle or focal length',
        remedy=TELL_LENS,
        missing='lens curvature',
        message='straight traffic shows too little lens curvature: focal length {focal_px:.0f} px, {sigma:±.1%} '
        '(at most ± {limit:.0%} allowed)',
    ),
    RefusalCode(
        code='too_little_turning',
        cause='The focal length is uncertain: too few vehicles turn, or they turn too little.',
        limit='gate.max_sigma_focal_rel (25 % of the focal length, one sigma)',
        remedy='wait for more vehicles that turn' + OR + TELL_LENS,
        missing='turning traffic',
        message='turning traffic does not determine the lens: focal length {focal_px:.0f} px, {sigma:±.1%} '
        '(at most ± {limit:.0%} allowed)',
    ),
    RefusalCode(
        code='lens_model',
        cause='The estimated distortion k1 is too far from the assumed lens family; or far more vehicles drive '
        'straight through a lens of another family than of the one that is set.',
        limit='3.5 times joint.k1_sigma (0.03); 3 sigma of the number of vehicles that drive straight',
        remedy=WAIT + OR + TELL_LENS + OR + 'increase joint.k1_sigma if the lens is known to differ',
        missing='a lens near its family',
        message='the lens is not close to {family}: k1 = {k1:.3f}, {sigmas:.1f} sigma off (limit {limit:g})',
        variants={
            'family': (
                'the traffic contradicts joint.lens_prior {stated}: {following:.0%} of the vehicles drive straight '
                'through such a lens, {other_following:.0%} through one that is {other}, {sigmas:.1f} sigma more '
                '(limit {limit:g})',
                'set joint.lens_prior to auto',
            )
        },
    ),
    RefusalCode(
        code='halves_disagree',
        cause='Cross-validation in time failed: the earlier and the later half of the traffic give different results.',
        limit='3 % in focal length and 1.5 degrees in the ground normal, or 3.5 sigma if that is larger; 0.3 % by '
        'chance for focal length and rotation together; and 4 sigma for the share of vehicles on the roads',
        remedy='fix the camera firmly, and record again' + OR + 'record for longer',
        missing='agreement of both halves of the traffic',
        message='the earlier and the later half of the traffic disagree: focal length by {focal:.1%} (limit '
        '{focal_limit:.1%}), ground normal by {normal_deg:.1f} degrees (limit {normal_limit_deg:.1f})',
        variants={
            'share': (
                'the earlier and the later half of the traffic disagree: {earlier:.0%} of the vehicles follow the '
                'roads in one and {later:.0%} in the other, {sigmas:.1f} sigma (limit {limit:g})',
                '',
            ),
            'pose': (
                'the earlier and the later half of the traffic disagree: focal length and rotation of the camera '
                'together by {sigmas:.1f} sigma (limit {limit:.1f}), {turned_deg:.1f} degrees of rotation',
                '',
            ),
        },
    ),
    RefusalCode(
        code='given_lens',
        cause='The given lens does not belong to these images: the traffic contradicts it, or its principal point lies '
        'outside them.',
        limit='3 % of the focal length, or of the image width for the principal point, or 3 sigma if that is larger',
        remedy='give the camera_info file of this camera in this resolution, mode and zoom, and check that K belongs '
        'to the size in the file' + OR + 'leave the file out',
        missing='a lens that belongs to the images',
        message='the traffic contradicts the given lens: its focal length is {given_px:.1f} px, the traffic gives '
        '{traffic_px:.1f} ± {sigma_px:.1f} px',
        variants={
            'unseen': (
                'the given lens images nothing farther than {radius_px:.0f} px from its principal point, where '
                '{unseen:.0%} of the tracked points lie (at most {limit:.0%} allowed)',
                '',
            ),
            'focal_and_k1': (
                'the traffic contradicts the given lens: its focal length is {given_px:.1f} px with k1 = '
                '{given_k1:.3f}, the traffic gives {traffic_px:.1f} ± {sigma_px:.1f} px with {traffic_k1:.3f} ± '
                '{k1_sigma:.3f}',
                '',
            ),
            'outside': (
                'the principal point of the given lens, ({x_px:.1f}, {y_px:.1f}), lies outside the images of '
                '{width}x{height}',
                '',
            ),
            'principal_point': (
                'the traffic contradicts the given lens: its principal point is ({x_px:.1f}, {y_px:.1f}), the traffic '
                'gives ({traffic_x_px:.1f}, {traffic_y_px:.1f}) ± {sigma_px:.1f} px',
                '',
            ),
            'pixel_aspect': (
                'the traffic contradicts the given lens: its pixels are {aspect:.3f} times as wide as high, the '
                'traffic gives {traffic_aspect:.3f} ± {sigma:.3f}',
                '',
            ),
            'angle': (
                'the traffic contradicts the given lens: it images {given_deg:.1f} degrees from its axis at '
                '{radius_px:.0f} px, the traffic gives {traffic_deg:.1f} ± {sigma_deg:.1f} degrees there',
                '',
            ),
        },
    ),
    RefusalCode(
        code='pixel_aspect',
        cause='The pixels may not be square: the traffic cannot tell, or it contradicts square pixels and every usual '
        'squeeze.',
        limit='gate.max_sigma_focal_rel, 25 % (one sigma), with the difference that the pixel aspect makes',
        remedy='set lens.pixel_aspect, the width of a pixel over its height: 1 if the images are not squeezed, else '
        'the shape of the picture over that of the image (720x576 of a 16:9 picture: 1.422)',
        missing='the shape of the pixels',
        message='pixels may be {aspect:.3g} times as wide as high: the traffic measures {measured:.2f} ± '
        '{sigma:.2f}, and the focal length is {focal:±.0%} with it (at most ± {limit:.0%} allowed)',
        variants={
            'undecided': (
                'pixels of these images of {width}x{height} may be {aspect:.3g} times as wide as high: the traffic '
                'measures {measured:.2f} ± {sigma:.2f}, which does not exclude {other:.3g}',
                '',
            )
        },
    ),
    RefusalCode(
        code='one_direction',
        cause='No ground plane: a single road direction leaves the rotation about that road free. Method paper: the '
        'orientation histogram has fewer than two peaks.',
        limit='gate.min_tracks_per_road, 10 tracks on each of two roads',
        remedy=SECOND_ROAD + OR + 'set joint.roll_prior_deg if the camera is level',
        missing='traffic in two directions, or that turns',
        message='too little traffic across the main road: {across} of {limit} tracks; {along} tracks follow one road, '
        'and the rotation about it is free',
        variants={
            'edges_tried': (
                'too little traffic across the main road: {across} of {limit} tracks; {along} tracks follow one road, '
                'and the rotation about it is free: edges of vehicles do not determine it either',
                '',
            ),
            'turning': (
                '{along} tracks follow one road, and the rotation about it is free: no second road, and edges of '
                'vehicles do not determine it either',
                '',
            ),
            'paper': (
                'the orientation histogram of {segments} segments has {peaks} peaks, not two',
                'wait for traffic on a second road',
            ),
        },
    ),
    RefusalCode(
        code='grade_too_low',
        cause='Lens and ground plane are known, but lengths on the road are too uncertain. calibration.json holds the '
        'result as its candidate.',
        limit='gate.least_grade: fair (10 %) for what the node publishes, coarse (25 %) for a recording; one standard '
        'deviation of a length on the road 20 m ahead, along or across the view',
        remedy='{helpful}',
        missing='certainty of lengths on the road',
        message='the result is of grade {grade}, at least {least} is asked for: lengths on the road along the view '
        '± {along:.0%}, across it ± {across:.0%}',
        variants={
            'lens': (
                'the lens alone is known, and its focal length to {focal:±.1%} only (at most ± 10 % without a ground '
                'plane)',
                '{helpful}',
            ),
            'no_road_ahead': (
                'the result is of grade {grade}, at least {least} is asked for: the camera sees no road ahead of it, '
                'by which it could be graded',
                'turn the camera so that it sees the road ahead',
            ),
        },
    ),
    RefusalCode(
        code='plane_uncertain',
        cause='The ground normal is too uncertain, or two estimates of it disagree.',
        limit='gate.max_sigma_tilt_deg, 5 degrees (one sigma)',
        remedy='wait for more traffic on the quieter road',
        missing='a certain ground plane',
        message='ground normal ± {sigma_deg:.1f} degrees (at most {limit_deg:g} allowed)',
        variants={
            'level_road': (
                'the road runs level across the image, where the roll of the camera does not determine the plane',
                SECOND_ROAD,
            ),
            'edges_and_level': (
                'edges of vehicles and a level camera disagree by {difference_deg:.1f} degrees about the road',
                'set joint.roll_prior_deg to 0 to trust the edges'
                + OR
                + 'set it to the largest roll that the camera may have',
            ),
            'lane_changes': (
                'two estimates of the plane differ by {difference_deg:.1f} degrees (limit {limit_deg:.1f}): '
                '{assumed}; {changing}',
                'wait for more traffic, above all across the road or turning',
            ),
        },
    ),
    RefusalCode(
        code='no_markings',
        cause='Lane markings do not give a lens and a plane: there are too few, or they fit two planes, two focal '
        'lengths or no right angle. Reported inside the message of another code.',
        limit='at least 10 % of the lines along each of two directions, in 5 places; focal length within '
        'gate.max_sigma_focal_rel',
        remedy='wait for more traffic',
        missing='lane markings',
        message='lane markings do not determine lens and plane: {lines} lines',
        variants={
            'off_road': ('lane markings do not determine lens and plane: too few lines lie beside the traffic', ''),
            'two_planes': (
                'lane markings do not determine lens and plane: they fit two planes {difference_deg:.0f} degrees apart',
                '',
            ),
            'two_lenses': (
                'lane markings do not determine lens and plane: they fit two focal lengths, {focal_px:.0f} and '
                '{other_focal_px:.0f} px',
                '',
            ),
            'one_axis': (
                'lane markings do not determine lens and plane: {fraction:.0%} of the lines, in {places} places, lie '
                'along the second of two directions (at least {limit:.0%} in {limit_places} places needed)',
                '',
            ),
            'not_square': (
                'lane markings do not determine lens and plane: they cross at {angle_deg:.1f} degrees, not at a right '
                'angle',
                '',
            ),
            'focal_length': (
                'lane markings do not determine lens and plane: focal length {sigma:±.1%} (at most ± {limit:.0%} '
                'allowed)',
                '',
            ),
        },
    ),
    RefusalCode(
        code='markings_contradicted',
        cause='The plane from the lane markings contradicts the traffic.',
        limit='3 sigma or 1.5 degrees, whichever is larger',
        remedy='wait for more traffic; if the markings are not perpendicular, set joint.road_markings to false',
        missing='agreement of lane markings and traffic',
        message='ground normals from traffic and lane markings differ by {difference_deg:.1f} degrees '
        '({sigma_deg:.1f} expected)',
        variants={
            'road': (
                'the road of the traffic and the markings along it differ by {difference_deg:.1f} degrees '
                '({sigma_deg:.1f} expected)',
                '',
            )
        },
    ),
    RefusalCode(
        code='markings_unconfirmed',
        cause='Lane markings give a lens and a plane, but the traffic is too sparse to confirm them.',
        limit='4.5 degrees (one sigma) for the plane or the road from traffic',
        remedy='wait for more traffic, straight or turning',
        missing='traffic that confirms the lane markings',
        message='lane markings give a lens and a plane, but the traffic cannot confirm them: ground normal from '
        'traffic ± {sigma_deg:.0f} degrees (at most {limit_deg:g} allowed)',
        variants={
            'no_traffic': (
                'lane markings give a lens and a plane, but no traffic confirms them',
                '',
            )
        },
    ),
    RefusalCode(
        code='no_height',
        cause='No ground plane: the scale is unknown, because no camera height was given.',
        limit='camera_height above 0',
        remedy='give camera_height in metres'
        + OR
        + 'give a distance on the road or the mean traffic speed (scale_from)'
        + OR
        + 'set allow_unit_scale for a plane in units of the height',
        missing='a scale',
        message='the ground plane needs the height of the camera above the road, which was not given',
        variants={
            'no_dashes': (
                'the ground plane needs a scale: lane width or dash period are given, but no dashes of '
                'lane lines are seen that show such a period without doubt',
                'give camera_height in metres' + OR + 'give a distance on the road (scale.distances)',
            ),
            'no_lanes': (
                'the ground plane needs a scale: the width of the lanes is given, but neither dashes, lines nor rows '
                'of vehicles are seen that repeat across the road',
                'give camera_height in metres' + OR + 'give a distance on the road (scale.distances)',
            ),
        },
    ),
    RefusalCode(
        code='implausible',
        cause='Vehicles, speeds, lanes or dashes of lane lines are half as large again as usual ones, or more, or half '
        'as large: the scale, the focal length that is given or the plane is wrong.',
        limit='3.5 standard deviations of the usual size of vehicles (64 %), and 48 % beyond usual speeds, lanes and '
        'dashes',
        remedy='check the camera height, lengths and speed that are given, and the focal length',
        missing='usual sizes and speeds',
        message='{said}',
    ),
    RefusalCode(
        code='scale_off_road',
        cause='A pixel of scale.distance_px is not on the road, or the lens images nothing there.',
        limit='at least 1.7 degrees below the horizon (33 camera heights away)',
        remedy='choose two pixels on the road surface, near to the camera',
        missing='two pixels on the road',
        message='pixel ({u:g}, {v:g}) of scale.distance_px is not on the road: it lies {angle_deg:.1f} degrees {side} '
        'the horizon (at least {limit_deg:.1f} degrees below needed)',
        variants={
            'outside_lens': (
                'pixel ({u:g}, {v:g}) of scale.distance_px is not on the road: the lens images nothing there',
                '',
            )
        },
    ),
    RefusalCode(
        code='too_few_vehicles',
        cause='Too few vehicles drive straight along the busiest road to measure its mean speed, or lens and plane '
        'from a single road.',
        limit='10 vehicles for the speed, 8 for a single road',
        remedy=WAIT,
        missing='vehicles along the busiest road',
        message='{vehicles} vehicles drive straight along the busiest road (at least {limit} needed to compare their '
        'speed with the given mean)',
        variants={
            'single_road': (
                '{vehicles} vehicles follow the one straight road that was found (at least {limit} needed)',
                '',
            )
        },
    ),
    RefusalCode(
        code='scale_uncertain',
        cause='The camera height that follows from the given scale is too uncertain.',
        limit='gate.max_sigma_height_rel, 50 % (one sigma)',
        remedy='give a longer distance on the road nearer to the camera' + OR + 'give the camera height',
        missing='a certain scale',
        message='camera height {height_m:.2f} m, {sigma:±.0%} (at most ± {limit:.0%} allowed)',
    ),
    RefusalCode(
        code='vanishing_points_disagree',
        cause='Method paper only: no focal length makes the two vanishing points perpendicular.',
        limit='the focal length squared must be positive',
        remedy='the roads are not perpendicular, or the lens is wrong: use method joint',
        missing='perpendicular vanishing points',
        message='no focal length makes the two vanishing points perpendicular (orientations {first_deg:.0f} and '
        '{second_deg:.0f} degrees)',
    ),
    RefusalCode(
        code='distortion_model',
        cause='The distortion model that was asked for cannot represent the lens.',
        limit='0.5 px anywhere in the image',
        remedy='set distortion_model to one of the models that the message names; equidistant always fits',
        missing='the requested distortion model',
        message='{misfit}',
        variants={'misfit': ('{misfit}', '{instead}')},
    ),
)
"""Every refusal code."""

BY_CODE = {entry.code: entry for entry in REFUSALS}
