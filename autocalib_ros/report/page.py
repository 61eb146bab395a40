"""The page with its figures inside and beside it."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, StrictUndefined
from matplotlib import rc_context
from matplotlib.figure import Figure

from autocalib_ros import __version__
from autocalib_ros.errors import InputError
from autocalib_ros.report import (
    direction_figures,
    lens_figures,
    residual_figures,
    road_figures,
    settling_figures,
    speed_figures,
    traffic_figures,
)
from autocalib_ros.report.canvas import STYLE, jpeg, png, render_bgr
from autocalib_ros.report.scene import ReportScene
from autocalib_ros.report.text import file_rows, how_sure, needs, next_step, number_rows, verdict
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.util.files import write_atomically

JPEG_SAVES = 1.5
"""A diagram is sharper as PNG, and hardly larger."""
CHAPTERS = ROAD, TRAFFIC, LENS, DIRECTIONS, TIME = (
    'Where the road lies',
    'What was seen',
    'The lens',
    'Directions',
    'How it settled',
)


@dataclass(frozen=True)
class _Entry:
    """A figure of the report: its file's name, chapter, heading, what to look for in it, and how it is drawn."""

    name: str
    chapter: str
    title: str
    caption: str
    draw: Callable[[ReportScene], Figure | None]
    wide: bool = True
    more: Callable[[ReportScene], str] | None = None
    """What depends on the scene is said after the caption."""


ENTRIES = (
    _Entry(
        'ground_grid',
        ROAD,
        'The ground in the image',
        'Equal squares on the road, bent by the lens as the road is. They should lie flat on the road and run along'
        ' its markings. x and y are measured from the point of the road below the camera.',
        road_figures.ground_grid,
    ),
    _Entry(
        'top_view',
        ROAD,
        'The road from above',
        'The image spread out on the ground plane. Lanes should be straight and of even width; known lengths, such'
        ' as lane markings, can be checked against the scale. What stands above the road is drawn out, away from'
        ' the camera.',
        road_figures.top_view,
        more=road_figures.accuracy_note,
    ),
    _Entry(
        'speeds',
        ROAD,
        'Vehicles in metres',
        'The trajectories on the ground plane, coloured by speed. Where nobody brakes one lane should have one speed'
        ' along its whole way: if all seem to slow down or to speed up with the distance, the plane is tilted.',
        speed_figures.speeds_above,
        wide=False,
        more=speed_figures.speed_note,
    ),
    _Entry(
        'speed_histogram',
        ROAD,
        'Speeds',
        'Are these the speeds of this road? They grow and shrink with what was given as the scale. Each metre of the'
        ' way counts alike, so that waiting does not count; who follows no road turns, cycles or walks.',
        speed_figures.speed_histogram,
        wide=False,
    ),
    _Entry(
        'all_tracks',
        TRAFFIC,
        'All trajectories',
        'Every point that was followed, over the road without its traffic.',
        traffic_figures.all_tracks,
    ),
    _Entry(
        'kept_tracks',
        TRAFFIC,
        'Kept trajectories',
        'Coloured by the road that they were found to follow. Rejected ones turn, change lanes or were followed'
        ' wrongly; those not used are short, or say what others say already. Vehicles that turn count by their'
        ' points, as bodies that move in the plane.',
        traffic_figures.kept_tracks,
    ),
    _Entry(
        'coverage',
        TRAFFIC,
        'Coverage of the image',
        'Where trajectories crossed the image. A lens is best known where traffic was, above all near the borders.',
        traffic_figures.coverage,
        more=traffic_figures.coverage_note,
    ),
    _Entry(
        'undistorted',
        LENS,
        'Undistorted image',
        'The image as a lens without distortion would show it. Kerbs, lane markings and the trajectories should be'
        ' straight.',
        lens_figures.undistorted,
    ),
    _Entry(
        'straightness',
        LENS,
        'Straightness before and after',
        'Each kept trajectory is a dot: the farther below the line, the more undistortion has straightened it.',
        lens_figures.straightness,
        wide=False,
    ),
    _Entry(
        'focal_sweep',
        LENS,
        'Focal length against error',
        'How crooked the few trajectories that the published method (Jain and Saunier) keeps remain for each trial'
        ' focal length. A clear valley is a sure result; without one, straightness alone does not tell.',
        lens_figures.focal_sweep,
        wide=False,
    ),
    _Entry(
        'residuals',
        LENS,
        'Residuals',
        'How far the points that the solution rests on are from where it has them, in pixels of the image as it was'
        ' observed. Points cannot be followed much better than to half a pixel, and drivers swerve.',
        residual_figures.residuals,
        wide=False,
    ),
    _Entry(
        'residual_map',
        LENS,
        'Residuals over the image',
        'The same by place. Near the camera a swerve is many pixels; elsewhere, a border or a corner that stands out'
        ' is where the lens is not what the model says.',
        residual_figures.residual_map,
    ),
    _Entry(
        'orientation_histogram',
        DIRECTIONS,
        'Orientation of motion',
        'Short pieces of motion by their direction in the undistorted image. The two peaks are the clusters that the'
        ' published method starts from; in perspective one road covers many orientations.',
        direction_figures.orientation_histogram,
        wide=False,
    ),
    _Entry(
        'clusters',
        DIRECTIONS,
        'The two clusters',
        'Where those pieces of motion are, in the undistorted image.',
        direction_figures.clusters,
    ),
    _Entry(
        'directions',
        DIRECTIONS,
        'Horizon and vanishing points',
        'Lines that are parallel on the road meet in its vanishing points; all of these lie on the horizon. Both are'
        ' drawn as this lens shows them, beyond the borders of the image too.',
        direction_figures.directions,
    ),
    _Entry(
        'settling',
        TIME,
        'Focal length and tilt over time',
        'What the solutions that were tried on the way said. Two in three of the later ones should lie within the'
        ' bars of an earlier one.',
        settling_figures.settling,
        wide=False,
    ),
)


@dataclass(frozen=True)
class _Drawn:
    entry: _Entry
    caption: str
    png: bytes
    shown: bytes
    """What the page holds: JPEG where that is smaller by `JPEG_SAVES`."""

    @property
    def kind(self) -> str:
        return 'png' if self.shown is self.png else 'jpeg'

    @property
    def data(self) -> str:
        return base64.b64encode(self.shown).decode()


def write_report(path: Path, scene: ReportScene, figures: Path | None = None) -> None:
    """Write the page to `path` and its figures into a folder, `figures` beside it; earlier ones there are removed."""
    folder = figures or path.parent / 'figures'
    _clear(folder)  # before seconds of drawing: it may not be possible to write there
    with rc_context(STYLE):
        drawn = [one for entry in ENTRIES if (one := _drawn(entry, scene)) is not None]
    _write_figures(folder, {one.entry.name: one.png for one in drawn})
    write_atomically(path, _page(scene, drawn))


def _drawn(entry: _Entry, scene: ReportScene) -> _Drawn | None:
    figure = entry.draw(scene)
    if figure is None:
        return None
    picture = render_bgr(figure)
    whole = png(picture)
    caption = ' '.join(filter(None, [entry.caption, entry.more(scene) if entry.more else '']))
    photograph = jpeg(picture)
    return _Drawn(entry, caption, whole, photograph if JPEG_SAVES * len(photograph) < len(whole) else whole)


def _clear(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for entry in ENTRIES:
            (folder / f'{entry.name}.png').unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f'cannot write {folder}: {error.strerror or error}') from error


def _write_figures(folder: Path, pictures: dict[str, bytes]) -> None:
    try:
        for name, data in pictures.items():
            (folder / f'{name}.png').write_bytes(data)
    except OSError as error:
        raise InputError(f'cannot write {folder}: {error.strerror or error}') from error


def _page(scene: ReportScene, drawn: list[_Drawn]) -> str:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(
        (files('autocalib_ros.report') / 'templates' / 'report.html.j2').read_text(encoding='utf-8')
    )
    result = scene.result
    chapters = [(chapter, [one for one in drawn if one.entry.chapter == chapter]) for chapter in CHAPTERS]
    return template.render(
        verdict=verdict(result),
        state=_state(result),
        source=scene.source,
        version=__version__,
        how_sure=how_sure(result),
        next_step=next_step(result),
        code=_code(result),
        needs=needs(result, scene.evidence, scene.options.gate),
        rows=[*number_rows(result, scene.accepted_at_s), *file_rows(result, scene.evidence)],
        assumptions=tuple(map(str, result.assumptions)) if isinstance(result, Calibration) else (),
        checks=tuple(map(str, result.checks)) if isinstance(result, Calibration) else (),
        chapters=[(chapter, figures) for chapter, figures in chapters if figures],
    )


def _state(result: Calibration | Refusal) -> str:
    if isinstance(result, Refusal):
        return 'refused'
    return 'calibrated' if result.grade == 'full' and result.method != 'paper' else 'partial'


def _code(result: Calibration | Refusal) -> str:
    refusal = result if isinstance(result, Refusal) else result.ground_refusal
    return '' if refusal is None else refusal.code
