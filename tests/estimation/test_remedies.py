"""Remedies are true: each refusal is made from simulated traffic, and each printed remedy gives another verdict.

What a person does at the road is simulated: more vehicles for a longer recording, a camera without motion for a mount.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from squeezed_evidence import squeezed

from autocalib_ros.config import GateOptions, JointOptions, LensOptions, Options, PaperOptions, ScaleOptions
from autocalib_ros.evidence.snapshot import Evidence
from autocalib_ros.evidence.stillness import Stillness, ViewChange, ViewChangeKind
from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.benchmark.monte_carlo import draw_evidence
from autocalib_ros.offline.synthetic.drives import Trajectory, drive_across, drive_bend, drive_ring
from autocalib_ros.offline.synthetic.junction import Junction, pose
from autocalib_ros.results.calibration import Calibration, Refusal
from autocalib_ros.results.refusals import BY_CODE, OR, REFUSALS, Reason
from solved_once import ONE_FAMILY, evidence_once, solve_once

pytestmark = pytest.mark.solve

GOLDEN = Path(__file__).parents[1] / 'golden'


@dataclass(frozen=True)
class Question:
    """What is asked of the solver."""

    evidence: Evidence
    options: Options
    lens: Camera | None = None

    @classmethod
    def of(cls, junction: Junction, **options: object) -> Question:
        return cls(evidence_once(junction), Options(camera_height=8.0, **options))  # type: ignore[arg-type]

    def told(self, **options: object) -> Question:
        return replace(self, options=replace(self.options, **options))

    def seen(self, junction: Junction) -> Question:
        return replace(self, evidence=evidence_once(junction))

    @property
    def verdict(self) -> Refusal | Calibration:
        return solve_once(self.evidence, self.options, lens=self.lens)


@dataclass(frozen=True)
class Trial:
    """A refusal, and for each alternative of its remedy what is asked once it was followed."""

    code: str
    asked: Callable[[], Question]
    remedies: dict[str, Callable[[Question], Question]]
    cause: str = ''


def refusal_of(result: Refusal | Calibration) -> Refusal | Reason | None:
    return result if isinstance(result, Refusal) else result.ground_refusal


def some_straight(
    junction: Junction, generator: np.random.Generator, *, others: Callable[..., Trajectory], share: float
) -> Trajectory:
    """Most vehicles drive straight, a share of them as the others."""
    return (others if generator.uniform() < share else drive_across)(junction, generator)


CROSSING = Junction()
ONE_ROAD = Junction(
    road_angles_deg=(0.0,),
    turning_fraction=0.0,
    vehicles=80,
    camera_from_ground=pose(35.0, 1.0, 60.0),
    centre_m=(6.0, -10.0),
)
BEND = replace(CROSSING, drive=partial(drive_bend, radius_m=40.0, towards_rad=2.0))
RING = replace(CROSSING, drive=partial(drive_ring, radius_m=20.0))
TURNING = replace(CROSSING, turning_fraction=0.85)
UNDISTORTED = replace(CROSSING, camera=Camera(1280, 720, 1100.0, (639.5, 359.5), (1 / 3, 2 / 15, 17 / 315, 62 / 2835)))
TRAFFIC_ONLY = JointOptions(single_road=False)


def with_straight(junction: Junction, share: float = 0.2) -> Junction:
    return replace(junction, drive=partial(some_straight, others=junction.drive, share=share), vehicles=100)


HALF_BEND = with_straight(BEND, 0.5)


def more(junction: Junction, factor: int = 3) -> Junction:
    tracks = None if junction.tracks is None else factor * junction.tracks
    return replace(junction, tracks=tracks, vehicles=factor * junction.vehicles)


def tell_lens(junction: Junction) -> Callable[[Question], Question]:
    return lambda question: question.told(lens=LensOptions(focal_px=junction.camera.focal_px))


def stood(recorded_s: float, *changes: ViewChange) -> Question:
    """The camera stands for the last six seconds, after changes of the view."""
    still = Stillness(recorded_s - 6.0, recorded_s, recorded_s, 0.0, 0.0, changes)
    return replace(Question.of(CROSSING), evidence=replace(evidence_once(CROSSING), stillness=still))


def for_longer(question: Question) -> Question:
    still = question.evidence.stillness
    longer = replace(still, end_s=still.end_s + 60.0, recorded_s=still.recorded_s + 60.0)
    return replace(question, evidence=replace(question.evidence, stillness=longer))


def drawn(family: str, seed: int, run: int, **options: object) -> Question:
    junction, evidence = draw_evidence(family, seed, run)
    return Question(evidence, Options(camera_height=junction.height_m, **options))  # type: ignore[arg-type]


def again(family: str, seed: int, run: int, **changes: object) -> Callable[[Question], Question]:
    return lambda question: question.seen(replace(draw_evidence(family, seed, run)[0], **changes))  # type: ignore[arg-type]


def across_the_road(junction: Junction) -> Junction:
    return replace(junction, road_angles_deg=(0.0, 90.0))


def at_rest(question: Question) -> Question:
    return replace(question, evidence=replace(question.evidence, stillness=Stillness()))


TURN, ZOOM, CUT = ViewChangeKind.TURN, ViewChangeKind.ZOOM, ViewChangeKind.CUT
MOUNT = 'fix the camera to a rigid mount and record again'
MORE = 'wait for more traffic, or record for longer'
STRAIGHT, STRAIGHT_ROAD = 'wait for vehicles that drive straight', 'turn the camera towards a straight road'
LENS = 'give the focal length or field of view of the lens, as its data sheet says (--focal-px, --hfov-deg)'
CROSS_TRAFFIC = 'wait for traffic on a second road, or for vehicles that turn'
NEARER, LONGER_LENS = 'turn the camera towards a nearer part of the road', 'use a longer lens'

FAR = replace(CROSSING, camera=Camera(2560, 1440, 40.0, (1279.5, 719.5)), centre_m=(34.0, -24.0))
SMALL = replace(CROSSING, camera=replace(CROSSING.camera, focal_px=280.0), centre_m=(36.0, -26.0))
LEVEL_ROAD = replace(ONE_ROAD, camera_from_ground=pose(32.0, 0.0, 90.0), centre_m=(16.0, 0.0))
RARE = replace(CROSSING, vehicles=14, points_per_vehicle=8)
NEAR_M, FAR_M = (10.0, -7.0), (22.0, -15.0)
SKY = ScaleOptions(distance_px='400 2 800 2', distance_m=10.0)


def lens_file(junction: Junction, **changes: object) -> Question:
    return replace(Question.of(junction), lens=replace(junction.camera, **changes))


def length_on(junction: Junction, start_m: tuple[float, float], end_m: tuple[float, float]) -> ScaleOptions:
    """The length between two places of the road, to 2 %."""
    places = np.array([[*start_m, -junction.height_m], [*end_m, -junction.height_m]])
    pixels, _ = junction.camera.project(places @ junction.camera_from_ground.T)
    length_m = float(np.hypot(*(places[1] - places[0])[:2]))
    text = ' '.join(f'{value:.1f}' for value in pixels.ravel())
    return ScaleOptions(distance_px=text, distance_m=length_m, distance_sigma_m=0.02 * length_m)


SHORT_LENGTH = length_on(CROSSING, (20.0, -13.0), (22.0, -14.0))


TRIALS = (
    Trial(
        'camera_moving',
        lambda: drawn('waved', 0, 0),
        {MOUNT: again('waved', 0, 0, sway=None)},
    ),
    Trial(
        'camera_moving',
        lambda: stood(12.0, ViewChange(TURN, 4.1, 6.0, 8.1)),
        {'record for longer while the camera stands, on a rigid mount': for_longer},
        'turned',
    ),
    Trial(
        'camera_moving',
        lambda: stood(12.0, ViewChange(ZOOM, 4.1, 6.0, 1.3)),
        {'record for longer without a zoom, and switch off an automatic zoom': for_longer},
        'zoom',
    ),
    Trial(
        'camera_moving',
        lambda: stood(12.0, ViewChange(CUT, 4.1, 6.0)),
        {'record one view of the road for longer': for_longer},
        'cut',
    ),
    Trial(
        'no_motion',
        lambda: Question.of(replace(CROSSING, vehicles=0)),
        {
            'check that the camera sees traffic and that the images are neither frozen nor dark': lambda question: (
                question.seen(CROSSING)
            )
        },
    ),
    Trial(
        'too_few_tracks',
        lambda: Question.of(replace(CROSSING, vehicles=8)),
        {MORE: lambda question: question.seen(CROSSING)},
    ),
    Trial(
        'too_few_tracks',
        lambda: Question.of(replace(CROSSING, vehicles=10)),
        {MORE: lambda question: question.seen(CROSSING)},
        'short',
    ),
    Trial(
        'too_few_tracks',
        lambda: drawn('bend', 7, 0),
        {
            STRAIGHT: lambda question: question.seen(with_straight(draw_evidence('bend', 7, 0)[0])),
            STRAIGHT_ROAD: again('bend', 7, 0, drive=drive_across),
        },
        'curved',
    ),
    Trial(
        'too_few_tracks',
        lambda: Question.of(FAR).told(gate=GateOptions(min_coverage=0.0)),
        {
            NEARER: lambda question: question.seen(CROSSING),
            LONGER_LENS: lambda question: question.seen(replace(FAR, camera=replace(FAR.camera, focal_px=900.0))),
        },
        'far',
    ),
    Trial(
        'too_few_tracks',
        lambda: Question.of(replace(CROSSING, vehicles=20), method='paper', paper=PaperOptions(window_s=60.0)),
        {
            'shorten paper.window_s': lambda question: question.told(paper=PaperOptions(window_s=3.0)),
            'use method joint': lambda question: question.told(method='joint'),
        },
        'paper',
    ),
    Trial(
        'poor_coverage',
        lambda: Question.of(SMALL),
        {
            'turn the camera so that the road fills more of the image': lambda question: question.seen(CROSSING),
            LONGER_LENS: lambda question: question.seen(replace(SMALL, camera=CROSSING.camera)),
        },
    ),
    Trial(
        'no_direction',
        lambda: Question.of(BEND),
        {
            STRAIGHT: lambda question: question.seen(with_straight(BEND)),
            STRAIGHT_ROAD: lambda question: question.seen(CROSSING),
        },
    ),
    Trial(
        'no_agreement',
        lambda: drawn('sparse', 11, 0, joint=ONE_FAMILY),
        {
            STRAIGHT: lambda question: question.seen(more(draw_evidence('sparse', 11, 0)[0])),
            LENS: lambda question: tell_lens(draw_evidence('sparse', 11, 0)[0])(question),
        },
    ),
    Trial(
        'no_agreement',
        lambda: drawn('sparse', 11, 0),
        {MORE: lambda question: question.seen(more(draw_evidence('sparse', 11, 0)[0]))},
        'with a single road',
    ),
    Trial(
        'turning_traffic',
        lambda: Question.of(RING),
        {
            STRAIGHT: lambda question: question.seen(with_straight(RING)),
            STRAIGHT_ROAD: lambda question: question.seen(CROSSING),
        },
    ),
    Trial(
        'turning_traffic',
        lambda: Question.of(TURNING),
        {MORE: lambda question: question.seen(replace(TURNING, turning_fraction=0.4, vehicles=100))},
        'with a single road',
    ),
    Trial(
        'horizon',
        lambda: Question.of(HALF_BEND),
        {
            STRAIGHT: lambda question: question.seen(with_straight(BEND)),
            STRAIGHT_ROAD: lambda question: question.seen(CROSSING),
        },
    ),
    Trial(
        'too_little_curvature',
        lambda: Question.of(UNDISTORTED, joint=TRAFFIC_ONLY),
        {LENS: tell_lens(UNDISTORTED)},
    ),
    Trial(
        'too_little_curvature',
        lambda: drawn('three_roads', 7, 0),
        {
            STRAIGHT: lambda question: question.seen(more(draw_evidence('three_roads', 7, 0)[0], 4)),
            STRAIGHT_ROAD: lambda question: question.seen(CROSSING),
            LENS: lambda question: tell_lens(draw_evidence('three_roads', 7, 0)[0])(question),
        },
        'with a single road',
    ),
    Trial(
        'lens_model',
        lambda: Question.of(ONE_ROAD, joint=ONE_FAMILY),
        {
            MORE: lambda question: question.seen(more(ONE_ROAD)),
            LENS: tell_lens(ONE_ROAD),
            'increase joint.k1_sigma if the lens is known to differ': lambda question: question.told(
                joint=replace(ONE_FAMILY, k1_sigma=0.05)
            ),
        },
    ),
    Trial(
        'lens_model',
        lambda: Question.of(CROSSING, joint=replace(ONE_FAMILY, lens_prior='distortion_free')),
        {'set joint.lens_prior to auto': lambda question: question.told(joint=replace(ONE_FAMILY, lens_prior='auto'))},
        'family',
    ),
    Trial(
        'halves_disagree',
        lambda: drawn('mixed_views', 0, 28, joint=ONE_FAMILY),
        {
            'fix the camera firmly, and record again': again('mixed_views', 0, 28),
            'record for longer': again('mixed_views', 0, 28, tracks=480),
        },
        'pose',
    ),
    Trial(
        'given_lens',
        lambda: lens_file(CROSSING, focal_px=700.0),
        {
            'give the camera_info file of this camera in this resolution, mode and zoom, and check that K belongs to '
            'the size in the file': lambda question: replace(question, lens=CROSSING.camera),
            'leave the file out': lambda question: replace(question, lens=None),
        },
    ),
    Trial(
        'pixel_aspect',
        lambda: Question(
            squeezed(Evidence.load(GOLDEN / 'skew.npz'), 720, 576), Options(camera_height=8.0, joint=ONE_FAMILY)
        ),
        {
            'set lens.pixel_aspect, the width of a pixel over its height: 1 if the images are not squeezed, else the '
            'shape of the picture over that of the image (720x576 of a 16:9 picture: 1.422)': lambda question: (
                question.told(lens=LensOptions(pixel_aspect=64 / 45))
            )
        },
        'undecided',
    ),
    Trial(
        'one_direction',
        lambda: Question(evidence_once(ONE_ROAD, 2), Options(camera_height=8.0, joint=TRAFFIC_ONLY)),
        {
            CROSS_TRAFFIC: lambda question: question.seen(across_the_road(ONE_ROAD)),
            'set joint.roll_prior_deg if the camera is level': lambda question: question.told(
                joint=replace(TRAFFIC_ONLY, roll_prior_deg=1.0)
            ),
        },
    ),
    Trial(
        'grade_too_low',
        lambda: Question.of(UNDISTORTED),
        {
            'give one more number, a length of some metres along the view on the road to 2 %': lambda question: (
                question.told(scale=length_on(UNDISTORTED, (14.0, -9.5), (21.0, -14.5)))
            )
        },
    ),
    Trial(
        'plane_uncertain',
        lambda: Question.of(
            replace(CROSSING, vehicles=25), joint=TRAFFIC_ONLY, gate=GateOptions(max_sigma_tilt_deg=0.7)
        ),
        {'wait for more traffic on the quieter road': lambda question: question.seen(more(CROSSING))},
    ),
    Trial(
        'plane_uncertain',
        lambda: Question.of(LEVEL_ROAD, joint=replace(ONE_FAMILY, roll_prior_deg=2.0)),
        {CROSS_TRAFFIC: lambda question: question.seen(across_the_road(LEVEL_ROAD))},
        'level_road',
    ),
    Trial(
        'no_height',
        lambda: Question.of(CROSSING).told(camera_height=0.0),
        {
            'give camera_height in metres': lambda question: question.told(camera_height=8.0),
            'give a distance on the road or the mean traffic speed (scale_from)': lambda question: question.told(
                scale=length_on(CROSSING, NEAR_M, FAR_M)
            ),
            'set allow_unit_scale for a plane in units of the height': lambda question: question.told(
                allow_unit_scale=True
            ),
        },
    ),
    Trial(
        'implausible',
        lambda: Question.of(CROSSING).told(camera_height=60.0),
        {
            'check the camera height, lengths and speed that are given, and the focal length': lambda question: (
                question.told(camera_height=8.0)
            )
        },
    ),
    Trial(
        'scale_off_road',
        lambda: Question.of(CROSSING).told(camera_height=0.0, scale=SKY),
        {
            'choose two pixels on the road surface, near to the camera': lambda question: question.told(
                scale=length_on(CROSSING, NEAR_M, FAR_M)
            )
        },
    ),
    Trial(
        'too_few_vehicles',
        lambda: Question.of(RARE).told(camera_height=0.0, scale=ScaleOptions(speed_km_h=36.0)),
        {MORE: lambda question: question.seen(more(RARE))},
    ),
    Trial(
        'scale_uncertain',
        lambda: Question.of(CROSSING).told(camera_height=0.0, scale=replace(SHORT_LENGTH, distance_sigma_m=1.5)),
        {
            'give a longer distance on the road nearer to the camera': lambda question: question.told(
                scale=replace(length_on(CROSSING, NEAR_M, FAR_M), distance_sigma_m=1.5)
            ),
            'give the camera height': lambda question: question.told(camera_height=8.0, scale=ScaleOptions()),
        },
    ),
    Trial(
        'distortion_model',
        lambda: Question.of(CROSSING).told(distortion_model='plumb_bob'),
        {
            'Set distortion_model to rational_polynomial, which is off by': lambda question: question.told(
                distortion_model='rational_polynomial'
            )
        },
    ),
    Trial(
        'vanishing_points_disagree',
        lambda: drawn('skew', 7, 0, method='paper', joint=ONE_FAMILY),
        {
            'the roads are not perpendicular, or the lens is wrong: use method joint': lambda question: question.told(
                method='joint'
            )
        },
    ),
    Trial(
        'one_direction',
        lambda: drawn('one_road', 7, 0, method='paper'),
        {
            'wait for traffic on a second road': lambda question: question.seen(
                across_the_road(draw_evidence('one_road', 7, 0)[0])
            )
        },
        'paper',
    ),
)
NOT_TRIED = {
    'no_markings': 'told inside the message of another code, whose remedy is given',
    'markings_contradicted': 'likewise',
    'markings_unconfirmed': 'likewise',
    'too_little_turning': 'where turning vehicles leave the lens open, the reason of the straight ones is given',
    'grade_too_low-lens': 'the remedy is that of the reason why there is no plane',
    'grade_too_low-no_road_ahead': 'no synthetic junction is seen from straight above',
    'plane_uncertain-edges_and_level': 'tried in vehicle_edges/test_transverse_edges.py',
    'plane_uncertain-lane_changes': 'two estimates that disagree by chance: more traffic settles it',
    'no_height-no_dashes': 'the remedies are those of no_height',
    'no_height-no_lanes': 'likewise',
    'distortion_model-misfit': 'the only message of distortion_model',
}
"""Codes, and causes with a remedy of their own, that no trial makes, and why."""


def test_every_remedy_is_tried() -> None:
    listed = {
        f'{entry.code}-{cause}' if cause else entry.code
        for entry in REFUSALS
        for cause in ('', *(cause for cause, (_, own) in entry.variants.items() if own))
    }
    tried = {number_of(trial) for trial in TRIALS}
    # a variant without a remedy of its own tries that of its code
    tried |= {trial.code for trial in TRIALS if not BY_CODE[trial.code].variants.get(trial.cause, ('', ''))[1]}
    assert listed - tried == set(NOT_TRIED)


def number_of(trial: Trial) -> str:
    return f'{trial.code}-{trial.cause}' if trial.cause else trial.code


@pytest.mark.exhaustive
@pytest.mark.parametrize('trial', TRIALS, ids=number_of)
def test_each_remedy_of_a_refusal_gives_another_verdict(trial: Trial) -> None:
    question = trial.asked()
    refused = refusal_of(question.verdict)
    assert refused is not None and refused.code == trial.code
    assert len(refused.remedy.split(OR)) == len(trial.remedies)
    for printed, tried in zip(sorted(refused.remedy.split(OR)), sorted(trial.remedies), strict=True):
        assert printed.startswith(tried)  # numbers may follow
    for remedy, followed in trial.remedies.items():
        result = followed(question).verdict
        left = refusal_of(result)
        assert result and (left is None or left.code != trial.code), (remedy, left and (left.code, left.message))
