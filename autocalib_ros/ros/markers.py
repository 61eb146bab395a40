"""`~/markers`: ground grid, field of view and uncertainty in the ground frame, for RViz and Foxglove."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from autocalib_ros.geometry.ground_plane import GroundPlane
from autocalib_ros.pictures.road import ErrorEllipse, GroundGrid, enlargement, error_ellipses, view_frustum
from autocalib_ros.pictures.views import format_length
from autocalib_ros.results.calibration import Calibration
from autocalib_ros.ros.log_text import describe_numbers

LINE_WIDTH_HEIGHTS = 0.005
"""Line width in camera heights."""
LETTER_HEIGHT_HEIGHTS = 0.06
"""Letter height in camera heights."""
LIFT_HEIGHTS = 0.003
"""Height of the ellipses above the grid in camera heights: in one plane both would flicker."""
GRID_COLOUR, FIELD_OF_VIEW_COLOUR, UNCERTAINTY_COLOUR, TEXT_COLOUR = (
    (0.8, 0.8, 0.8, 0.6),
    (1.0, 0.88, 0.3, 1.0),
    (1.0, 0.48, 0.84, 1.0),
    (1.0, 1.0, 1.0, 1.0),
)
"""Colours: red, green, blue, opacity."""


def no_markers() -> MarkerArray:
    """Return the message that deletes all markers."""
    return MarkerArray(markers=[Marker(action=Marker.DELETEALL)])


def markers(result: Calibration, ground_frame: str) -> MarkerArray:
    """Return the markers of a calibration, which replace all earlier ones; without a ground plane none.

    Their stamp is zero, which RViz takes as "now", so they stay until replaced.
    """
    camera, ground = result.camera, result.ground
    if ground is None:
        return no_markers()
    shown, unit_m = error_ellipses(result), ground.height_m
    grid = GroundGrid.of(camera, ground)
    made = (
        []
        if grid is None
        else [_lines('grid', [line[[0, -1]] for line in grid.lines_m], GRID_COLOUR, 0.5 * LINE_WIDTH_HEIGHTS * unit_m)]
    )
    made.append(
        _lines('field_of_view', view_frustum(camera, ground), FIELD_OF_VIEW_COLOUR, LINE_WIDTH_HEIGHTS * unit_m)
    )
    made += _uncertainty(shown, unit_m)
    place = ground.translation_m + np.array([0, 0, 0.5 * unit_m])
    made.append(_text('state', 0, _words(result, ground, grid, shown), place, unit_m))
    for marker in made:
        marker.header = Header(frame_id=ground_frame)
        marker.frame_locked = True
    return MarkerArray(markers=[*no_markers().markers, *made])


def _uncertainty(shown: Sequence[ErrorEllipse], unit_m: float) -> Iterator[Marker]:
    """Yield an ellipse with its text for each distance."""
    factor = enlargement(list(shown))
    for number, ellipse in enumerate(shown):
        outline = np.pad(ellipse.outline(factor), ((0, 0), (0, 1)), constant_values=LIFT_HEIGHTS * unit_m)
        marker = _marker('uncertainty', number, Marker.LINE_STRIP, UNCERTAINTY_COLOUR)
        marker.scale.x = 2 * LINE_WIDTH_HEIGHTS * unit_m
        marker.points = _points(outline)
        yield marker
        place = np.array([*ellipse.centre_m, LETTER_HEIGHT_HEIGHTS * unit_m])
        yield _text(
            'uncertainty_text', number, f'{ellipse.distance_m:g} m: sigma {ellipse.sigma_m:.2g} m', place, unit_m
        )


def _words(result: Calibration, ground: GroundPlane, grid: GroundGrid | None, shown: Sequence[ErrorEllipse]) -> str:
    lines = [f'grade {result.grade}', *describe_numbers(result)]
    if grid is not None:
        lines.append(f'squares of {format_length(grid.step_m, ground)}')
    factor = enlargement(list(shown))
    if shown:
        lines.append('ellipses: one sigma of a road point' + (f', enlarged {factor} times' if factor > 1 else ''))
    return '\n'.join(lines)


def _lines(namespace: str, lines: Sequence[np.ndarray], colour: tuple[float, ...], width_m: float) -> Marker:
    """Return polylines (n, 3) as one marker."""
    marker = _marker(namespace, 0, Marker.LINE_LIST, colour)
    marker.scale.x = float(width_m)
    pairs = [np.stack([line[:-1], line[1:]], axis=1).reshape(-1, 3) for line in lines]
    marker.points = _points(np.concatenate(pairs)) if pairs else []
    return marker


def _text(namespace: str, number: int, text: str, place_m: np.ndarray, unit_m: float) -> Marker:
    marker = _marker(namespace, number, Marker.TEXT_VIEW_FACING, TEXT_COLOUR)
    marker.scale.z = float(LETTER_HEIGHT_HEIGHTS * unit_m)
    marker.pose.position = _points(place_m[None])[0]
    marker.text = text
    return marker


def _marker(namespace: str, number: int, kind: int, colour: tuple[float, ...]) -> Marker:
    red, green, blue, opacity = colour
    marker = Marker(
        ns=namespace, id=number, type=kind, action=Marker.ADD, color=ColorRGBA(r=red, g=green, b=blue, a=opacity)
    )
    marker.pose.orientation.w = 1.0
    return marker


def _points(points_m: np.ndarray) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in points_m.tolist()]
