"""The linearised least-squares problem at a state: residual blocks of tracks, motion pairs and tracklets."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from autocalib_ros.estimation.adjustment.parameters import AdjustmentConfig, AdjustmentState, Parameterisation
from autocalib_ros.estimation.adjustment.residual_blocks import (
    LinearisedRows,
    PlanarMotionBlock,
    RigidBodyBlock,
    StraightTrackBlock,
)
from autocalib_ros.estimation.motion.planar_motion import PlanarMotion
from autocalib_ros.estimation.motion.rigid_bodies import StructureAndMotion
from autocalib_ros.estimation.observations.track_set import TrackSet, UnprojectedTracks

WarmStart = tuple[None, PlanarMotion | None, StructureAndMotion | None]
"""Eliminated unknowns of each residual block, as the start of the next iteration: none of tracks, motions of two-frame
windows, shapes and motions of tracklets."""
BLOCK_COUNT = 3
"""Residual blocks: tracks on roads, two-frame windows, tracklets."""
MIN_RESIDUAL_SCALE = 0.05
"""Lower bound of the residual scale (squared, whitened): noise-free synthetic traffic needs a positive divisor."""


class Problem:
    """Residual blocks of labelled tracks and turning vehicles, linearised at a base state.

    A row is one track, one two-frame window or one tracklet. Rows of tracks come first, then windows, then tracklets.
    """

    def __init__(
        self,
        base: AdjustmentState,
        tracks: TrackSet,
        labels: np.ndarray,
        config: AdjustmentConfig,
        warm_start: WarmStart = (None, None, None),
        unprojected: UnprojectedTracks | None = None,
    ) -> None:
        self.parameters, self._tracks = Parameterisation(base, config), tracks
        self.used = np.flatnonzero(labels >= 0)
        """Indices of the tracks on a road, one for each row of the first block."""
        unprojected = unprojected or UnprojectedTracks.through(base.camera, tracks)
        self.straight = StraightTrackBlock(
            self.parameters,
            tracks.subset(self.used),
            labels[self.used],
            unprojected.subset(self.used),
            tracks.kish_weight(config.vehicle_correlation)[self.used],
        )
        self.planar = PlanarMotionBlock(self.parameters, warm_start[1])
        self.rigid = None if config.bundle is None else RigidBodyBlock(self.parameters, config.bundle, warm_start[2])
        self.block_of_row = np.repeat(np.arange(len(self.blocks)), [len(block.dof) for block in self.blocks])
        """Index of the residual block of each row, shape (rows,)."""
        self.dof = np.concatenate([block.dof for block in self.blocks])
        """Degrees of freedom of each row: residuals minus eliminated unknowns, at least 1, shape (rows,)."""
        self.vehicle_weight = np.concatenate([block.vehicle_weight for block in self.blocks])
        """Weight of each row for correlated errors within its vehicle, shape (rows,)."""

    @property
    def turning_blocks(self) -> list[PlanarMotionBlock | RigidBodyBlock]:
        """Residual blocks of turning vehicles."""
        return [self.planar] if self.rigid is None else [self.planar, self.rigid]

    @property
    def blocks(self) -> list[StraightTrackBlock | PlanarMotionBlock | RigidBodyBlock]:
        """All residual blocks, in the order of the rows."""
        return [self.straight, *self.turning_blocks]

    @property
    def config(self) -> AdjustmentConfig:
        """Prior, options and turning vehicles of the adjustment."""
        return self.parameters.config

    @property
    def warm_start(self) -> WarmStart:
        """Eliminated unknowns of each residual block at the base."""
        return (None, self.planar.warm_start, None if self.rigid is None else self.rigid.warm_start)

    @property
    def vehicle_ids(self) -> np.ndarray:
        """Vehicle of each row, shape (rows,); numbers of straight and of turning vehicles do not overlap."""
        on_roads = self.straight.vehicle_ids
        offset = on_roads.max(initial=-1) + 1
        return np.concatenate([on_roads, *(block.vehicle_ids + offset for block in self.turning_blocks)])

    def at(self, step: np.ndarray) -> tuple[WarmStart, np.ndarray]:
        """Return the eliminated unknowns and the mean squared whitened residuals (rows,) at a parameter step."""
        rays = UnprojectedTracks.through(self.parameters.state(step).camera, self._tracks).rays
        squared = [self.straight.at(step, rays.subset(self.used))]
        motion, squared_windows = self.planar.at(step)
        squared.append(squared_windows)
        shapes = None
        if self.rigid is not None:
            shapes, squared_tracklets = self.rigid.at(step)
            squared.append(squared_tracklets)
        return (None, motion, shapes), np.concatenate(squared)

    def linearise(self) -> LinearisedRows:
        """Return gradient and Gauss-Newton matrix of every row at the base."""
        parts = [block.linearise() for block in self.blocks]
        return LinearisedRows(
            *(np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(LinearisedRows))
        )

    def scales(self, squared: np.ndarray) -> np.ndarray:
        """Return the median of mean squared residuals (rows,) over each block, 1 for an empty one, (BLOCK_COUNT,)."""
        scales = np.ones(BLOCK_COUNT)
        for block in range(BLOCK_COUNT):
            rows = self.block_of_row == block
            if rows.any():
                scales[block] = max(float(np.median(squared[rows])), MIN_RESIDUAL_SCALE)
        return scales
