"""Assumptions and checks of a calibration as values: a kind and its numbers. All of them are worded here.

A statement is made by `assumption` or `check`, which take the kind and the numbers that its text needs. Programs read
the kind and the numbers; logs, the report and the terminal print the text.
"""

from __future__ import annotations

import string
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

Value = float | int | str | bool | None
"""What a statement may hold: everything that JSON can say in one item."""


UNDETERMINED = 9.99
"""Relative standard deviation from which a number is not determined, not even to a factor of ten; larger ones and
infinity are stated as this one, since JSON has no infinity."""


class _Words(string.Formatter):
    """Templates of str.format in which a standard deviation may have the form '±.1%': '± 12.3%' or 'not determined'."""

    def format_field(self, value: object, format_spec: str) -> str:
        if not format_spec.startswith('±'):
            return str(super().format_field(value, format_spec))
        undetermined = isinstance(value, (int, float)) and value >= UNDETERMINED
        return 'not determined' if undetermined else f'± {super().format_field(value, format_spec[1:])}'


def in_words(template: str, values: Mapping[str, object]) -> str:
    """Return a template filled with values."""
    return _Words().vformat(template, (), values)


@dataclass(frozen=True)
class Statement:
    """One assumption or one check."""

    kind: str
    """Key of `ASSUMPTIONS` or `CHECKS`; `UNKNOWN_KIND` for a text from a file of an older version."""
    text: str
    """The statement in words, with its numbers."""
    values: Mapping[str, Value] = field(default_factory=dict)
    """The numbers and names in the text, by their names in the table."""

    def __str__(self) -> str:
        return self.text


UNKNOWN_KIND = 'unknown'


def assumption(kind: str, **values: object) -> Statement:
    """Return an assumption of `ASSUMPTIONS` with its numbers."""
    return _worded(ASSUMPTIONS, kind, values)


def check(kind: str, **values: object) -> Statement:
    """Return a check of `CHECKS` with its numbers."""
    return _worded(CHECKS, kind, values)


def plain_values(values: Mapping[str, object]) -> dict[str, Value]:
    """Return numbers as Python's own, so that they can be compared and written as JSON."""
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}  # type: ignore[misc]


def _worded(table: Mapping[str, Wording], kind: str, values: Mapping[str, object]) -> Statement:
    plain = plain_values(values)
    wording = table[kind]
    text = in_words(wording, plain) if isinstance(wording, str) else wording(**plain)
    return Statement(kind, text, plain)


Wording = str | Callable[..., str]
"""A template for str.format, or a function, of the values."""

FAMILY_NAMES = {
    'equidistant': ('lens near equidistant', '0'),
    'distortion_free': ('lens without distortion', '1/3'),
    'kannala_brandt': ('lens between equidistant and distortion-free', '1/6'),
}
"""Name of each lens family in a sentence, and its k1 (Kannala & Brandt 2006)."""


def plus_minus(sigma: float | None, form: str = 'g') -> str:
    """Return ' ± sigma', '' for an exact value."""
    return f' ± {sigma:{form}}' if sigma else ''


def _lens_family(family: str, k1_sigma: float) -> str:
    name, k1 = FAMILY_NAMES[family]
    return f'{name}: k1 = {k1} ± {k1_sigma:.3g}'


def _principal_point(
    sigma_px: float, sigma_down_px: float | None = None, picture: str | None = None, covered: bool = False
) -> str:
    where = 'the image centre' if picture is None or covered else f'the centre of the picture ({picture})'
    if covered:
        where += f', of which bars cover a part (seen: {picture}),'
    if sigma_down_px is not None:
        return f'principal point at {where} ± {sigma_px:.0f} px across and {sigma_down_px:.0f} px down'
    return f'principal point at {where}' + (f' ± {sigma_px:.0f} px' if sigma_px > 0 else '')


def _focal_given(focal_px: float, sigma_px: float) -> str:
    return f'focal length {focal_px:g}{plus_minus(sigma_px)} px (given)'


def _halves(focal: float, normal_deg: float | None) -> str:
    normal = '' if normal_deg is None else f' and {normal_deg:.1f} degrees in ground normal'
    return f'earlier and later half of the traffic differ by {focal:.1%} in focal length{normal}'


def _lane_markings_difference(focal: float, normal_deg: float, used: bool) -> str:
    difference = f'{focal:.1%} in focal length and {normal_deg:.1f} degrees in ground normal'
    contradiction = '' if used else ': a contradiction, which lowers the grade'
    return f'lane markings differ from the traffic by {difference}{contradiction}'


def _crossing_angle(angle_deg: float, sigma_deg: float | None, source: str) -> str:
    if source == 'given':
        return f'roads cross at {angle_deg:g} degrees (given)'
    measured = f'{angle_deg:.1f} ± {sigma_deg:.1f} degrees'
    return (
        f'roads cross at {measured}'
        if source == 'measured'
        else f'roads cross at 90 ± 1 degrees (measured: {measured})'
    )


def _transverse_edges(vehicles: int, sigma_deg: float, level_sigma_deg: float | None) -> str:
    level = '' if level_sigma_deg is None else f' and of a level camera (roll 0 ± {level_sigma_deg:g} degrees)'
    return f'plane across one road from edges of {vehicles} vehicles{level}: ± {sigma_deg:.1f} degrees about the road'


def _height_note(height_m: float | None, height_sigma_m: float | None) -> str:
    if height_m is None:
        return ''
    return f': camera height {height_m:.3f}{plus_minus(height_sigma_m, ".2g")} m'


def _scale_height(given_m: float, given_sigma_m: float, **_: object) -> str:
    return f'scale from the camera height of {given_m:g}{plus_minus(given_sigma_m)} m (given)'


def _scale_distance(
    distance_m: float,
    distance_sigma_m: float,
    pixel_sigma_px: float,
    pixels: str,
    height_m: float | None = None,
    height_sigma_m: float | None = None,
) -> str:
    return (
        f'scale from {distance_m:g} ± {distance_sigma_m:g} m on the road between the pixels {pixels}, each '
        f'± {pixel_sigma_px:g} px (given){_height_note(height_m, height_sigma_m)}'
    )


def _scale_speed(
    speed_km_h: float,
    speed_sigma_km_h: float,
    vehicles: int,
    variation: float,
    point_height_m: float,
    point_height_sigma_m: float,
    height_m: float | None = None,
    height_sigma_m: float | None = None,
) -> str:
    return (
        f'scale from a mean speed of {speed_km_h:g} ± {speed_sigma_km_h:g} km/h (given) of {vehicles} vehicles on the '
        f'busiest road (their speeds vary by {variation:.0%}), tracked {point_height_m:g} ± '
        f'{point_height_sigma_m:g} m above it{_height_note(height_m, height_sigma_m)}'
    )


def _told(source: str) -> str:
    return source if source == 'given' else f'standard of {source}'


def _scale_lanes(
    width_m: float,
    width_sigma_m: float,
    places: int,
    source: str,
    height_m: float | None = None,
    height_sigma_m: float | None = None,
    of: str = '',
) -> str:
    seen = f'by {places} {"bars of lines" if of == "lines" else of}' if of else f'seen in {places} places'
    return (
        f'scale from lanes {width_m:g} ± {width_sigma_m:.2g} m wide ({_told(source)}), {seen}'
        f'{_height_note(height_m, height_sigma_m)}'
    )


def _scale_dashes(
    period_m: float,
    period_sigma_m: float,
    spacings: int,
    source: str,
    height_m: float | None = None,
    height_sigma_m: float | None = None,
) -> str:
    return (
        f'scale from dashes of lane lines every {period_m:g} ± {period_sigma_m:.2g} m ({_told(source)}), {spacings} '
        f'spacings seen{_height_note(height_m, height_sigma_m)}'
    )


def _vehicle_size(
    vehicles: int,
    ratio: float,
    height_m: float,
    usual_height_m: float,
    usual_height_sigma_m: float,
    width_m: float | None = None,
    usual_width_m: float | None = None,
) -> str:
    cars = '' if width_m is None else f' (cars {width_m:.2g} m wide, {usual_width_m:g} m is usual)'
    return (
        f'{vehicles} vehicles are {ratio:.2f} times as large as usual at a camera height of {height_m:.3g} m{cars}; '
        f'{usual_height_m:.3g} ± {usual_height_sigma_m:.2g} m would make them usual'
    )


def _lane_dashes(
    period: float, spacings: int, width: float | None, dash: float | None = None, rival: float | None = None
) -> str:
    long = '' if dash is None else f', dashes {dash:.2f} long'
    lanes = '' if width is None else f', between lanes {width:.2f} camera heights wide'
    others = '' if rival is None else f'; those of other lines every {rival:.2f}, so that a told period may be either'
    return f'dashes of lane lines repeat every {period:.2f} camera heights ({spacings} spacings{long}){lanes}{others}'


def _scale_vehicles(
    vehicles: int, car_m: float, sigma: float, height_m: float | None = None, height_sigma_m: float | None = None
) -> str:
    return (
        f'scale from the size of {vehicles} vehicles, as no length is given: cars {car_m:g} m wide in the mean, '
        f'± {sigma:.0%}{_height_note(height_m, height_sigma_m)}'
    )


def _still_part(start_s: float, end_s: float, recorded_s: float, cuts: int, zooms: int, moves: int) -> str:
    counts = ((cuts, 'cuts to another view'), (zooms, 'zooms'), (moves, 'motions of the camera'))
    changes = ', '.join(f'{what}: {count}' for count, what in counts if count)
    return (
        f'only the part from {start_s:.1f} to {end_s:.1f} s of {recorded_s:.1f} s was used, in which the view stands '
        f'still; left out: the rest' + (f' ({changes})' if changes else '')
    )


def _pixel_aspect(aspect: float, source: str) -> str:
    return f'pixels {aspect:.4g} times as wide as high ({"given" if source == "given" else "the recording says so"})'


ASSUMPTIONS: dict[str, Wording] = {
    'lens_given': 'the lens is given: only the pose was estimated',
    'lens_family': _lens_family,
    'lens_barrel': 'lens from equidistant (k1 = 0) to distortion-free (1/3), by how much straight traffic curves: k1 = '
    '{k1:.2f} ± {sigma:.2f}',
    'field_of_view': 'field of view across the image {view_deg:.0f} degrees (focal length ± {sigma:.0%}): usual '
    'ones are {usual_deg:.0f} degrees within a factor of {factor:.2f}',
    'principal_point': _principal_point,
    'cut_picture': 'a picture that was cut off or zoomed: its optical axis is {right_px:+.0f} ± {sigma_px:.1f} px to '
    'the right of the centre and {down_px:+.0f} ± {sigma_down_px:.1f} px below it, by the traffic',
    'focal_given': _focal_given,
    'view_given': 'field of view across the image {view_deg:g} ± {sigma_deg:.2g} degrees (given)',
    'pixel_aspect': _pixel_aspect,
    'squeezed_pixels': 'pixels {aspect:.4g} times as wide as high, a picture of {shape}: the traffic measures '
    '{measured:.3f} ± {sigma:.3f} (log odds {log_odds:.0f} against square pixels)',
    'nearly_square_pixels': 'pixels {aspect:.4f} ± {sigma:.4f} times as wide as high: {width}x{height} may be a '
    'picture of another size, squeezed',
    'parameter_fixed': '{parameter} fixed at its prior: the traffic does not determine it',
    'crossing_angle': _crossing_angle,
    'level_camera': 'plane across one road from a level camera: roll = 0 ± {sigma_deg:g} degrees',
    'transverse_edges': _transverse_edges,
    'lane_changes': 'plane across one road from {vehicles} vehicles that change lanes: ± {sigma_deg:.1f} degrees '
    'about the road',
    'steady_speed': 'traffic keeps its speed from near to far: that of {vehicles} vehicles changes by 0 ± {sigma:.0%} '
    'over 2.7 times the distance',
    'lane_markings': '{lines} lane markings in {places} places taken as parallel or perpendicular: 90 ± {sigma_deg:g} '
    'degrees (measured: {angle_deg:.1f})',
    'scale_height': _scale_height,
    'scale_distance': _scale_distance,
    'scale_speed': _scale_speed,
    'scale_lanes': _scale_lanes,
    'scale_dashes': _scale_dashes,
    'scale_vehicles': _scale_vehicles,
    'scale_combined': 'scale from {sources} measures together: camera height {height_m:.3f} ± {height_sigma_m:.2g} m',
    'mended_pose': 'pose turned with the camera, by what the picture shows: pan {pan_deg:+.2f}, tilt {tilt_deg:+.2f}, '
    'roll {roll_deg:+.2f} degrees (± {sigma_deg:.2f})',
    'shifted_camera': 'the camera was shifted as well: what is near turned by {parallax_deg:.2f} degrees more than '
    'what is far; its height and place are off by the shift, which is not measured',
    'paper_lens': 'equidistant lens with the principal point at the centre of the picture',
    'paper_roads': 'the two roads are perpendicular',
    'paper_uncertainty': 'the published method gives no uncertainty',
}
"""Wording of every assumption, by its kind."""

SCALE_KINDS = (
    'scale_height',
    'scale_distance',
    'scale_speed',
    'scale_lanes',
    'scale_dashes',
    'scale_vehicles',
    'scale_combined',
)
"""Kinds that say where the scale comes from: one, or several and that of their combination."""

CHECKS: dict[str, Wording] = {
    'sway': 'the camera sways by {sway_px:.1f} px about its rest position (95 % of the images): compensated',
    'still_part': _still_part,
    'crossing_angle': _crossing_angle,
    'turning_vehicles': '{vehicles} turning vehicles move as rigid bodies in the plane',
    'single_road': 'one road, which {following:.0%} of the vehicles follow: {edges} vehicle edges and {lines} still '
    'lines along, across and upright to it',
    'halves': _halves,
    'halves_not_compared': 'not cross-validated in time: the earlier or the later half has too little traffic',
    'edges_and_level': 'edges of vehicles and a level camera differ by {difference_deg:.1f} degrees about the road',
    'lane_changes': '{vehicles} vehicles that change lanes (± {sigma_deg:.1f} degrees about the road) differ by '
    '{difference_deg:.1f} degrees from the assumed plane',
    'vehicle_size': _vehicle_size,
    'usual_speed': 'at this scale half of the vehicles drive faster than {speed_km_h:.0f} km/h; up to {usual_km_h:.0f} '
    'km/h are usual: the scale or the focal length is wrong',
    'usual_lanes': 'at this scale lanes are {width_m:.2g} m wide; {low_m:.3g} to {high_m:.3g} m are usual',
    'usual_dashes': 'at this scale dashes of lane lines repeat every {period_m:.3g} m; {low_m:.3g} to {high_m:.3g} m '
    'are usual: the scale or the focal length is wrong',
    'known_lengths': '{first} means a camera height of {first_m:.3g} ± {first_sigma_m:.2g} m, {second} one of '
    '{second_m:.3g} ± {second_sigma_m:.2g} m: they differ by {sigmas:.1f} standard deviations of what the traffic '
    'leaves open',
    'lane_dashes': _lane_dashes,
    'lane_spacing': '{places} {of} along the road repeat across it every {width:.2f} camera heights',
    'lane_markings': _lane_markings_difference,
    'markings_and_traffic_normal': 'ground normals from traffic and lane markings differ by {difference_deg:.1f} '
    'degrees ({sigma_deg:.1f} expected)',
    'markings_and_traffic_road': 'road of the traffic and the markings along it differ by {difference_deg:.1f} degrees '
    '({sigma_deg:.1f} expected)',
    'given_focal': 'the road alone shows a focal length of {road_px:.0f} ± {road_sigma_px:.0f} px; {given_px:.0f} px '
    'are given, and believed with a probability of {believed:.0%}',
    'given_lens': 'traffic gives a focal length of {traffic_px:.1f} ± {sigma_px:.1f} px, the given lens has '
    '{given_px:.1f} px',
    'pixel_aspect': 'traffic measures pixels {measured:.3f} ± {sigma:.3f} times as wide as high, '
    '{sigmas:.1f} sigma from square: standard deviations cover {aspect:.3g}',
    'pedestrians_kept': 'pedestrian tracks kept in the plane estimate; without them: {without}',
    'distortion_model': 'camera_info uses {model}: at most {error_px:.2g} px off anywhere in the image',
}
"""Wording of every check, by its kind."""
