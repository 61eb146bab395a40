"""Control points on the command line: lengths for the solution before it, the place in the map after it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from autocalib_ros.results.calibration import Calibration, Refusal
    from autocalib_ros.results.control_points import ControlPoints, MapPlacement

MAP = 'map.json'
MAP_POINTS_SIGMA_M = 0.1
"""Standard deviation of a control point in the map, metres: orthophotos of 10 to 20 cm a pixel. Judgement."""


def distance_options(points: ControlPoints, given: dict[str, Any]) -> dict[str, Any]:
    """Return the options that give the lengths between control points, besides the lengths that are given."""
    texts = [str(given.get('scale.distances', ''))] if given.get('scale.distances') else []
    for one, other, metres in points.distances():
        (u1, v1), (u2, v2) = points.pixels[one], points.pixels[other]
        texts.append(f'{u1:g} {v1:g} {u2:g} {v2:g} {metres:.4f}')
    options: dict[str, Any] = {'scale.distances': '; '.join(texts)}
    if 'scale.distance_sigma_m' not in given:
        options['scale.distance_sigma_m'] = round(2**0.5 * MAP_POINTS_SIGMA_M, 4)
    return options


def place_result(result: Calibration | Refusal, points: ControlPoints) -> MapPlacement | None:
    """Return where the ground of a result, or of what a refusal found, lies in the map; None without a metric plane."""
    from autocalib_ros.ground import Ground
    from autocalib_ros.results.control_points import place_in_map

    found = result.candidate
    if found is None or found.ground is None or not found.ground.metric:
        return None
    return place_in_map(Ground.of(found).points(points.pixels).points_m[:, :2], points)


def placement_lines(placement: MapPlacement, points: ControlPoints) -> list[str]:
    """Return the place in the map, and how well the control points agree, for the terminal."""
    east_m, north_m = placement.translation_m
    lines = [
        f'In the map ({placement.crs}): the camera stands at {east_m:.2f}, {north_m:.2f} m; x points '
        f'{placement.heading_deg:.2f} degrees from east to north'
    ]
    if not placement.left_out_m:
        return [*lines, 'Two control points give scale and heading; a third one would check them.']
    worst = max(range(len(points.names)), key=placement.left_out_m.__getitem__)
    middle = sorted(placement.left_out_m)[len(placement.left_out_m) // 2]
    return [
        *lines,
        f'Control points, each left out in its turn: {middle:.2f} m off (median), at most '
        f"{placement.left_out_m[worst]:.2f} m (point '{points.names[worst]}'); the map is {placement.scale:.4f} times "
        'as large as the ground',
    ]


def write_map(out: Path, placement: MapPlacement, points: ControlPoints) -> str:
    """Write map.json into a folder; return its name."""
    from autocalib_ros.util.files import write_atomically

    write_atomically(out / MAP, json.dumps(placement.document(points), indent=1, allow_nan=False) + '\n')
    return MAP
