"""Vehicles in the lanes of a straight road."""

import numpy as np
from pinhole_road import PINHOLE, ROAD

from autocalib_ros.estimation.observations.track_set import TrackSet

FOUR_LANES = {-1.0: (-5.25, -1.75), 1.0: (1.75, 5.25)}
"""Middles of lanes by direction of travel, metres to the left."""


def traffic(lanes: dict[float, tuple[float, ...]], count: int = 48, scatter_m: float = 0.3) -> TrackSet:
    """Vehicles in lanes, by direction of travel, of points up to 1.2 m above the road."""
    generator = np.random.default_rng(2)
    each = [(way, y) for way, middles in lanes.items() for y in middles]
    way, y = np.array([each[index % len(each)] for index in range(count)]).T
    share = np.linspace(0.0, 1.0, 10)
    places = np.stack(
        [
            19.0 + way[:, None] * (share - 0.5) * 18.0,
            np.broadcast_to((y + scatter_m * generator.normal(size=count))[:, None], (count, 10)),
            np.broadcast_to(generator.uniform(0.2, 1.2, (count, 1)) - ROAD.height_m, (count, 10)),
        ],
        axis=-1,
    )
    pixels, _ = PINHOLE.project(places.reshape(-1, 3) @ ROAD.camera_from_ground.T)
    times = np.broadcast_to(share, (count, 10))
    weights, numbers = np.full((count, 10), 0.1), np.arange(count)
    return TrackSet(pixels.reshape(count, 10, 2), weights, numbers, times, numbers)
