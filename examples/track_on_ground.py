"""Track vehicles on the ground plane: detections in pixels in, tracks in metres out.

    python examples/track_on_ground.py results/calibration.json detections.csv

A line of detections.csv is `time_s,u,v`: where a vehicle touches the road, in the raw image. The tracker is a Kalman
filter with constant velocity for each vehicle and nearest-neighbour association. It prints
`time_s,track,x_m,y_m,speed_km_h`.
"""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from autocalib_ros.ground import Ground

PIXEL_SIGMA_PX = 2.0
"""Standard deviation of a detection."""
ACCELERATION_M_S2 = 2.0
"""Standard deviation of the acceleration of a vehicle."""
FIRST_SPEED_M_S = 15.0
"""Standard deviation of the unknown speed of a new track."""
GATE2 = 13.8
"""Squared Mahalanobis distance up to which a detection may belong to a track: 99.9 % of chi-square, two degrees of
freedom."""
FORGET_S = 2.0
"""Time without a detection after which a track ends."""


@dataclass
class Track:
    """State (x, y, vx, vy) of one vehicle in the ground frame, and its covariance."""

    number: int
    time_s: float
    state: np.ndarray
    covariance: np.ndarray

    def predict(self, time_s: float) -> None:
        """Move the state to a later time."""
        step = time_s - self.time_s
        transition = np.eye(4)
        transition[:2, 2:] = step * np.eye(2)
        lever = np.vstack([0.5 * step**2 * np.eye(2), step * np.eye(2)])
        self.state = transition @ self.state
        self.covariance = transition @ self.covariance @ transition.T + ACCELERATION_M_S2**2 * lever @ lever.T

    def distance2(self, place_m: np.ndarray, noise_m2: np.ndarray) -> float:
        """Squared Mahalanobis distance of a measurement."""
        off = place_m - self.state[:2]
        return float(off @ np.linalg.solve(self.covariance[:2, :2] + noise_m2, off))

    def update(self, time_s: float, place_m: np.ndarray, noise_m2: np.ndarray) -> None:
        """Take a measurement (2,) with its covariance (2, 2)."""
        gain = self.covariance[:, :2] @ np.linalg.inv(self.covariance[:2, :2] + noise_m2)
        self.state = self.state + gain @ (place_m - self.state[:2])
        self.covariance = self.covariance - gain @ self.covariance[:2]
        self.time_s = time_s


@dataclass
class Tracker:
    """The tracks of one camera."""

    ground: Ground
    tracks: list[Track] = field(default_factory=list)
    count: int = 0

    def measure(self, time_s: float, pixels: np.ndarray) -> list[Track]:
        """Take the detections (n, 2) of one image; return the tracks that were updated."""
        # Filter with the pixel noise alone: the calibration error is common to all points and does not average out.
        found = self.ground.points(pixels, pixel_sigma_px=PIXEL_SIGMA_PX)
        assert found.noise_m2 is not None  # pixel_sigma_px was given
        self.tracks = [track for track in self.tracks if time_s - track.time_s <= FORGET_S]
        free, updated = list(self.tracks), []
        for place_m, noise_m2 in zip(found.points_m[found.valid, :2], found.noise_m2[found.valid], strict=True):
            near = [(predicted(track, time_s).distance2(place_m, noise_m2), track) for track in free]
            distance2, track = min(near, key=lambda pair: pair[0], default=(np.inf, None))
            if track is None or distance2 > GATE2:
                track = self._begin(time_s, place_m, noise_m2)
            else:
                free.remove(track)
                track.predict(time_s)
                track.update(time_s, place_m, noise_m2)
            updated.append(track)
        return updated

    def _begin(self, time_s: float, place_m: np.ndarray, noise_m2: np.ndarray) -> Track:
        covariance = np.diag([0.0, 0.0, FIRST_SPEED_M_S**2, FIRST_SPEED_M_S**2])
        covariance[:2, :2] = noise_m2
        self.count += 1
        self.tracks.append(Track(self.count, time_s, np.concatenate([place_m, [0.0, 0.0]]), covariance))
        return self.tracks[-1]


def predicted(track: Track, time_s: float) -> Track:
    """Return a copy of a track, predicted to a later time."""
    copy = Track(track.number, track.time_s, track.state, track.covariance)
    copy.predict(time_s)
    return copy


def read_detections(path: Path) -> dict[float, np.ndarray]:
    """Return the pixels (n, 2) of each time in seconds, in order of time."""
    with path.open(newline='', encoding='utf-8') as stream:
        rows = np.array([[float(value) for value in row] for row in csv.reader(stream)]).reshape(-1, 3)
    return {float(time): rows[rows[:, 0] == time, 1:] for time in np.unique(rows[:, 0])}


def main(calibration: str, detections: str) -> int:
    """Track and print; return the exit status."""
    tracker = Tracker(Ground.from_file(calibration))
    for time_s, pixels in read_detections(Path(detections)).items():
        for track in tracker.measure(time_s, pixels):
            x, y, vx, vy = track.state
            print(f'{time_s:.2f},{track.number},{x:.2f},{y:.2f},{3.6 * np.hypot(vx, vy):.1f}')
    return 0


if __name__ == '__main__':
    sys.exit(main(*sys.argv[1:3]))
