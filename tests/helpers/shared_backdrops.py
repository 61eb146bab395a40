"""Backdrops that simulations share: the static scene is painted once for all that differ in what moves or disturbs."""

from __future__ import annotations

from dataclasses import fields

import pytest

from autocalib_ros.offline.simulate.lens import CameraPose
from autocalib_ros.offline.simulate.render import Renderer

NOT_IN_THE_BACKDROP = (
    *('rate_hz', 'duration_s', 'density', 'wander_m', 'pedestrians', 'cyclists', 'empty', 'noise_sigma'),
    *('shutter_every_s', 'shutter_shows', 'trouble', 'bump_at_s', 'bump_deg'),
    *('topic', 'truth_topic', 'frame_id', 'compressed', 'storage', 'zstd'),
)
"""Options of the simulator that the static scene does not depend on; a bump changes the pose."""


def share_backdrops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let renderers take the backdrop of an earlier one whose options and pose show the same static scene."""
    draw, drawn = Renderer._draw_backdrop, {}

    def shared(renderer: Renderer, pose: CameraPose) -> object:
        options = renderer._options
        key = (
            *(getattr(options, each.name) for each in fields(options) if each.name not in NOT_IN_THE_BACKDROP),
            pose.world_from_camera.tobytes(),
            pose.position_m.tobytes(),
        )
        if key not in drawn:
            drawn[key] = draw(renderer, pose)
        return drawn[key]

    monkeypatch.setattr(Renderer, '_draw_backdrop', shared)
