"""Vehicle types as side profiles extruded over their width; dimensions in metres.

Body frame: origin on the ground below the centre of the vehicle, x forward, y left, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

Profile = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class BodyPart:
    """An extruded profile (x, z) from the lower front over the top to the lower rear.

    labels: appearance of each of the len(profile) - 1 strips between neighbouring points.
    windows: outlines (x, z) of the side windows.
    """

    profile: Profile
    labels: tuple[str, ...]
    width_m: float
    windows: tuple[Profile, ...] = ()
    lettering: str = ''

    @property
    def top_m(self) -> float:
        """Height of the highest point."""
        return max(z for _, z in self.profile)


@dataclass(frozen=True)
class VehicleShape:
    """One vehicle type; fraction: its fraction of the traffic."""

    kind: str
    length_m: float
    width_m: float
    wheelbase_m: float
    wheel_radius_m: float
    parts: tuple[BodyPart, ...]
    fraction: float
    acceleration_mps2: float
    fits_narrow_turns: bool = True
    top_speed_mps: float = 40.0

    @property
    def wheels_x_m(self) -> tuple[float, float]:
        """Positions of the front and rear axle."""
        return self.wheelbase_m / 2, -self.wheelbase_m / 2


def _windows(*spans: tuple[float, float], low: float, high: float, slant: float = 0.0) -> tuple:
    """Return side windows over the spans (rear, front) of x between two heights."""
    return tuple(((front, low), (front - slant, high), (rear + slant, high), (rear, low)) for rear, front in spans)


_SEDAN = BodyPart(
    profile=(
        (2.25, 0.28),
        (2.27, 0.68),
        (1.22, 0.92),
        (0.48, 1.40),
        (-0.85, 1.44),
        (-1.55, 1.02),
        (-2.24, 0.96),
        (-2.25, 0.30),
    ),
    labels=('front', 'bonnet', 'screen', 'roof', 'rear_screen', 'boot', 'rear'),
    width_m=1.78,
    windows=(
        ((1.0, 0.95), (0.42, 1.32), (0.05, 1.34), (0.05, 0.95)),
        ((-0.03, 0.95), (-0.03, 1.34), (-0.78, 1.36), (-1.30, 1.0)),
    ),
)
_HATCH = BodyPart(
    profile=(
        (1.95, 0.28),
        (1.98, 0.72),
        (1.12, 0.98),
        (0.40, 1.46),
        (-1.35, 1.50),
        (-1.86, 0.95),
        (-1.95, 0.30),
    ),
    labels=('front', 'bonnet', 'screen', 'roof', 'rear_screen', 'rear'),
    width_m=1.72,
    windows=(
        ((0.92, 1.0), (0.38, 1.38), (0.0, 1.40), (0.0, 1.0)),
        ((-0.08, 1.0), (-0.08, 1.40), (-1.20, 1.42), (-1.50, 1.02)),
    ),
)
_WAGON = BodyPart(
    profile=(
        (2.30, 0.35),
        (2.34, 0.92),
        (1.30, 1.12),
        (0.62, 1.66),
        (-1.95, 1.70),
        (-2.26, 1.12),
        (-2.32, 0.36),
    ),
    labels=('front', 'bonnet', 'screen', 'roof', 'rear_screen', 'rear'),
    width_m=1.88,
    windows=(
        ((1.10, 1.12), (0.60, 1.56), (0.10, 1.58), (0.10, 1.12)),
        ((0.02, 1.12), (0.02, 1.58), (-0.95, 1.60), (-0.95, 1.12)),
        ((-1.05, 1.12), (-1.05, 1.60), (-1.80, 1.60), (-2.02, 1.14)),
    ),
)
_VAN = BodyPart(
    profile=(
        (2.60, 0.35),
        (2.62, 1.02),
        (1.95, 1.24),
        (1.25, 2.02),
        (-2.52, 2.10),
        (-2.58, 0.36),
    ),
    labels=('front', 'bonnet', 'screen', 'roof', 'doors'),
    width_m=1.98,
    windows=(((1.72, 1.22), (1.20, 1.82), (0.62, 1.86), (0.62, 1.22)),),
    lettering='NORTHSIDE PARCEL',
)
_CAB = BodyPart(
    profile=((3.70, 0.45), (3.74, 1.35), (3.45, 2.45), (2.05, 2.52), (2.05, 0.50)),
    labels=('front', 'screen', 'roof', 'plain'),
    width_m=2.25,
    windows=(((3.30, 1.45), (3.10, 2.20), (2.40, 2.24), (2.40, 1.45)),),
)
_CARGO = BodyPart(
    profile=((1.90, 0.85), (1.90, 3.25), (-3.75, 3.25), (-3.75, 0.85)),
    labels=('plain', 'tarpaulin', 'doors'),
    width_m=2.40,
    lettering='KESTREL FREIGHT 58',
)
_COACH = BodyPart(
    profile=((5.70, 0.40), (5.72, 1.20), (5.55, 2.95), (-5.62, 3.02), (-5.70, 0.42)),
    labels=('front', 'screen', 'bus_roof', 'rear'),
    width_m=2.50,
    windows=_windows(
        (-5.30, -3.95),
        (-3.80, -2.30),
        (-2.15, -0.65),
        (-0.50, 1.00),
        (1.15, 2.65),
        (2.80, 4.20),
        (4.40, 5.35),
        low=1.35,
        high=2.45,
    ),
    lettering='LINE 7 HARBOUR',
)

SHAPES = {
    shape.kind: shape
    for shape in (
        VehicleShape('sedan', 4.5, 1.78, 2.65, 0.31, (_SEDAN,), 0.27, 1.8),
        VehicleShape('hatchback', 3.9, 1.72, 2.45, 0.30, (_HATCH,), 0.24, 1.9),
        VehicleShape('wagon', 4.6, 1.88, 2.75, 0.35, (_WAGON,), 0.20, 1.7),
        VehicleShape('van', 5.2, 1.98, 3.20, 0.33, (_VAN,), 0.15, 1.5),
        VehicleShape(
            'truck',
            7.5,
            2.40,
            4.20,
            0.45,
            (_CAB, _CARGO),
            0.09,
            1.0,
            fits_narrow_turns=False,
            top_speed_mps=24.0,
        ),
        VehicleShape(
            'bus',
            11.4,
            2.50,
            5.80,
            0.46,
            (_COACH,),
            0.05,
            1.0,
            fits_narrow_turns=False,
            top_speed_mps=27.0,
        ),
    )
}
