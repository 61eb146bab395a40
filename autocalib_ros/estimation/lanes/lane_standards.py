"""Lane widths and dash periods that countries prescribe."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LaneStandard:
    """What a country prescribes for lane lines between lanes of one direction."""

    width_m: float
    """Usual width of a lane of a main road, from the middle of one line to that of the next."""
    width_sigma_m: float
    """Standard deviation: main roads and motorways differ, and old roads from new ones."""
    periods_m: tuple[float, ...]
    """Length of a dash and of the gap after it, together; of fast roads first."""
    dashes_m: tuple[float, ...]
    """Length of the dash alone, for each period."""
    source: str


LANE_STANDARDS = {
    'us': LaneStandard(
        3.6,
        0.2,
        (12.19,),
        (3.05,),
        'MUTCD 2009, 3A.06: dashes of 10 ft, gaps of 30 ft; AASHTO Green Book: lanes of 11 to 12 ft',
    ),
    'uk': LaneStandard(
        3.65,
        0.2,
        (9.0, 6.0),
        (2.0, 1.0),
        'Traffic Signs Manual 5, table 4-2: 2 m and 7 m, 1 m and 5 m up to 40 mph; CD 127',
    ),
    'de': LaneStandard(
        3.5,
        0.25,
        (18.0, 12.0, 9.0),
        (6.0, 4.0, 3.0),
        'RMS-1: 6 m and 12 m, 4 m and 8 m outside towns, 3 m and 6 m inside; RAA, RASt 06',
    ),
    'fr': LaneStandard(3.5, 0.2, (13.0, 6.5), (3.0, 1.5), 'IISR part 7: T1 of 3 m and 10 m, T1 prime of 1.5 m and 5 m'),
    'cn': LaneStandard(
        3.5,
        0.25,
        (15.0, 6.0),
        (6.0, 2.0),
        'GB 5768.3: 6 m and 9 m, 2 m and 4 m below 60 km/h; JTG B01: 3.75 m, streets 3.25 m',
    ),
}
"""Standards by country."""
