"""HTML report: the page with embedded figures, and the figures as PNG files."""

from __future__ import annotations

import base64
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from autocalib_ros.errors import InputError
from autocalib_ros.report import (
    direction_figures,
    lens_figures,
    residual_figures,
    road_figures,
    settling_figures,
    sketch_figures,
    speed_figures,
    traffic_figures,
)
from autocalib_ros.report.canvas import STYLE, jpeg, png, render_bgr
from autocalib_ros.report.figure_process import FigureProcess
from autocalib_ros.report.next_command import next_command
from autocalib_ros.report.rendering import render_page, template_text
from autocalib_ros.report.requirements import needs
from autocalib_ros.report.ruler import ruler_data
from autocalib_ros.report.scene import ReportScene
from autocalib_ros.report.text import (
    contradictions,
    file_rows,
    headline,
    history_rows,
    how_sure,
    measured,
    move_rows,
    next_step,
    number_rows,
)
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.verification_table import summarise_verification
from autocalib_ros.util.files import NOT_FOR_OTHERS, write_atomically, write_picture_bytes

JPEG_SAVES = 1.5
"""Least saving in size for which a figure is embedded as JPEG: diagrams are sharper as PNG and hardly larger."""
CHAPTERS = FOUND, ROAD, TRAFFIC, LENS, DIRECTIONS, TIME = (
    'What was found so far',
    'Ground plane',
    'Traffic',
    'Lens',
    'Directions',
    'Convergence',
)


@dataclass(frozen=True)
class _Entry:
    """Figure of the report: file name, chapter, title, caption and drawing function."""

    name: str
    chapter: str
    title: str
    caption: str
    draw: Callable[[ReportScene], Figure | None]
    wide: bool = True
    more: Callable[[ReportScene], str] | None = None
    """Returns text about the scene that is appended to the caption."""


ENTRIES = (
    _Entry(
        'roads_so_far',
        FOUND,
        'Roads so far',
        'Trajectories coloured by the straight road that they follow, and where these roads vanish. A sketch, which is'
        ' not used.',
        sketch_figures.roads_so_far,
        more=sketch_figures.sketch_note,
    ),
    _Entry(
        'ground_grid',
        ROAD,
        'Ground grid in the image',
        'Squares of equal size on the ground plane, distorted by the lens. They should lie flat on the road and run'
        ' along its markings. The origin of x and y is the point of the road below the camera.',
        road_figures.ground_grid,
    ),
    _Entry(
        'top_view',
        ROAD,
        'Top view of the road',
        'The image projected to the ground plane. Lanes should be straight and of constant width; check known'
        ' lengths, such as lane markings, against the scale bar. Objects above the road are stretched away from the'
        ' camera.',
        road_figures.top_view,
        more=road_figures.accuracy_note,
    ),
    _Entry(
        'speeds',
        ROAD,
        'Trajectories on the ground',
        'Trajectories on the ground plane, coloured by speed. Without braking, the speed along a lane should be'
        ' constant: if all vehicles seem to slow down or speed up with distance, the estimated plane is tilted.',
        speed_figures.speeds_above,
        wide=False,
        more=speed_figures.speed_note,
    ),
    _Entry(
        'speed_histogram',
        ROAD,
        'Speeds',
        'Check these against the usual speeds of this road: they are proportional to the scale. Weighted by'
        ' distance, so stopped vehicles do not count. Trajectories on no road belong to turning vehicles, cyclists'
        ' or pedestrians.',
        speed_figures.speed_histogram,
        wide=False,
    ),
    _Entry(
        'all_tracks',
        TRAFFIC,
        'All trajectories',
        'All tracked points, over the background image.',
        traffic_figures.all_tracks,
    ),
    _Entry(
        'kept_tracks',
        TRAFFIC,
        'Kept trajectories',
        'Coloured by road direction. Rejected trajectories turn, change lanes or are tracking errors; those not used'
        ' are short or redundant. Turning vehicles are used as rigid bodies moving in the plane, shown by their'
        ' points.',
        traffic_figures.kept_tracks,
    ),
    _Entry(
        'coverage',
        TRAFFIC,
        'Coverage of the image',
        'Trajectories per image cell. The lens is determined best where there was traffic, especially near the'
        ' borders.',
        traffic_figures.coverage,
        more=traffic_figures.coverage_note,
    ),
    _Entry(
        'undistorted',
        LENS,
        'Undistorted image',
        'The image without lens distortion. Kerbs, lane markings and trajectories should be straight.',
        lens_figures.undistorted,
    ),
    _Entry(
        'straightness',
        LENS,
        'Straightness before and after',
        'One dot per kept trajectory: the farther below the diagonal, the more undistortion has straightened it.',
        lens_figures.straightness,
        wide=False,
    ),
    _Entry(
        'focal_sweep',
        LENS,
        'Straightness error against focal length',
        'Straightness error of the trajectories kept by the published method (Jain and Saunier) for each trial focal'
        ' length. A sharp minimum means a well-constrained estimate; a flat curve, that straightness alone does not'
        ' determine the focal length.',
        lens_figures.focal_sweep,
        wide=False,
    ),
    _Entry(
        'residuals',
        LENS,
        'Residuals',
        'Distances between observed and predicted points, pixels of the original image. Tracking is accurate to'
        ' about half a pixel, and drivers swerve.',
        residual_figures.residuals,
        wide=False,
    ),
    _Entry(
        'residual_map',
        LENS,
        'Residuals over the image',
        'Median residual per image cell. Near the camera, swerving causes large residuals; large ones at a border or'
        ' a corner elsewhere show where the lens model does not fit.',
        residual_figures.residual_map,
    ),
    _Entry(
        'orientation_histogram',
        DIRECTIONS,
        'Orientation of motion',
        'Motion segments by orientation in the undistorted image. The two peaks are the clusters from which the'
        ' published method starts; in perspective, one road covers many orientations.',
        direction_figures.orientation_histogram,
        wide=False,
    ),
    _Entry(
        'clusters',
        DIRECTIONS,
        'The two clusters',
        'Motion segments of the two clusters in the undistorted image.',
        direction_figures.clusters,
    ),
    _Entry(
        'directions',
        DIRECTIONS,
        'Horizon and vanishing points',
        'Parallel lines on the road meet in its vanishing points, which lie on the horizon. Both are drawn with lens'
        ' distortion, also outside the image.',
        direction_figures.directions,
    ),
    _Entry(
        'still_lines',
        DIRECTIONS,
        'Lines of the scene',
        'Lines of the background, coloured by the direction of the road along which the result sees them: lane'
        ' markings and kerbs along it, stop lines across it, posts upright.',
        sketch_figures.still_lines,
        more=sketch_figures.still_lines_note,
    ),
    _Entry(
        'settling',
        TIME,
        'Focal length and tilt over time',
        'Intermediate solutions over time. About two thirds of the later ones should lie within the one-sigma bars'
        ' of an earlier one.',
        settling_figures.settling,
        wide=False,
    ),
)


@dataclass(frozen=True)
class DrawnFigure:
    """Figure of the report, encoded."""

    index: int
    """Of its entry in `ENTRIES`."""
    caption: str
    png: bytes
    shown: bytes
    """Embedded image: JPEG if it is smaller by `JPEG_SAVES`, else PNG."""

    @property
    def entry(self) -> _Entry:
        """Its entry."""
        return ENTRIES[self.index]

    @property
    def kind(self) -> str:
        """Format of the embedded image."""
        return 'png' if self.shown == self.png else 'jpeg'

    @property
    def data(self) -> str:
        """The embedded image in base64."""
        return base64.b64encode(self.shown).decode()


def write_report(
    path: Path, scene: ReportScene, figures: Path | None = None, process: FigureProcess | None = None
) -> None:
    """Write the page to `path` and its figures into a folder, default `figures` next to it; replace earlier figures.

    A second `process` that was started draws its part of the figures. InputError if that fails.
    """
    folder = figures or path.parent / 'figures'
    _clear(folder)  # fail early if the folder is not writable: drawing takes seconds
    drawn = _draw_all(scene, process or FigureProcess())
    _write_figures(folder, {one.entry.name: one.png for one in drawn})
    write_atomically(path, _page(scene, drawn), NOT_FOR_OTHERS)


def _draw_all(scene: ReportScene, process: FigureProcess) -> list[DrawnFigure]:
    """Draw the figures here from the first one on, those that the process begins from the last one there."""
    process.begin(draw_entry, scene, len(ENTRIES))
    drawn: dict[int, Future[DrawnFigure | None]] = {}
    with ThreadPoolExecutor(1, thread_name_prefix='encoder') as encoder:
        # OpenCV encodes without Python's lock, while Matplotlib draws the next figure
        for index in range(len(ENTRIES)):
            if process.leaves(index):
                drawn[index] = encoder.submit(_encoded, index, *_drawn(index, scene))
    figures = [
        drawn[index].result() if index in drawn else _from(process, index, scene) for index in range(len(ENTRIES))
    ]
    return [figure for figure in figures if figure is not None]


def _from(process: FigureProcess, index: int, scene: ReportScene) -> DrawnFigure | None:
    """Return the figure that the process draws; it is drawn here if that has died."""
    try:
        found: DrawnFigure | None = process.result(index)
    except BrokenProcessPool:
        found = draw_entry(index, scene)
    return found


def draw_entry(index: int, scene: ReportScene) -> DrawnFigure | None:
    """Draw and encode the figure of an entry; None if it has nothing to show."""
    return _encoded(index, *_drawn(index, scene))


def _drawn(index: int, scene: ReportScene) -> tuple[str, np.ndarray | None]:
    """Return the caption of an entry and its figure as BGR image; None if it has nothing to show."""
    entry = ENTRIES[index]
    with rc_context(STYLE):
        figure = entry.draw(scene)
        if figure is None:
            return '', None
        caption = ' '.join(filter(None, [entry.caption, entry.more(scene) if entry.more else '']))
        return caption, render_bgr(figure)


def _encoded(index: int, caption: str, picture: np.ndarray | None) -> DrawnFigure | None:
    if picture is None:
        return None
    whole, photograph = png(picture), jpeg(picture)
    return DrawnFigure(index, caption, whole, photograph if JPEG_SAVES * len(photograph) < len(whole) else whole)


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
            write_picture_bytes(folder / f'{name}.png', data)
    except OSError as error:
        raise InputError(f'cannot write {folder}: {error.strerror or error}') from error


def _page(scene: ReportScene, drawn: list[DrawnFigure]) -> str:
    result, found = scene.result, scene.calibration
    chapters = [(chapter, [one for one in drawn if one.entry.chapter == chapter]) for chapter in CHAPTERS]
    return render_page(
        'report.html.j2',
        verdict=headline(result),
        measured=measured(result),
        state=_state(result),
        source=scene.source,
        how_sure=how_sure(result),
        contradictions=contradictions(result),
        next_step=next_step(result),
        command=next_command(result, scene.options, scene.folder),
        truth=scene.truth,
        code=_code(result),
        needs=needs(result, scene.evidence, scene.options.gate),
        rows=[
            *number_rows(result, scene.accepted_at_s),
            *file_rows(result, scene.evidence),
            *move_rows(scene.moves),
            *history_rows(scene.history),
        ],
        assumptions=tuple(map(str, found.assumptions)) if found else (),
        checks=tuple(map(str, found.checks)) if found else (),
        verification=found.verification if found else (),
        passed=summarise_verification(found.verification) if found else '',
        all_passed=all(row.passed for row in found.verification) if found else True,
        chapters=[(chapter, figures) for chapter, figures in chapters if figures],
        ruler=ruler_data(scene),
        ruler_script=template_text('ruler.js'),
    )


def _state(result: Calibration | Refusal) -> str:
    if isinstance(result, Refusal):
        return 'refused'
    return 'calibrated' if result.grade == 'full' and result.method != 'paper' else 'partial'


def _code(result: Calibration | Refusal) -> str:
    refusal = result if isinstance(result, Refusal) else result.ground_refusal
    return '' if refusal is None else refusal.code
