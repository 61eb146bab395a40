"""Join the evidence of several recordings of one camera: each is registered to the first one by its background."""

from __future__ import annotations

import logging

import numpy as np

from autocalib_ros.config import GateOptions
from autocalib_ros.estimation.verification.readiness import check_steady
from autocalib_ros.evidence.joining import joined, moved
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.evidence.stillness import sway_limit_px
from autocalib_ros.perception.landmark_matching import register

LOG = logging.getLogger(__name__)


class JoinedEvidence:
    """Evidence of recordings of one view; those of another one are left out and named."""

    def __init__(self, gate: GateOptions, before: Evidence | None = None) -> None:
        """`before` is evidence of earlier runs, to which all is registered."""
        self._gate = gate
        self._last_displacement_px = 0.0
        self._parts = [] if before is None else [before]
        self._first_name = '' if before is None else 'the evidence of before'
        self.displacements_px: list[float] = []
        """Root mean square displacement of each recording that was registered to the first."""
        self.left_out: list[str] = []
        """Why recordings were left out, one line each."""

    def __len__(self) -> int:
        return len(self._parts)

    def add(self, evidence: Evidence, name: str) -> bool:
        """Add the evidence of a recording unless it is of another view; return whether it was added."""
        self._leave_out_first_if_unsteady(evidence)
        registered = self._registered(evidence)
        if isinstance(registered, str):
            self._leave_out(name, registered)
            return False
        if self._parts:
            self.displacements_px.append(self._last_displacement_px)
        self._parts.append(registered)
        self._first_name = self._first_name or name
        return True

    def _leave_out(self, name: str, reason: str) -> None:
        self.left_out.append(f'{name} is left out: {reason}')
        LOG.warning('%s', self.left_out[-1])

    def _leave_out_first_if_unsteady(self, evidence: Evidence) -> None:
        """Let a recording of a camera that stands take the place of a first one in which it moved."""
        if len(self._parts) == 1 and not check_steady(evidence, self._gate):
            unsteady = check_steady(self._parts[0], self._gate)
            if unsteady:
                self._leave_out(self._first_name, unsteady.message)
                self._parts = []
                self._first_name = ''

    def with_part(self, evidence: Evidence) -> Evidence:
        """Return all evidence together with that of a recording which is still being read, if it fits."""
        registered = self._registered(evidence)
        return self.all() if isinstance(registered, str) else joined([*self._parts, registered])

    def all(self) -> Evidence:
        """Return the evidence of all recordings that were added."""
        return joined(self._parts)

    def _registered(self, evidence: Evidence) -> Evidence | str:
        """Return evidence in the pixels of the first recording, or why it cannot be."""
        if not self._parts:
            return evidence
        first = self._parts[0]
        for reason in (self._unlike(evidence, first), self._repeated(evidence)):
            if reason:
                return reason
        unsteady = check_steady(evidence, self._gate)
        if unsteady:
            return unsteady.message
        found = register(evidence.landmarks, first.landmarks, first.image_size)
        if found is None:
            return 'its background is not that of the first recording: another view, or too dark to tell'
        limit_px = sway_limit_px(first.image_size[0], self._gate)
        if found.displacement_px > limit_px:
            return (
                f'its view is displaced by {found.displacement_px:.1f} px from that of the first recording, more than '
                f'the {limit_px:.1f} px that are compensated: the camera was turned in between'
            )
        self._last_displacement_px = found.displacement_px
        return moved(evidence, found.matrix)

    @staticmethod
    def _unlike(evidence: Evidence, first: Evidence) -> str:
        """Return in what the images differ from those of the first recording; '' if in nothing."""
        if evidence.image_size != first.image_size:
            sizes = [f'{one.image_size[0]}x{one.image_size[1]}' for one in (evidence, first)]
            return f'its images have {sizes[0]}, those of the first recording {sizes[1]}'
        if evidence.pixel_aspect != first.pixel_aspect:
            return f'its pixels have the aspect {evidence.pixel_aspect:.4g}, those before {first.pixel_aspect:.4g}'
        if not len(first.landmarks) or not len(evidence.landmarks):
            return 'landmarks of the background are missing: too few images, or evidence of an earlier version'
        return ''

    def _repeated(self, evidence: Evidence) -> str:
        """Return whether this is evidence that is there already: counted twice, it would look surer than it is."""
        points = evidence.points_px
        same = any(
            len(part.points_px) == len(points) > 0 and np.allclose(np.diff(part.times_s), np.diff(evidence.times_s))
            for part in self._parts
        )
        return 'it is the same recording as one before, and evidence counts once' if same else ''


def join_evidence(parts: list[tuple[Evidence, str]], gate: GateOptions) -> JoinedEvidence:
    """Join evidence with the names of the files that it is from."""
    joint = JoinedEvidence(gate)
    for evidence, name in parts:
        joint.add(evidence, name)
    return joint
