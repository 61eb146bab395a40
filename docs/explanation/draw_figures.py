"""Draw the figures of these pages: python docs/explanation/draw_figures.py."""

import csv
from pathlib import Path

import matplotlib

matplotlib.use('Agg')
import matplotlib.pyplot as plt
import numpy as np

FOLDER = Path(__file__).parent
HISTORY = FOLDER.parents[1] / 'benchmarks' / 'history.csv'
WIDTH, HEIGHT, FOCAL = 1280, 720, 560.0
TILT = np.radians(28.0)
CAMERA_HEIGHT = 8.0
HEADING = np.radians(35.0)
GREY, ROADS = '#888888', ('#1f6fb2', '#c2571a')


def project(points: np.ndarray) -> np.ndarray:
    """Return pixels (n, 2) of ground points (n, 3) in an equidistant camera; nan outside the image."""
    ahead = np.array([np.cos(TILT), 0.0, -np.sin(TILT)])
    right = np.array([0.0, -1.0, 0.0])
    rays = (points - [0.0, 0.0, CAMERA_HEIGHT]) @ np.column_stack([right, np.cross(ahead, right), ahead])
    across = np.hypot(rays[:, 0], rays[:, 1])
    scale = FOCAL * np.arctan2(across, rays[:, 2]) / np.maximum(across, 1e-9)
    pixels = rays[:, :2] * scale[:, None] + [WIDTH / 2, HEIGHT / 2]
    inside = (pixels > 0).all(axis=1) & (pixels < [WIDTH, HEIGHT]).all(axis=1) & (rays[:, 2] > -0.5)
    return np.where(inside[:, None], pixels, np.nan)


def lines(heading: float) -> list[np.ndarray]:
    """Return straight paths (n, 3) along a heading on the road."""
    along = np.linspace(-150.0, 150.0, 600)
    direction, side = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    centre = np.array([16.0, 0.0])
    return [
        np.column_stack([centre + along[:, None] * direction + offset * side, np.zeros(600)])
        for offset in (-5.0, -1.7, 1.7, 5.0)
    ]


def straight() -> None:
    """Draw tracks of two roads in a wide-angle image: curves that meet in one vanishing point a road."""
    figure, axes = plt.subplots(figsize=(7.2, 4.05))
    headings = HEADING, HEADING - np.pi / 2
    for name, colour, heading in zip(('road 1', 'road 2'), ROADS, headings, strict=True):
        for number, path in enumerate(lines(heading)):
            axes.plot(*project(path).T, color=colour, linewidth=1.5, label=name if number == 0 else None)
        for side in (1.0, -1.0):
            end = project(1e5 * side * np.array([[np.cos(heading), np.sin(heading), 0.0]]))[0]
            axes.plot(*end, 'o', color=colour, markersize=7)
    azimuth = np.linspace(-np.pi / 2, np.pi / 2, 300)
    horizon = project(1e5 * np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(300)]))
    axes.plot(*horizon.T, '--', color=GREY, linewidth=1.0, label='horizon')
    axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0), aspect='equal', xticks=[], yticks=[])
    axes.legend(loc='lower left', fontsize=9)
    save(figure, 'straight.svg')


def turning() -> None:
    """Draw a vehicle from above at two instants: one turn about the normal, one translation in the plane."""
    figure, axes = plt.subplots(figsize=(7.2, 3.2))
    outline = np.array([[-2.2, -0.9], [2.2, -0.9], [2.2, 0.9], [-2.2, 0.9], [-2.2, -0.9]])
    points = np.array([[-1.8, 0.7], [0.2, -0.8], [1.9, 0.6], [1.2, -0.2], [-0.9, 0.1]])
    turn, shift = np.radians(35.0), np.array([8.5, 2.6])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    for name, colour, place in (
        ('first frame', ROADS[0], lambda xy: xy),
        ('second frame', ROADS[1], lambda xy: xy @ rotation.T + shift),
    ):
        axes.plot(*place(outline).T, color=colour, linewidth=1.5, label=name)
        axes.plot(*place(points).T, 'o', color=colour, markersize=5)
    for one, other in zip(points, points @ rotation.T + shift, strict=True):
        axes.plot(*np.column_stack([one, other]), ':', color=GREY, linewidth=1.0)
    axes.annotate('', shift, (0.0, 0.0), arrowprops={'arrowstyle': '->', 'color': 'black'})
    axes.text(4.0, 1.6, 't', fontsize=13)
    axes.plot([shift[0], shift[0] + 3.4], [shift[1], shift[1]], color=GREY, linewidth=0.8)
    axes.plot(*(shift[:, None] + np.outer(rotation[:, 0], [0.0, 3.4])), color=GREY, linewidth=0.8)
    axes.text(shift[0] + 2.7, shift[1] + 0.5, r'$\psi$', fontsize=13)
    axes.set(aspect='equal', xticks=[], yticks=[], xlim=(-3.5, 13.0), ylim=(-1.8, 5.4))
    axes.legend(loc='upper left', fontsize=9)
    save(figure, 'turning.svg')


def loss() -> None:
    """Draw the robust loss and its weight."""
    figure, axes = plt.subplots(figsize=(7.2, 2.6))
    squared = np.linspace(0.0, 10.0, 200)
    axes.plot(squared, squared, '--', color=GREY, label='least squares')
    axes.plot(squared, squared / (1 + squared), color=ROADS[0], label=r'loss $\rho(s)$, $c = 1$')
    axes.plot(squared, 1 / (1 + squared) ** 2, color=ROADS[1], label=r"weight $\rho'(s)$")
    axes.set(xlim=(0, 10), ylim=(0, 2), xlabel='mean squared whitened distance s, in medians')
    axes.legend(fontsize=9)
    save(figure, 'loss.svg')


def grades() -> None:
    """Draw the grades of single roads by tilt and by the angle between road and view.

    From grades.csv, columns of `autocalib benchmark accuracy --family single_road --out`, where the candidate of a
    refusal has its grade too.
    """
    figure, axes = plt.subplots(figsize=(7.2, 3.6))
    with (FOLDER / 'grades.csv').open(encoding='utf-8') as stream:
        draws = list(csv.DictReader(stream))
    kinds = {'full': ('full', 'fair'), 'coarse': ('coarse',), 'less, or no result': ('assumed', 'lens', '')}
    marks = {'full': ('o', ROADS[0], 'full or fair'), 'coarse': ('s', ROADS[1], 'coarse')}
    for kind, of_kind in kinds.items():
        mark, colour, label = marks.get(kind, ('x', GREY, kind))
        of_this = [draw for draw in draws if draw['grade'] in of_kind]
        places = np.array([[float(draw['road_yaw_deg']), float(draw['true_tilt_deg'])] for draw in of_this])
        axes.plot(*places.reshape(-1, 2).T, mark, color=colour, markersize=6, label=f'{label}: {len(of_this)}')
    axes.set(xlim=(0, 90), ylim=(0, 48), xlabel='angle between road and view, degrees', ylabel='tilt, degrees')
    axes.legend(loc='upper right', fontsize=9)
    save(figure, 'grades.svg')


def cost() -> None:
    """Draw the history of cost and accuracy, from the rows of `autocalib benchmark cost --history`, by commit."""
    with HISTORY.open(encoding='utf-8') as stream:
        rows = list(csv.DictReader(stream))
    commits = list(dict.fromkeys(row['commit'] for row in rows))
    recordings = list(dict.fromkeys((row['recording'], row['size']) for row in rows))
    figure, panels = plt.subplots(1, 3, figsize=(9.6, 3.4))
    for axes, column, label in (
        (panels[0], 'image_ratio', 'image, in bare optical flows'),
        (panels[1], 'solution_s', 'solution, seconds'),
        (panels[2], 'focal_error_percent', 'error of the focal length, %'),
    ):
        for recording in recordings:
            own = [row for row in rows if (row['recording'], row['size']) == recording and row[column]]
            places = [commits.index(row['commit']) for row in own]
            name = f'{recording[0].split("/")[0]}, {recording[1]}'
            axes.plot(places, [float(row[column]) for row in own], 'o-', markersize=4, linewidth=1.0, label=name)
        axes.set(title=label, xticks=range(len(commits)))
        axes.title.set_fontsize(9)
        axes.set_xticklabels(commits, rotation=60, ha='right', fontsize=7)
        axes.axhline(0.0, color=GREY, linewidth=0.6)
    panels[0].legend(fontsize=7)
    save(figure, 'cost.svg')


def save(figure: plt.Figure, name: str) -> None:
    """Write a figure without a date, so that it changes only when it is drawn differently."""
    figure.tight_layout()
    figure.savefig(FOLDER / name, metadata={'Date': None}, facecolor='white')
    plt.close(figure)


if __name__ == '__main__':
    plt.rcParams['svg.hashsalt'] = 'autocalib_ros'
    straight()
    turning()
    loss()
    grades()
    cost()
