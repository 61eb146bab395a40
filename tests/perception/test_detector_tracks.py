"""Vehicles by a detector: who is who from one detection to the next, what moves, and who is on foot."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawn_pictures import noisy, paste

from autocalib_ros.calibrator import AutoCalibrator
from autocalib_ros.config import DetectorOptions, Options
from autocalib_ros.evidence.snapshot import Track, TrackKind
from autocalib_ros.perception.detector.detector import Detections
from autocalib_ros.perception.detector_tracks import DetectorTracks
from autocalib_ros.perception.klt_tracker import PointTracker
from autocalib_ros.perception.motion_mask import Region
from autocalib_ros.perception.observer import Observer

pytestmark = pytest.mark.render

SIZE = (360, 640)
RATE_HZ = 10.0
CAR = (50, 80)
"""Height and width."""


def texture(seed: int, shape: tuple[int, int], sigma: float = 1.5) -> np.ndarray:
    smooth = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, shape), (0, 0), sigma)
    return np.clip(128 + 60 * smooth / smooth.std(), 0, 255)


ROAD = texture(0, SIZE) * 0.5 + 40
LOOKS = [texture(seed, CAR) for seed in range(1, 5)]


class World:
    """Boxes that move, drawn, and a detector that knows where they are; `people` and `missed` are indices."""

    def __init__(
        self,
        starts: list[tuple[float, float]],
        speeds: list[float],
        people: tuple[int, ...] = (),
        missed: tuple[int, ...] = (),
    ) -> None:
        self.starts, self.speeds, self.people, self.missed = starts, speeds, people, missed
        self.time_s, self.calls = 0.0, 0

    def at(self, time_s: float) -> np.ndarray:
        """Corners (n, 2), left and top."""
        return np.array([(x + speed * time_s, y) for (x, y), speed in zip(self.starts, self.speeds, strict=True)])

    def image(self, time_s: float) -> np.ndarray:
        """Draw all, grey uint8; nothing is there before the road has been learned."""
        self.time_s = time_s
        image = ROAD.copy()
        for look, (x, y) in zip(LOOKS, self.at(time_s), strict=False):
            paste(image, look, x, y)
        return noisy(image, 1.5, int(time_s * 1000))

    def detect(self, image: np.ndarray) -> Detections:
        """Return all boxes, in pixels of the image given."""
        self.calls += 1
        scale = image.shape[1] / SIZE[1]
        corners = self.at(self.time_s)
        edges = np.hstack([corners + 0.5, corners + 0.5 + CAR[::-1]]) * scale
        seen = np.array([index not in self.missed for index in range(len(edges))], bool)
        return Detections(
            edges[seen],
            np.full(seen.sum(), 0.9),
            np.array([index in self.people for index in range(len(edges))], bool)[seen],
        )


def watched(
    world: World, seconds: float, scale: int = 1, missed_between: tuple[float, float] = (9e9, 9e9)
) -> tuple[list[Track], list, list]:
    """All tracks, segments and edges of a world; the road is empty for the first two seconds."""
    observer = Observer(Options(max_image_width=SIZE[1]), (SIZE[1] * scale, SIZE[0] * scale), world)
    tracks, segments, edges = [], [], []
    for index in range(int(RATE_HZ * (2 + seconds))):
        time_s = index / RATE_HZ
        image = world.image(time_s - 2.0) if time_s >= 2 else noisy(ROAD, 1.5, index)
        world.missed = (0,) if missed_between[0] <= time_s - 2 < missed_between[1] else ()
        if scale > 1:
            image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
        observed = observer.observe(image, time_s)
        tracks += observed.tracks
        segments += [observed.segments] if observed.segments else []
        edges += [observed.edges] if observed.edges else []
    return [*tracks, *observer.unfinished()], segments, edges


def owners(tracks: list[Track], row: float) -> set[int]:
    """Vehicles of the tracks that began on the car whose top is at a row."""
    return {track.vehicle for track in tracks if row <= track.points_px[0, 1] < row + CAR[0]}


def test_two_cars_side_by_side_are_two_vehicles() -> None:
    touching = World([(20, 100), (20, 100 + CAR[0])], [40.0, 40.0])
    tracks, _, _ = watched(touching, 5.0)
    upper, lower = owners(tracks, 100), owners(tracks, 100 + CAR[0])
    assert len(upper) == len(lower) == 1 and upper != lower
    assert len(tracks) > 20


def test_a_vehicle_that_the_detector_misses_for_a_while_stays_the_same() -> None:
    tracks, _, _ = watched(World([(20, 100), (500, 250)], [40.0, -40.0]), 5.0, missed_between=(2.0, 4.0))
    assert len(owners(tracks, 100)) == 1 and not owners(tracks, 100) & owners(tracks, 250)


def test_a_parked_car_starts_no_tracks() -> None:
    tracks, segments, edges = watched(World([(20, 100), (300, 250)], [40.0, 0.0]), 5.0)
    assert owners(tracks, 100)
    # the parked car differs from the empty road at first; points that start there are static and yield no track
    assert not owners(tracks, 250)
    for lines in (*segments, *edges):
        assert not ((lines.ends_px[:, 1] > 250) & (lines.time_s > 3.5)).any()


def test_people_are_classified_and_yield_neither_segments_nor_edges() -> None:
    tracks, segments, edges = watched(World([(20, 100), (500, 250)], [40.0, -40.0], people=(1,)), 5.0)
    kinds = {track.kind for track in tracks if track.vehicle in owners(tracks, 250)}
    assert kinds == {TrackKind.PERSON}
    assert {track.kind for track in tracks if track.vehicle in owners(tracks, 100)} == {TrackKind.VEHICLE}
    ends = np.concatenate([lines.ends_px for lines in (*segments, *edges)])
    assert len(ends) > 50 and (ends[:, 1] < 170).all()


def test_boxes_of_a_wide_image_are_those_of_the_tracked_one() -> None:
    tracks, _, _ = watched(World([(20, 100), (500, 250)], [40.0, -40.0]), 4.0, scale=2)
    upper, lower = owners(tracks, 200) | owners(tracks, 250), owners(tracks, 500) | owners(tracks, 550)
    assert len(upper) == len(lower) == 1 and upper != lower


@pytest.mark.parametrize('rate_hz', [5.0, 15.0, 30.0, 60.0])
def test_detections_come_by_time_and_not_by_count(rate_hz: float) -> None:
    world = World([(20, 100)], [40.0])
    vehicles, tracker = DetectorTracks(world, DetectorOptions(every_s=0.2)), PointTracker(Options().tracking)
    image = world.image(0.0)
    jitter = np.random.default_rng(0).uniform(-0.2, 0.2, int(10 * rate_hz)) / rate_hz
    for index, late in enumerate(jitter):
        vehicles.follow(image, index / rate_hz + late, tracker, 1.0)
    assert world.calls == pytest.approx(50, abs=2)


def at(world: World, time_s: float, vehicles: DetectorTracks, tracker: PointTracker) -> list[int]:
    """Show an instant; return the vehicles that move, those lowest in the image first."""
    image = world.image(time_s)
    tracker.follow(image, time_s)
    vehicles.follow(image, time_s, tracker, 1.0)
    return vehicles.regions([Region(0, 0, np.full(SIZE, 255, np.uint8))], SIZE)[1].tolist()


def test_between_detections_a_box_goes_with_its_points() -> None:
    world = World([(20, 100)], [60.0])
    vehicles, tracker = DetectorTracks(world, DetectorOptions(every_s=5.0)), PointTracker(Options().tracking)
    (vehicle,) = at(world, 0.0, vehicles, tracker)
    x, y = np.meshgrid(np.arange(30, 90, 12.0), np.arange(110, 140, 12.0))
    tracker.add_points(np.column_stack([x.ravel(), y.ravel()]), np.full(x.size, vehicle))
    for index in range(1, 31):
        at(world, 0.1 * index, vehicles, tracker)
    assert world.calls == 1
    moving, _ = vehicles.regions([Region(0, 0, np.full(SIZE, 255, np.uint8))], SIZE)
    assert moving[0].x == pytest.approx(20 + 60.0 * 3.0, abs=3)


def test_the_overlap_of_two_boxes_belongs_to_the_nearer() -> None:
    world = World([(100, 100), (120, 130)], [0.0, 0.0])
    vehicles, tracker = DetectorTracks(world, DetectorOptions()), PointTracker(Options().tracking)
    at(world, 0.0, vehicles, tracker)
    (near, far), _ = vehicles.regions([Region(0, 0, np.full(SIZE, 255, np.uint8))], SIZE)
    assert (near.mask > 0).all() and near.y == 130
    left, top = near.x - far.x, near.y - far.y
    assert not far.mask[top:, left:].any() and (far.mask[:top] > 0).all()


def test_evidence_of_a_detector_has_track_kinds_and_the_result_reports_them() -> None:
    world = World([(20, 100), (500, 250)], [40.0, -40.0], people=(1,))
    calibrator = AutoCalibrator(Options(), detector=world)
    for index in range(70):
        image = world.image(0.1 * (index - 20)) if index >= 20 else noisy(ROAD, 1.5, index)
        calibrator.add_image(index * 100_000_000, image)
    evidence = calibrator.snapshot()
    assert evidence is not None
    assert {TrackKind.VEHICLE, TrackKind.PERSON} <= set(evidence.track_kinds.tolist())
    of_people = int((evidence.track_kinds == TrackKind.PERSON).sum())
    assert evidence.summary().vehicles == len(
        set(evidence.track_vehicles[evidence.track_kinds == TrackKind.VEHICLE].tolist())
    )
    assert f'{evidence.track_count - of_people} of' in str(calibrator.progress())
