"""Straight edges on moving vehicles, and none on static objects next to them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy

from autocalib_ros.config import BufferOptions, Options
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import Edges
from autocalib_ros.perception.edges import MAX_EDGES_PER_REGION, MAX_REGIONS, EdgeFinder
from autocalib_ros.perception.motion_mask import Region
from autocalib_ros.perception.observer import Observer

SIZE = (360, 640)
CAR = (60, 90)
"""Height and width in pixels of a car whose windscreen leans by `LEAN_DEG`."""
LEAN_DEG = 12.0
SPEED_PX = 6.0


def scene(index: int) -> np.ndarray:
    """A car with a windscreen that moves to the right over a road with an oblique marking, grey uint8."""
    image = np.full(SIZE, 70, np.uint8)
    cv2.line(image, (0, 40), (640, 320), 230, 6)
    x, y = round(60 + SPEED_PX * index), 120
    cv2.rectangle(image, (x, y), (x + CAR[1], y + CAR[0]), 150, -1)
    lean = round(40 * np.tan(np.radians(LEAN_DEG)))
    glass = np.array([[x + 30, y + 10], [x + 60, y + 10], [x + 60 + lean, y + 50], [x + 30 + lean, y + 50]])
    cv2.fillPoly(image, [glass.astype(np.int32)], 20)
    return noisy(cv2.GaussianBlur(image, (0, 0), 0.7), 1.5, index)


def region(index: int, margin: int = 12) -> Region:
    """The car and a little of what is about it."""
    x, y = round(60 + SPEED_PX * index) - margin, 120 - margin
    return Region(x, y, np.full((CAR[0] + 2 * margin, CAR[1] + 2 * margin), 255, np.uint8))


def found(images: list[int]) -> np.ndarray:
    finder = EdgeFinder()
    for index in images[:-1]:
        finder.find(scene(index), [region(index)])
    edges, _ = finder.find(scene(images[-1]), [region(images[-1])])
    return edges


def orientation_deg(edges: np.ndarray) -> np.ndarray:
    """From the x axis, 0 to 180."""
    return np.degrees(np.arctan2(edges[:, 3] - edges[:, 1], edges[:, 2] - edges[:, 0])) % 180


def test_the_edges_of_a_windscreen_are_found_where_they_are() -> None:
    edges = found([0, 4, 8])
    x = 60 + SPEED_PX * 8
    oblique = edges[np.abs(orientation_deg(edges) - (90 - LEAN_DEG)) < 3]
    assert len(oblique) >= 2  # its front and its rear
    middles = (oblique[:, :2] + oblique[:, 2:]) / 2
    lean = 20 * np.tan(np.radians(LEAN_DEG))
    nearest = np.min(np.abs(middles[:, :1] - [x + 30 + lean, x + 60 + lean]), axis=1)
    assert np.median(nearest) < 2.0  # px


def test_a_marking_beside_the_car_is_no_edge_of_it() -> None:
    # at image 24 the marking shows in the region of the car
    edges = found([16, 20, 24])
    marking = np.degrees(np.arctan2(280, 640))
    along = np.abs(orientation_deg(edges) - marking) < 4
    middles = (edges[:, :2] + edges[:, 2:]) / 2
    on_marking = np.abs(middles[:, 1] - (40 + middles[:, 0] * 280 / 640)) < 8
    assert len(edges) > 3 and not (along & on_marking).any()
    # and it would have been found: the first image is not there to compare with
    lone = EdgeFinder()
    lone.find(np.zeros(SIZE, np.uint8), [])
    seen, _ = lone.find(scene(24), [region(24)])
    assert (np.abs(orientation_deg(seen) - marking) < 4).any()


def test_the_first_image_has_nothing_to_compare_with() -> None:
    assert len(found([5])) == 0


def test_regions_and_edges_of_one_image_are_bounded() -> None:
    generator, finder = np.random.default_rng(0), EdgeFinder()
    lines = np.full((720, 1280), 128, np.uint8)
    for _ in range(1500):
        start = generator.integers(0, (1280, 720))
        angle = generator.uniform(0, np.pi)
        end = start + 40 * np.array([np.cos(angle), np.sin(angle)])
        cv2.line(lines, start.tolist(), end.astype(int).tolist(), int(generator.integers(256)), 2)
    regions = [Region(60 * index, 100, np.full((500, 300), 255, np.uint8)) for index in range(16)]
    finder.find(np.full((720, 1280), 128, np.uint8), [])
    edges, labels = finder.find(lines, regions)
    assert 0 < len(edges) <= MAX_REGIONS * MAX_EDGES_PER_REGION
    assert np.bincount(labels).max() <= MAX_EDGES_PER_REGION and labels.max() < MAX_REGIONS


@pytest.mark.parametrize('width', [1280, 320])
def test_edges_reach_the_evidence_with_their_vehicle_in_full_pixels(width: int) -> None:
    observer, buffer = Observer(Options(max_image_width=width), (SIZE[1], SIZE[0])), EvidenceBuffer(BufferOptions())
    still = scene(10_000)
    for index in range(70):
        observed = observer.observe(still if index < 12 else scene(index - 12), 0.1 * index)
        if observed.edges is not None:
            buffer.add_edges(observed.edges)
    evidence = buffer.snapshot(
        image_size=(SIZE[1], SIZE[0]),
        first_stamp_ns=0,
        newest_stamp_ns=7_000_000_000,
        frames=70,
        drift_px=0.0,
        unfinished=observer.unfinished(),
    )
    assert len(evidence.edges_px) > 10
    middles = (evidence.edges_px[:, :2] + evidence.edges_px[:, 2:]) / 2
    x = 60 + SPEED_PX * (evidence.edge_times_s / 0.1 - 12)
    inside = (middles[:, 0] > x - 8) & (middles[:, 0] < x + CAR[1] + 8) & (np.abs(middles[:, 1] - 150) < 38)
    assert inside.mean() > 0.9
    assert set(evidence.edge_vehicles[inside]) & set(evidence.track_vehicles)


def test_the_buffer_keeps_no_more_edges_than_allowed() -> None:
    buffer = EvidenceBuffer(BufferOptions(max_edges=100))
    for index in range(50):
        buffer.add_edges(Edges(float(index), np.arange(30), np.ones((30, 4))))
    evidence = buffer.snapshot(
        image_size=(640, 360), first_stamp_ns=0, newest_stamp_ns=1, frames=1, drift_px=0.0, unfinished=[]
    )
    assert 80 < len(evidence.edges_px) <= 100 and evidence.edge_times_s.max() == 49.0
