"""Lines through edges: where they are drawn, to hundredths of a pixel, whatever segment they began with."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_pictures import noisy
from scipy.special import ndtr

from autocalib_ros.perception.edge_fit import EDGE_REACH_PX, fit_edges
from autocalib_ros.perception.line_segments import LineSegmentDetector

SIZE = 200
BLUR_PX = 0.8
"""Standard deviation of the blur of the lens."""
NOISE_LEVELS = 3.0


def soft_step(depth_px: np.ndarray) -> np.ndarray:
    """Share of white at a depth inside of a straight edge, as a camera with a soft lens sees it."""
    return np.asarray(ndtr(depth_px / BLUR_PX))


def pixels() -> np.ndarray:
    """Centres of the pixels, (SIZE, SIZE, 2)."""
    return np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1).astype(float)


def painted(share: np.ndarray) -> np.ndarray:
    """The image uint8 (SIZE, SIZE) of white paint, of which each pixel has a share, on a grey road."""
    return np.round(90.0 + 110.0 * np.clip(share, 0.0, 1.0)).astype(np.uint8)


def drawn(bands: list[np.ndarray]) -> np.ndarray:
    """White rectangles with corners (4, 2) on a grey road, uint8 (SIZE, SIZE); exact but for their corners."""
    share = np.zeros((SIZE, SIZE))
    for corners in bands:
        along = np.roll(corners, -1, axis=0) - corners
        inward = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
        depths = [(pixels() - corner) @ normal for corner, normal in zip(corners, inward, strict=True)]
        share += np.prod([soft_step(depth) for depth in depths], axis=0)
    return painted(share)


def band(centre: tuple[float, float], angle_deg: float, width: float, length: float = 120.0) -> np.ndarray:
    """Corners (4, 2) of a painted line; its upper edge, at small angles, is from the first to the second."""
    along = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    across = np.array([-along[1], along[0]])
    ends = np.array([-0.5, 0.5, 0.5, -0.5])[:, None] * length * along
    return np.array(centre) + ends + np.array([-0.5, -0.5, 0.5, 0.5])[:, None] * width * across


def off_px(line: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Signed distances (2,) of the ends of a line (4,) from the line through an edge (2, 2), pixels."""
    along = (edge[1] - edge[0]) / np.hypot(*(edge[1] - edge[0]))
    return (line.reshape(2, 2) - edge[0]) @ np.array([-along[1], along[0]])


def inner(edge: np.ndarray, share: float = 0.8) -> np.ndarray:
    """The middle part of an edge (2, 2) as a segment (4,)."""
    middle = edge.mean(axis=0)
    return (middle + share * (edge - middle)).reshape(4)


@pytest.mark.parametrize('angle_deg', [0.0, 7.0, 38.0, 90.0, 131.0])
@pytest.mark.parametrize('width', [5.0, 40.0])
def test_a_segment_beside_an_edge_moves_on_to_it(angle_deg: float, width: float) -> None:
    corners = band((100.3, 98.6), angle_deg, width)
    image = noisy(drawn([corners]), NOISE_LEVELS, 1)
    for edge in (corners[:2], corners[2:]):
        begun = inner(edge)
        normal = np.array([-(edge[1] - edge[0])[1], (edge[1] - edge[0])[0]]) / np.hypot(*(edge[1] - edge[0]))
        begun[:2] += 0.7 * normal
        begun[2:] -= 0.4 * normal
        assert np.abs(off_px(begun, edge)).max() > 0.6
        assert np.abs(off_px(fit_edges(begun[None], image)[0], edge)).max() < 0.06


def test_it_keeps_its_place_along_the_edge() -> None:
    corners = band((100.0, 100.0), 20.0, 30.0)
    begun = inner(corners[:2], 0.5)[None]
    fitted = fit_edges(begun, drawn([corners]))
    along = (corners[1] - corners[0]) / 120.0
    np.testing.assert_allclose((fitted - begun).reshape(2, 2) @ along, 0.0, atol=0.02)


def test_something_that_hides_a_third_of_the_edge_does_not_move_it() -> None:
    corners = band((100.0, 100.0), 10.0, 40.0)
    image = drawn([corners])
    image[60:110, 110:145] = 235  # a vehicle, with edges of its own
    fitted = fit_edges(inner(corners[:2], 0.95)[None], noisy(image, NOISE_LEVELS, 2))
    assert np.abs(off_px(fitted[0], corners[:2])).max() < 0.1


def test_a_chord_of_an_arc_has_the_direction_of_the_arc_at_its_middle() -> None:
    radius = 500.0
    distance = np.hypot(*(pixels() - [100.0, 90.0 + radius]).transpose(2, 0, 1))
    image = painted(soft_step(radius - distance))
    begun = np.array([[70.0, 91.0, 150.0, 92.5]])
    x0, y0, x1, y1 = fit_edges(begun, noisy(image, NOISE_LEVELS, 3))[0]
    centre = 0.5 * (x0 + x1) - 100.0
    assert np.arctan2(y1 - y0, x1 - x0) == pytest.approx(np.arcsin(centre / radius), abs=np.radians(0.08))


@pytest.mark.parametrize('level', [0, 90, 255])
def test_without_an_edge_a_segment_stays(level: int) -> None:
    begun = np.array([[20.0, 30.0, 90.0, 41.0]])
    np.testing.assert_array_equal(fit_edges(begun, np.full((SIZE, SIZE), level, np.uint8)), begun)


def test_noise_alone_moves_a_segment_by_less_than_the_reach_and_gives_numbers() -> None:
    begun = np.random.default_rng(4).uniform(-5.0, SIZE + 5.0, (300, 4))
    fitted = fit_edges(begun, noisy(np.full((SIZE, SIZE), 90, np.uint8), 8.0, 5))
    assert np.isfinite(fitted).all()
    assert np.median(np.abs(fitted - begun)) < 0.5 * EDGE_REACH_PX


def test_no_segment_is_no_error() -> None:
    assert fit_edges(np.zeros((0, 4)), np.zeros((SIZE, SIZE), np.uint8)).shape == (0, 4)


def test_images_of_one_scene_give_the_same_lines() -> None:
    bands = [band((50.0 + 32.0 * n, 100.0), 80.0 + 9.0 * n, 9.0) for n in range(4)]
    clean = drawn(bands)
    edges = np.array([corners[pair] for corners in bands for pair in ([0, 1], [2, 3])])
    finder, found = LineSegmentDetector(None), []
    for seed in range(6):
        finder.find(noisy(clean, NOISE_LEVELS, seed), (float(seed),))
        off = np.array([[np.abs(off_px(line, edge)).max() for edge in edges] for line in finder.lines_px])
        long = np.hypot(*(finder.lines_px[:, 2:] - finder.lines_px[:, :2]).T) > 60
        assert len(long) and off[long].min(axis=1).max() < 0.1
        found.append(long.sum())
    assert min(found) >= 6
