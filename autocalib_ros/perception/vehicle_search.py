"""Search of moving regions for keypoints, segments and edges, spread over the images that follow.

To search all regions takes several times as long as to follow their points. An image waits for the one before, so that
what has time is done later: half of the keypoints are found before the points are followed into the next image, and the
edges with the one after that. The observations are those of the image that the regions were found in.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from autocalib_ros.evidence.snapshot import Edges, Segments
from autocalib_ros.perception.edges import EdgeFinder
from autocalib_ros.perception.klt_tracker import PointTracker
from autocalib_ros.perception.motion_mask import Region
from autocalib_ros.perception.segments import Keypoints, KeypointSearch, match_segments

EDGE_SEARCH_PERIOD = 2
"""Keypoint detections between edge searches, which cost as much; edges change little in between."""


@dataclass(frozen=True)
class MaskedFrame:
    """A grey image and what moves in it."""

    grey: np.ndarray
    """Shape (H, W), uint8."""
    time_s: float
    regions: list[Region]
    vehicles: np.ndarray
    """Vehicle id of each region, shape (n,)."""
    people: np.ndarray
    """Whether each region is a detected person, bool (n,)."""


class VehicleSearch:
    """Searches the regions of one masked frame after the other; ends are pixels of the tracked image."""

    def __init__(self) -> None:
        self._sift = cv2.SIFT_create(contrastThreshold=0.03)  # type: ignore[attr-defined]  # for OpenCV 4.5
        self._frames = 0
        self.restart()

    def restart(self) -> None:
        """Forget all images: grey levels are unrelated to theirs."""
        self._edge_finder = EdgeFinder()
        self._before: Keypoints | None = None
        self._searched: tuple[MaskedFrame, KeypointSearch] | None = None
        self._edges_due: MaskedFrame | None = None

    def begin(self, frame: MaskedFrame) -> Edges | None:
        """Begin with a masked frame; return the edges of the one before, if they are still due."""
        edges = self._find_edges()
        search = KeypointSearch(frame.grey, frame.regions, self._sift)
        search.step()
        self._searched = (frame, search)
        return edges

    def go_on(self, tracker: PointTracker) -> tuple[Segments | None, Edges | None]:
        """Do what was left for the next image, before the points are followed into it.

        Tracks start, and segments of the last masked frame are returned; with the image after that its edges.
        """
        if self._searched is None:
            return None, self._find_edges()
        (frame, search), self._searched = self._searched, None
        self._edges_due = frame
        return self._start_tracks(frame, search.keypoints(), tracker), None

    def _start_tracks(self, frame: MaskedFrame, keypoints: Keypoints, tracker: PointTracker) -> Segments | None:
        """Start tracks at keypoints; return the segments that end at them, None for the first frame."""
        of_keypoint, of_person = frame.vehicles[keypoints.regions], frame.people[keypoints.regions]
        order = np.lexsort((-keypoints.responses, of_person))  # by response, people last
        tracker.add_points(keypoints.points_px[order], of_keypoint[order])
        keypoints, of_keypoint = keypoints.subset(~of_person), of_keypoint[~of_person]
        before, self._before = self._before, keypoints
        if before is None:
            return None
        ends, matched = match_segments(before, keypoints, frame.grey.shape[1])
        return Segments(frame.time_s, of_keypoint[matched], ends)

    def _find_edges(self) -> Edges | None:
        """Find straight edges of the frame that is due, in every `EDGE_SEARCH_PERIOD`th one."""
        frame, self._edges_due = self._edges_due, None
        if frame is None:
            return None
        self._frames += 1
        if self._frames % EDGE_SEARCH_PERIOD:
            return None
        vehicles = [region for region, person in zip(frame.regions, frame.people, strict=True) if not person]
        ends, of_edge = self._edge_finder.find(frame.grey, vehicles)
        return Edges(frame.time_s, frame.vehicles[~frame.people][of_edge], ends)
