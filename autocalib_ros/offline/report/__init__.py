"""report.html: one page that a stranger understands, with its figures inside and beside it."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure

from autocalib_ros import __version__
from autocalib_ros.calibration import Calibration, Refusal
from autocalib_ros.errors import InputError
from autocalib_ros.files import write_atomically
from autocalib_ros.offline.replay import ReplayResult
from autocalib_ros.offline.report import lens_figures, road_figures, traffic_figures
from autocalib_ros.offline.report.canvas import Scene, png
from autocalib_ros.offline.summary import number_rows, remedy, verdict


@dataclass(frozen=True)
class _Entry:
    """A figure of the report: its file's name, its heading, what to look for in it, and how it is drawn."""

    name: str
    title: str
    caption: str
    draw: Callable[[Scene], Figure | None]


ENTRIES = (
    _Entry('ground_grid', 'The ground in the image',
           'A grid of equal squares on the road, bent by the lens as the road is. It should lie flat on the road'
           ' and run along its markings.', road_figures.ground_grid),
    _Entry('top_view', 'The road from above',
           'The image spread out on the ground plane. Lanes should be straight and of even width; known lengths,'
           ' such as lane markings, can be checked against the scale.', road_figures.top_view),
    _Entry('all_tracks', 'All trajectories',
           'Where traffic was seen: every point that was followed, over the road without its traffic.',
           traffic_figures.all_tracks),
    _Entry('kept_tracks', 'Kept trajectories',
           'Coloured by the road direction they were found to follow; turning and stray ones are rejected.',
           traffic_figures.kept_tracks),
    _Entry('undistorted', 'Undistorted image',
           'The image as a lens without distortion would show it. Kerbs, lane markings and the trajectories should'
           ' be straight.', lens_figures.undistorted),
    _Entry('straightness', 'Straightness before and after',
           'Each kept trajectory is a dot: the farther below the line, the more undistortion has straightened it.',
           lens_figures.straightness),
    _Entry('focal_sweep', 'Focal length against error',
           'How crooked the few trajectories that the published method keeps remain for each trial focal length.'
           ' A clear valley is a sure result; without one, straightness alone does not tell.',
           lens_figures.focal_sweep),
    _Entry('orientation_histogram', 'Orientation of motion',
           'The directions of short pieces of motion in the image; the peaks are the road directions that the'
           ' published method starts from.', traffic_figures.orientation_histogram),
    _Entry('directions', 'Horizon and vanishing directions',
           'Lines that are parallel on the road meet in its vanishing points; all of these lie on the horizon.',
           road_figures.directions),
)


def write_report(path: Path, replayed: ReplayResult, source_name: str) -> None:
    """Write the page to `path` and its figures into `figures` beside it; those of an earlier run are removed."""
    scene = Scene(replayed.result, replayed.evidence, replayed.background)
    drawn = [(entry, png(figure)) for entry in ENTRIES if (figure := entry.draw(scene)) is not None]
    _write_figures(path.parent / 'figures', {entry.name: data for entry, data in drawn})
    write_atomically(path, _page(replayed, source_name, drawn))


def _write_figures(folder: Path, pictures: dict[str, bytes]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for entry in ENTRIES:
            (folder / f'{entry.name}.png').unlink(missing_ok=True)
        for name, data in pictures.items():
            (folder / f'{name}.png').write_bytes(data)
    except OSError as error:
        raise InputError(f'cannot write {folder}: {error.strerror or error}') from error


def _page(replayed: ReplayResult, source_name: str, drawn: list[tuple[_Entry, bytes]]) -> str:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(
        (files('autocalib_ros.offline') / 'templates' / 'report.html.j2').read_text(encoding='utf-8'))
    result = replayed.result
    return template.render(
        verdict=verdict(result), state=_state(result), method=result.method, source=source_name, version=__version__,
        rows=number_rows(result, replayed.accepted_at_s), remedy=remedy(result), code=_code(result),
        assumptions=result.assumptions if isinstance(result, Calibration) else (),
        checks=result.checks if isinstance(result, Calibration) else (),
        figures=[{'name': entry.name, 'title': entry.title, 'caption': entry.caption,
                  'data': base64.b64encode(data).decode()} for entry, data in drawn])


def _state(result: Calibration | Refusal) -> str:
    if isinstance(result, Refusal):
        return 'refused'
    return 'calibrated' if result.grade == 'full' else 'partial'


def _code(result: Calibration | Refusal) -> str:
    refusal = result if isinstance(result, Refusal) else result.ground_refusal
    return '' if refusal is None else refusal.code
