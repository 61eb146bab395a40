"""Bodies that move on the road of a made-up junction, with their tracks and the outlines that a mask gives of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autocalib_ros.config import BufferOptions
from autocalib_ros.evidence.buffer import EvidenceBuffer
from autocalib_ros.evidence.snapshot import Evidence, Outlines, Track
from autocalib_ros.offline.synthetic.junction import Junction
from autocalib_ros.perception.silhouettes import EXTREME_DIRECTIONS

RIDER_M, CAR_M = (1.75, 0.6, 1.75), (4.3, 1.75, 1.45)
GAP_PX = 100.0


def box(size_m: tuple[float, float, float], place_m: np.ndarray, heading: float) -> np.ndarray:
    """Corners (8, 3) of a box of a length, width and height that stands at a place (2,) on the road."""
    signs = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
    x, y, z = (signs * size_m).T
    c, s = np.cos(heading), np.sin(heading)
    return np.column_stack([place_m[0] + x * c - y * s, place_m[1] + x * s + y * c, z])


def projected(junction: Junction, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of points (n, 3) of the ground frame, and whether they are in the image."""
    pixels, valid = junction.camera.project((points_m - [0, 0, junction.height_m]) @ junction.camera_from_ground.T)
    return pixels, valid & (pixels >= 0).all(axis=1) & (pixels < junction.image_size).all(axis=1)


def outline(junction: Junction, corners_m: np.ndarray) -> np.ndarray:
    """Outline, as a row of `Outlines.ends_px`, of a body with corners (n, 3)."""
    pixels, _ = projected(junction, corners_m)
    return np.append(pixels[(pixels @ EXTREME_DIRECTIONS.T).argmax(axis=0)], GAP_PX)


def driven(
    junction: Junction,
    number: int,
    start_s: float,
    size_m: tuple[float, float, float],
    start_m: np.ndarray,
    heading: float,
    speed_m_s: float,
    generator: np.random.Generator,
) -> tuple[list[Track], list[Outlines]]:
    """Tracks of six points of a body that goes straight on for 12 s, and its outlines while it is all in view."""
    times = np.arange(0.0, 12.0, 0.2)
    places = start_m + np.outer(times * speed_m_s, [np.cos(heading), np.sin(heading)])
    tracks = []
    for inside in generator.uniform(-0.45, 0.45, (6, 2)):
        up = generator.uniform(0.1, 0.9) * size_m[2]
        c, s = np.cos(heading), np.sin(heading)
        ahead, left = inside * size_m[:2]
        points = np.column_stack([places + [ahead * c - left * s, ahead * s + left * c], np.full(len(times), up)])
        pixels, seen = projected(junction, points)
        if seen.sum() > 5:
            noisy = pixels[seen] + generator.normal(scale=0.3, size=(seen.sum(), 2))
            tracks.append(Track(number, start_s + times[seen], noisy))
    outlines = []
    for time_s, place in zip(times[::2], places[::2], strict=True):
        corners = box(size_m, place, heading)
        if projected(junction, corners)[1].all():
            outlines.append(Outlines(start_s + time_s, np.array([number]), outline(junction, corners)[None]))
    return tracks, outlines


def crossing_bodies(
    junction: Junction,
    first: int,
    count: int,
    size_m: tuple[float, float, float],
    speeds_m_s: tuple[float, float],
    seed: int = 1,
) -> tuple[list[Track], list[Outlines]]:
    """Tracks and outlines of bodies that cross a junction along one of its roads, in either direction."""
    generator, tracks, outlines = np.random.default_rng(seed), [], []
    for number in range(count):
        heading, speed = np.pi / 2 * generator.integers(4), generator.uniform(*speeds_m_s)
        way = np.array([np.cos(heading), np.sin(heading)])
        start = np.array(junction.centre_m) + generator.uniform(-5.0, 5.0, 2) - 5.0 * speed * way
        own = driven(junction, first + number, 3.0 * number, size_m, start, heading, speed, generator)
        tracks, outlines = [*tracks, *own[0]], [*outlines, *own[1]]
    return tracks, outlines


def with_outlines(evidence: Evidence, outlines: list[Outlines]) -> Evidence:
    """Put outlines into evidence."""
    buffer = EvidenceBuffer(BufferOptions())
    for each in sorted(outlines, key=lambda each: each.time_s):
        buffer.add_outlines(each)
    held = buffer.snapshot(
        image_size=evidence.image_size, first_stamp_ns=0, newest_stamp_ns=0, frames=0, drift_px=0.0, unfinished=[]
    )
    return replace(
        evidence,
        outlines_px=held.outlines_px,
        outline_vehicles=held.outline_vehicles,
        outline_times_s=held.outline_times_s,
    )
