"""All options of the program with their defaults, units and permitted ranges.

Each default stands here only. The replay, the live node and `config/autocalib.yaml` walk these dataclasses. The full
name of an option is its path, for example `tracking.max_points`; an unknown name raises UsageError.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

from autocalib_ros.errors import UsageError

Polygons = tuple[tuple[tuple[float, float], ...], ...]
"""Polygons of points (u, v) in pixels of the full image."""


def option(
    default: Any, doc: str, *, low: float | None = None, high: float | None = None, choices: tuple[str, ...] = ()
) -> Any:
    """Declare a dataclass field with its default, description and permitted values."""
    return field(default=default, metadata={'doc': doc, 'low': low, 'high': high, 'choices': choices})


class _Validated:
    """Validates each field against its declared type, range and choices."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):  # type: ignore[arg-type]
            if 'doc' in item.metadata:
                object.__setattr__(self, item.name, _validated(item, getattr(self, item.name)))


def _validated(item: dataclasses.Field, value: Any) -> Any:
    """Return `value` in the declared type of `item`; raise UsageError that names the accepted values."""
    kind, meta = type(item.default), item.metadata
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not kind:
        raise UsageError(f"option '{item.name}' takes a {kind.__name__}, got {value!r}")
    if meta['choices'] and value not in meta['choices']:
        raise UsageError(f"option '{item.name}' is one of {', '.join(meta['choices'])}; got {value!r}")
    low, high = meta['low'], meta['high']
    if (low is not None and not value >= low) or (high is not None and not value <= high):
        raise UsageError(f"option '{item.name}' lies between {low} and {high}; got {value!r}")
    return value


@dataclass(frozen=True, kw_only=True)
class TrackingOptions(_Validated):
    """Keypoints on moving objects, tracked by pyramidal Lucas-Kanade optical flow."""

    max_points: int = option(200, 'maximum number of points tracked at a time', low=20, high=5000)
    window_px: int = option(11, 'side of the square tracking window, pixels', low=5, high=61)
    pyramid_levels: int = option(3, 'image pyramid levels above full resolution', low=0, high=6)
    detect_every: int = option(6, 'frames between two detections of keypoints and segments', low=1, high=100)
    min_spacing_px: float = option(
        10.0, 'side of the grid cells that hold at most one point each, pixels', low=1, high=100
    )
    round_trip_px: float = option(0.7, 'maximum forward-backward error of a tracked point, pixels', low=0.05, high=10)
    max_samples: int = option(100, 'maximum points stored per track, evenly spaced along it', low=8, high=500)


@dataclass(frozen=True, kw_only=True)
class MotionOptions(_Validated):
    """Motion mask: background subtraction with a slowly updated background."""

    width_px: int = option(320, 'image width for background subtraction, pixels', low=80, high=1920)
    history_s: float = option(20.0, 'time constant of the background model, seconds', low=1, high=600)
    min_area: float = option(0.00015, 'minimum area of a moving region, fraction of the image', low=0, high=0.1)


@dataclass(frozen=True, kw_only=True)
class DetectorOptions(_Validated):
    """Vehicle detector in ONNX. auto: taken from the metadata, inputs and outputs of the model."""

    model: str = option('', 'path of the ONNX file; empty: no detector, moving regions are taken as vehicles')
    layout: str = option(
        'auto',
        'output layout of the model; auto: recognised by the shapes and names of its outputs',
        choices=(
            'auto',
            'yolox',
            'yolox_decoded',
            'yolov3',
            'yolov5',
            'yolov7_end2end',
            'yolov8',
            'end_to_end',
            'yolo_nas',
            'rtdetr',
            'ultralytics_rtdetr',
            'detr',
            'tf_od',
            'detection_output',
        ),
    )
    input_size: int = option(
        0,
        'longest side of the input image for a model with dynamic input size, pixels; 0: that of the camera, '
        'at most 1280. Images are never enlarged',
        low=0,
        high=8192,
    )
    confidence: float = option(0.4, 'minimum score of a detection', low=0.01, high=1)
    nms_iou: float = option(
        0.5,
        'non-maximum suppression: maximum intersection over union of two detections, across classes',
        low=0.05,
        high=1,
    )
    class_ids: str = option(
        '',
        "class ids of vehicles and, after a slash, of people, as text: '2 3 5 7 / 0 1' for COCO; empty: by the "
        'class names in the model, else COCO',
    )
    channel_order: str = option(
        'auto',
        'channel order of the input; auto: bgr for yolox, else rgb',
        choices=('auto', 'bgr', 'rgb'),
    )
    input_scale: float = option(
        0.0, 'input value of a white pixel, 255 or 1; 0: automatic, 255 for yolox, else 1', low=0, high=65535
    )
    mean_std: str = option(
        'auto',
        'input normalisation by the ImageNet mean and standard deviation; auto: imagenet for detr, else none',
        choices=('auto', 'none', 'imagenet'),
    )
    resize_mode: str = option(
        'auto',
        'how images are resized to the input size: top_left pads at the right and below, centred pads on all sides, '
        'stretch does not keep the aspect ratio; auto: by the layout',
        choices=('auto', 'top_left', 'centred', 'stretch'),
    )
    providers: str = option(
        'CPUExecutionProvider',
        "execution providers of onnxruntime in order of preference, as text: 'TensorrtExecutionProvider "
        "CUDAExecutionProvider' for example",
    )
    threads: int = option(1, 'CPU threads for one inference', low=1, high=256)
    every_s: float = option(
        0.2,
        'seconds between two detections, every sixth image at 30 Hz; between them boxes follow the tracked points',
        low=0.01,
        high=10,
    )

    def __post_init__(self) -> None:
        if isinstance(self.class_ids, int) and not isinstance(self.class_ids, bool):
            object.__setattr__(self, 'class_ids', str(self.class_ids))  # YAML parses a single class id as an int
        super().__post_init__()
        _ = self.chosen_classes

    @property
    def chosen_classes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Class ids of vehicles and of people from `class_ids`; two empty tuples if it is empty."""
        vehicles, _, people = self.class_ids.replace(',', ' ').partition('/')
        try:
            chosen = tuple(map(int, vehicles.split())), tuple(map(int, people.split()))
        except ValueError:
            chosen = (), (-1,)
        if min(sum(chosen, ()), default=0) < 0 or (self.class_ids.strip() and not chosen[0]):
            raise UsageError(
                "option 'class_ids' takes whole numbers in one text, vehicles first, people after a slash, for example "
                f"'2 3 5 7 / 0 1'; got {self.class_ids!r}"
            )
        return chosen


@dataclass(frozen=True, kw_only=True)
class BufferOptions(_Validated):
    """Evidence buffer: age and number of stored observations."""

    seconds: float = option(
        900.0,
        'maximum age of evidence, seconds. Older evidence is dropped once enough newer vehicles took the same path '
        'through the same part of the image, and all of it after the camera moved',
        low=5,
        high=86400,
    )
    max_tracks: int = option(
        8000, 'maximum number of tracks; the most redundant vehicles are dropped first', low=50, high=100000
    )
    max_segments: int = option(
        20000, 'maximum number of segments; the most redundant vehicles are dropped first', low=100, high=1000000
    )
    max_edges: int = option(
        10000,
        'maximum number of straight vehicle edges; the most redundant vehicles are dropped first',
        low=100,
        high=1000000,
    )
    max_outlines: int = option(
        8000,
        'maximum number of silhouettes of moving objects, used to classify cyclists; the most redundant vehicles are '
        'dropped first',
        low=100,
        high=1000000,
    )


@dataclass(frozen=True, kw_only=True)
class PaperOptions(_Validated):
    """Constants of the published method (Jain & Saunier, arXiv 2001.07243)."""

    window_s: float = option(6.0, 'observation interval that a track must span, seconds', low=1, high=600)
    min_lifetime: float = option(
        0.8, 'minimum lifetime of a track, fraction of the observation interval', low=0, high=1
    )
    max_path_ratio: float = option(1.2, 'maximum ratio of path length to displacement', low=1, high=10)
    longest: int = option(10, 'number of longest tracks used for the focal length', low=1, high=10000)
    focal_steps: int = option(300, 'number of trial focal lengths up to the image diagonal', low=10, high=10000)
    cluster_deg: float = option(5.0, 'half width of an orientation cluster, degrees', low=0.5, high=30)
    min_separation_deg: float = option(25.0, 'minimum angle between the two orientations, degrees', low=5, high=90)
    vote_share: float = option(0.8, 'threshold of the vanishing point votes, fraction of the maximum', low=0.1, high=1)
    vote_sigmas: float = option(
        2.0, 'outward offset of the vanishing point from the mean, standard deviations', low=0, high=5
    )


@dataclass(frozen=True, kw_only=True)
class LensOptions(_Validated):
    """What is known of the lens and its images besides the camera_info file."""

    focal_px: float = option(
        0.0, 'focal length of the lens, as from its data sheet, pixels; 0: unknown', low=0, high=1e6
    )
    focal_sigma_px: float = option(0.0, 'standard deviation of lens.focal_px, pixels; 0: 10 % of it', low=0, high=1e6)
    hfov_deg: float = option(
        0.0, 'field of view across the image, as from the data sheet, degrees; 0: unknown', low=0, high=180
    )
    hfov_sigma_deg: float = option(0.0, 'standard deviation of lens.hfov_deg, degrees; 0: 10 % of it', low=0, high=90)
    pixel_aspect: float = option(
        0.0,
        'width of a pixel over its height (sample aspect ratio), for images that a recorder squeezed: 1.4222 for '
        '720x576 of a 16:9 picture, 2 for 960x1080; 1: square; 0: as the video file says, else tested by the traffic',
        low=0,
        high=10,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.focal_px > 0 and self.hfov_deg > 0:
            raise UsageError("give 'lens.focal_px' or 'lens.hfov_deg', not both: either follows from the other")

    def pixel_aspect_or(self, recorded: float) -> float:
        """Return the pixel aspect of the option, else that of the recording (0: it says nothing), else 1."""
        return self.pixel_aspect or recorded or 1.0


@dataclass(frozen=True, kw_only=True)
class JointOptions(_Validated):
    """Robust method: joint bundle adjustment of lens, roads and ground plane."""

    max_tracks: int = option(
        1500, 'maximum number of tracks in one solution, spread over image, roads and time', low=20, high=10000
    )
    noise_px: float = option(0.3, 'standard deviation of a tracked position, pixels', low=0.01, high=10)
    wander_m: float = option(
        0.06, 'standard deviation of the lateral deviation from a straight path, metres', low=0, high=2
    )
    drift_px: float = option(
        0.05,
        'tracking drift: standard deviation after one pixel of travel; grows with the square root of the travel',
        low=0,
        high=1,
    )
    heading_deg: float = option(
        0.25, "tracking drift: standard deviation of a track's heading about its road, degrees", low=0, high=5
    )
    lens_prior: str = option(
        'auto',
        'lens family: auto selects by the traffic, kannala_brandt allows any lens between the other two',
        choices=('auto', 'equidistant', 'distortion_free', 'kannala_brandt'),
    )
    focal_prior_px: float = option(0.0, 'prior focal length, pixels; 0: unknown', low=0, high=1e6)
    focal_sigma_px: float = option(
        0.0, 'standard deviation of focal_prior_px, pixels; 0: fixed at the prior', low=0, high=1e6
    )
    k1_sigma: float = option(
        0.03, 'standard deviation of k1 about the value of its family; 0: fixed at that value', low=0, high=1
    )
    principal_point_sigma_px: float = option(
        -1.0,
        'standard deviation of the principal point about the image centre, pixels; 0: fixed at the centre, '
        'negative: 1 % of the image width',
        low=-1,
        high=10000,
    )
    road_angle: str = option(
        'auto',
        'angle between the two busiest roads, degrees; auto: test whether it is 90, free: do not use it',
    )
    roll_prior_deg: float = option(
        0.0,
        'single road: standard deviation of the roll of a level camera, degrees; gives a ground plane of grade '
        'fair at most; 0: no such assumption',
        low=0,
        high=10,
    )
    transverse_edges: bool = option(
        True,
        'single road: assume that bumpers, windscreens and roof lines of vehicles are perpendicular to it; gives a '
        'ground plane of grade fair at most',
    )
    single_road: bool = option(
        True,
        'single road: assume usual fields of view, a level camera within 3 degrees, and edges and lines along, across '
        'and upright to it; gives lens and ground plane with the uncertainty that this leaves',
    )
    road_markings: bool = option(
        True,
        'when traffic alone gives no full result: assume that lane lines, stop lines, crosswalks and kerbs are '
        'parallel or perpendicular; gives lens and ground plane of grade fair at most if traffic confirms them',
    )

    def __post_init__(self) -> None:
        if isinstance(self.road_angle, (int, float)) and not isinstance(self.road_angle, bool):
            object.__setattr__(self, 'road_angle', f'{self.road_angle:g}')  # YAML parses an angle as a number
        super().__post_init__()
        if self.road_angle not in ('auto', 'free') and self.crossing_deg is None:
            raise UsageError(
                f"option 'road_angle' is auto, free, or an angle between 10 and 170 degrees; got {self.road_angle!r}"
            )

    @property
    def crossing_deg(self) -> float | None:
        """The given angle between the roads in degrees; None for auto and free."""
        try:
            angle = float(self.road_angle)
        except ValueError:
            return None
        return angle if 10.0 <= angle <= 170.0 else None

    @property
    def crossing_rad(self) -> float | None:
        """The given angle between the roads in radians; None for auto and free."""
        return None if self.crossing_deg is None else math.radians(self.crossing_deg)


@dataclass(frozen=True)
class KnownDistance:
    """A straight distance on the road between two pixels of the full image."""

    pixels: tuple[tuple[float, float], ...]
    """(u, v) of both ends."""
    metres: float


def _numbers_in(text: object) -> list[float] | None:
    """Return the finite numbers of a text, separated by blanks or commas; None where it holds anything else."""
    try:
        numbers = [float(word) for word in str.replace(text, ',', ' ').split()]  # type: ignore[arg-type]
    except (TypeError, ValueError):  # not text, or not numbers
        return None
    return numbers if all(map(math.isfinite, numbers)) else None


def _known_distance(text: object) -> KnownDistance:
    """Parse one distance of `distances`; raise UsageError with the expected form."""
    numbers = _numbers_in(text) or []
    if len(numbers) != 5 or not 0 < numbers[4] <= 1000:
        raise UsageError(
            "option 'scale.distances' takes five numbers for each distance, two pixels and up to 1000 metres, with ; "
            f"between, for example '412 530 888 530 12.5; 400 300 420 420 30'; got {text!r}"
        )
    return KnownDistance(((numbers[0], numbers[1]), (numbers[2], numbers[3])), numbers[4])


MIN_PIXEL_SEPARATION_SIGMAS = 10.0
"""Minimum distance of the two pixels of a known length, in units of their standard deviation: 10 % of the scale."""


@dataclass(frozen=True, kw_only=True)
class ScaleOptions(_Validated):
    """Metric scale of the ground plane from known distances or speed, besides the camera height."""

    distance_px: str = option(
        '', "two road pixels of the full image with a known distance between them, as text: 'u1 v1 u2 v2'"
    )
    distances: str = option(
        '', "further known distances, as text: 'u1 v1 u2 v2 metres; ...', two road pixels of the full image each"
    )
    distance_m: float = option(0.0, 'straight distance between them on the road, metres; 0: unknown', low=0, high=1000)
    distance_sigma_m: float = option(0.05, 'standard deviation of distance_m, metres', low=0, high=100)
    pixel_sigma_px: float = option(1.0, 'standard deviation of each coordinate of distance_px, pixels', low=0, high=100)
    speed_km_h: float = option(
        0.0,
        'mean speed of free-flowing traffic on the busiest road, as measured by a loop or a radar, km/h; 0: unknown',
        low=0,
        high=300,
    )
    speed_sigma_km_h: float = option(5.0, 'standard deviation of the mean speed speed_km_h, km/h', low=0, high=100)
    point_height_m: float = option(
        0.75,
        'mean height above the road of tracked points on vehicles, about half the height of a car, metres',
        low=0,
        high=5,
    )
    point_height_sigma_m: float = option(
        0.3, 'standard deviation of the mean height point_height_m, metres', low=0, high=5
    )

    def __post_init__(self) -> None:
        distances = self.known_distances
        super().__post_init__()
        separation = min((math.dist(*distance.pixels) for distance in distances), default=math.inf)
        if separation < max(MIN_PIXEL_SEPARATION_SIGMAS * self.pixel_sigma_px, 1.0):
            raise UsageError(
                f'the pixels of a known distance are {separation:.1f} px apart, too close for a scale when '
                f'each has a standard deviation of {self.pixel_sigma_px:g} px: choose two pixels farther apart'
            )

    @property
    def pixels(self) -> tuple[tuple[float, float], ...]:
        """The two pixels (u, v) of `distance_px`; empty if it is empty."""
        numbers = _numbers_in(self.distance_px)
        if numbers is None or len(numbers) not in (0, 4):
            raise UsageError(
                "option 'scale.distance_px' takes four numbers in one text, for example '412 530 888 530'; "
                f'got {self.distance_px!r}'
            )
        return tuple(zip(numbers[::2], numbers[1::2], strict=True))

    @property
    def known_distances(self) -> tuple[KnownDistance, ...]:
        """All known distances: that of `distance_px`, and those of `distances`."""
        texts = map(str.strip, self.distances.split(';')) if isinstance(self.distances, str) else [self.distances]
        given = [text for text in texts if text != '']
        first = (KnownDistance(self.pixels, self.distance_m),) if self.pixels else ()
        return (*first, *map(_known_distance, given))

    def require_inside(self, width: int, height: int) -> None:
        """Raise UsageError if a pixel of a known distance lies outside an image of `width` x `height`."""
        for u, v in (pixel for distance in self.known_distances for pixel in distance.pixels):
            if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
                raise UsageError(
                    f'pixel ({u:g}, {v:g}) of a known distance lies outside the images, which have {width}x{height}:'
                    ' give pixels of the full image as the camera sends it'
                )


@dataclass(frozen=True, kw_only=True)
class LaneOptions(_Validated):
    """Lane lines of known pattern: lanes of known width, dashes of known period."""

    country: str = option(
        'none',
        'country whose standard lane width and dash periods are taken for what is not given as a number',
        choices=('none', 'us', 'uk', 'de', 'fr', 'cn'),
    )
    width_m: float = option(
        0.0,
        'width of the lanes, from the middle of one line to that of the next, metres; 0: by lanes.country, else '
        'unknown',
        low=0,
        high=10,
    )
    width_sigma_m: float = option(0.0, 'standard deviation of lanes.width_m, metres; 0: 4 % of it', low=0, high=5)
    dash_period_m: float = option(
        0.0,
        'length of a dash and of the gap after it, together, metres; 0: by lanes.country, else unknown',
        low=0,
        high=50,
    )
    dash_period_sigma_m: float = option(
        0.0, 'standard deviation of lanes.dash_period_m, metres; 0: 2 % of it', low=0, high=25
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ('width', 'dash_period'):
            if getattr(self, f'{name}_sigma_m') > 0 and not getattr(self, f'{name}_m') > 0:
                raise UsageError(f"'lanes.{name}_sigma_m' needs 'lanes.{name}_m': give both or neither")

    @property
    def given(self) -> bool:
        """Whether anything is known of the lanes."""
        return self.country != 'none' or self.width_m > 0 or self.dash_period_m > 0


@dataclass(frozen=True, kw_only=True)
class GateOptions(_Validated):
    """Acceptance limits of a calibration."""

    min_tracks: int = option(40, 'minimum number of tracks', low=4, high=100000)
    min_tracks_per_road: int = option(10, 'minimum number of tracks on each of two roads', low=2, high=100000)
    min_coverage: float = option(0.15, 'minimum fraction of image cells crossed by tracks', low=0, high=1)
    least_grade: str = option(
        'auto',
        'lowest grade that is accepted: full, fair, coarse or assumed; auto: fair for what the node publishes, coarse '
        'for a recording',
        choices=('auto', 'full', 'fair', 'coarse', 'assumed'),
    )
    max_sigma_focal_rel: float = option(
        0.25, 'maximum standard deviation of a focal length from traffic, fraction of it', low=0, high=1
    )
    max_sigma_tilt_deg: float = option(5.0, 'maximum standard deviation of the ground normal, degrees', low=0, high=45)
    max_sigma_height_rel: float = option(
        0.5, 'maximum standard deviation of the camera height, fraction of it', low=0, high=1
    )
    max_drift_px: float = option(
        3.0,
        'maximum lasting displacement of the background of a fixed camera, pixels at an image width of 1280; at least '
        '1.5 px of the image',
        low=0.1,
    )

    @property
    def least(self) -> str:
        """The lowest grade that is accepted; that of a recording where the option leaves it open."""
        return 'coarse' if self.least_grade == 'auto' else self.least_grade


@dataclass(frozen=True, kw_only=True)
class Options(_Validated):
    """Options of the core, shared by replay and live node."""

    method: str = option(
        'joint',
        'estimation method; joint: robust bundle adjustment, paper: as published by Jain & Saunier',
        choices=('joint', 'paper'),
    )
    scale_from: str = option(
        'all',
        'source of the metric scale; all: camera height, distances on the road, the mean traffic speed and the lanes, '
        'as many of them as are given; the others: only that one may be given',
        choices=('all', 'height', 'distance', 'speed'),
    )
    camera_height: float = option(0.0, 'height of the camera above the road, metres; 0: unknown', low=0, high=500)
    camera_height_sigma: float = option(0.0, 'standard deviation of camera_height, metres; 0: exact', low=0, high=100)
    allow_unit_scale: bool = option(
        False, 'publish the ground plane in units of the camera height if the height is unknown'
    )
    distortion_model: str = option(
        'auto',
        'distortion model of the published CameraInfo; auto: equidistant, which is exact; kannala_brandt: the same '
        'lens by the name that Foxglove reads. The others are fitted to the visible field and refused if the error '
        'exceeds 0.5 px',
        choices=('auto', 'equidistant', 'kannala_brandt', 'rational_polynomial', 'plumb_bob'),
    )
    rectified_balance: float = option(
        0.0,
        'crop of the rectified image, P of CameraInfo; 0: valid pixels only, 1: the whole field of view up to 80 '
        'degrees from the optical axis',
        low=0,
        high=1,
    )
    tf_parent: str = option(
        'ground',
        'parent frame of the ground transform; camera: for a camera frame that already has a parent, so that the '
        'ground frame is the child',
        choices=('ground', 'camera'),
    )
    max_image_width: int = option(
        1280, 'maximum image width for tracking, pixels; wider images are scaled down', low=160, high=16384
    )
    ignore_regions: str = option(
        '',
        "polygons in pixels of the full image, as text 'u1 v1 u2 v2 u3 v3; ...', excluded from tracking and blacked "
        'out in all written pictures',
    )
    random_seed: int = option(0, 'seed of the consensus searches', low=0)
    first_solve_s: float = option(10.0, 'recording time before the first solution, seconds', low=0)
    solve_growth: float = option(1.2, 'growth factor of the evidence that triggers a new solution', low=1.01)
    solve_interval_s: float = option(5.0, 'minimum recording time between two solutions, seconds', low=0.1)
    tracking: TrackingOptions = field(default_factory=TrackingOptions)
    motion: MotionOptions = field(default_factory=MotionOptions)
    detector: DetectorOptions = field(default_factory=DetectorOptions)
    buffer: BufferOptions = field(default_factory=BufferOptions)
    paper: PaperOptions = field(default_factory=PaperOptions)
    lens: LensOptions = field(default_factory=LensOptions)
    joint: JointOptions = field(default_factory=JointOptions)
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    lanes: LaneOptions = field(default_factory=LaneOptions)
    gate: GateOptions = field(default_factory=GateOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_consistent_scale()
        _ = self.ignored_polygons

    @property
    def gives_scale(self) -> bool:
        """Whether anything gives a scale in metres."""
        return bool(self.camera_height or self.scale.known_distances or self.scale.speed_km_h or self.lanes.given)

    @property
    def ignored_polygons(self) -> Polygons:
        """Polygons of `ignore_regions`, each of at least three points (u, v); empty if it is empty."""
        return tuple(
            _polygon(text) for text in self.ignore_regions.strip().rstrip(';').split(';') if self.ignore_regions.strip()
        )

    def _require_consistent_scale(self) -> None:
        """Raise UsageError unless the values that `scale_from` needs are given, and only those if it names one."""
        scale = self.scale
        parts = {
            'height': {'camera_height': self.camera_height > 0},
            'distance': {
                'scale.distance_px': bool(scale.pixels),
                'scale.distance_m': scale.distance_m > 0,
                'scale.distances': bool(scale.distances.strip()),
            },
            'speed': {'scale.speed_km_h': scale.speed_km_h > 0},
            'lanes': {
                'lanes.country': self.lanes.country != 'none',
                'lanes.width_m': self.lanes.width_m > 0,
                'lanes.dash_period_m': self.lanes.dash_period_m > 0,
            },
        }
        given = {source: [name for name, there in names.items() if there] for source, names in parts.items()}
        for source, names in given.items():
            if self.scale_from not in ('all', source) and names:
                raise UsageError(
                    f"the scale comes from one source: 'scale_from' is {self.scale_from}, but '{names[0]}' is given "
                    "too; remove it, or set 'scale_from' to all, which uses both"
                )
        if self.scale_from in ('distance', 'speed') and not given[self.scale_from]:
            raise UsageError(f"'scale_from' {self.scale_from} needs '{next(iter(parts[self.scale_from]))}'")
        pair = ('scale.distance_px', 'scale.distance_m')
        missing = [name for name in pair if name not in given['distance']]
        if len(missing) == 1:
            raise UsageError(f"a known distance needs '{missing[0]}': give both or neither of {' and '.join(pair)}")
        if self.camera_height_sigma > 0 and not self.camera_height > 0:
            raise UsageError("'camera_height_sigma' needs 'camera_height': give both or neither")
        if scale.speed_km_h > 0 and self.method == 'paper':
            raise UsageError(
                "'method' paper does not assign traffic to roads: use the height or distance with it, not the speed"
            )


@dataclass(frozen=True, kw_only=True)
class NodeOptions(_Validated):
    """Options of the live node; the replay accepts and ignores them in a shared file."""

    image_transport: str = option(
        'raw',
        'image topic type: sensor_msgs/Image, or CompressedImage on <image>/compressed',
        choices=('raw', 'compressed'),
    )
    image_reliability: str = option(
        'auto',
        'reliability of the image subscription; auto: that of the publisher',
        choices=('auto', 'reliable', 'best_effort'),
    )
    camera_name: str = option(
        '', 'name used for frames and files; empty: the namespace, else the frame_id of the images'
    )
    camera_frame: str = option('', 'frame of the camera; empty: the frame_id of the images')
    ground_frame: str = option('', 'frame of the ground plane; empty: <camera_name>_ground')
    camera_info_file: str = option(
        '',
        'path of a known lens in the format of camera_info_manager, then only the pose is estimated; empty: the '
        'lens is estimated too',
    )
    control_points: str = option(
        '',
        'path of control points (CSV or .otrfpts): ~/map_transform places the ground frame in their map; empty: none',
    )
    map_frame: str = option('map', 'frame of the map, the parent of the ground frame in ~/map_transform')
    publish_tf: bool = option(True, 'also publish the ground transform on /tf_static, if tf2_msgs is installed')
    camera_info_url: str = option(
        '',
        'where the calibration is stored, in the URL syntax of camera_info_manager: file:///... or '
        'package://PACKAGE/..., with ${NAME} and ${ROS_HOME}; empty: file://${ROS_HOME}/camera_info/${NAME}.yaml',
    )
    autosave: bool = option(
        True, 'store each new calibration at camera_info_url, at most once a minute; false: only ~/save writes'
    )
    upload_to_driver: bool = option(
        False, "send each new calibration to the driver's set_camera_info service, at most once a minute"
    )
    use_driver_camera_info: bool = option(
        False,
        "subscribe to the driver's CameraInfo on camera_info_in, copy its binning and roi, and compare its size with "
        'that of the images',
    )
    camera_info_mode: str = option(
        'per_image',
        'when camera_info is published: with each image, or only when it changes',
        choices=('per_image', 'latched_only'),
    )
    solve_limit_s: float = option(
        900.0,
        'time limit of one solution, seconds; a solution that takes longer is stopped, and the solver restarted',
        low=1.0,
    )
    services: bool = option(
        True,
        'offer ~/calibrate, ~/save and ~/reset; false: nobody on the network can withdraw or store a calibration',
    )
    on_move: str = option(
        'mend',
        'what is published after the camera has moved, and while the picture shows nothing usable; mend: after a turn '
        'the pose corrected by the picture, else nothing; withhold: nothing until traffic gives a new calibration; '
        'keep: the stale calibration. /diagnostics and ~/status report it in any case',
        choices=('mend', 'withhold', 'keep'),
    )
    debug_rate_hz: float = option(
        5.0,
        'maximum rate of each of debug_image, top_view and image_rect, Hz; drawn only while subscribed',
        low=0.1,
        high=1000,
    )
    idle_solve_s: float = option(
        3.0, 'time without images after which the remaining evidence is solved, seconds', low=0.1
    )


MAX_PIXEL_COORDINATE = 1e5
"""Maximum absolute pixel coordinate of a polygon; no image is larger."""


def _polygon(text: str) -> tuple[tuple[float, float], ...]:
    """Parse one polygon of `ignore_regions`; raise UsageError with the expected form."""
    numbers = _numbers_in(text) or []
    if len(numbers) < 6 or len(numbers) % 2 or not all(abs(number) <= MAX_PIXEL_COORDINATE for number in numbers):
        raise UsageError(
            "option 'ignore_regions' is polygons of at least three pixels u v each, separated by ;, for example "
            f"'0 0 200 0 0 150; 900 0 1279 0 1279 90'; got the polygon {text.strip()!r}"
        )
    return tuple(zip(numbers[::2], numbers[1::2], strict=True))


RECONFIGURABLE = (
    'method',
    'scale_from',
    'camera_height',
    'camera_height_sigma',
    'allow_unit_scale',
    'random_seed',
    'first_solve_s',
    'solve_growth',
    'solve_interval_s',
    'paper',
    'lens',
    'joint',
    'scale',
    'lanes',
    'gate',
    'camera_info_mode',
    'on_move',
    'debug_rate_hz',
    'idle_solve_s',
)
"""Options and groups of options that a running node can change: they are read at each solution or publication. All
others shape the evidence from the first image on, or other settings depend on them."""


def is_reconfigurable(name: str) -> bool:
    """Return whether a running node can change the option of this full name."""
    return name in RECONFIGURABLE or name.partition('.')[0] in RECONFIGURABLE


@dataclass(frozen=True)
class OptionSpec:
    """One option by its full name, as ROS parameters, the YAML file and the reference page list it."""

    name: str
    default: Any
    doc: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]


def walk_options(options: Any, prefix: str = '') -> Iterator[OptionSpec]:
    """Yield each option of a dataclass instance by its full name, its present value as the default."""
    for item in dataclasses.fields(options):
        value = getattr(options, item.name)
        if dataclasses.is_dataclass(value):
            yield from walk_options(value, f'{prefix}{item.name}.')
        else:
            meta = item.metadata
            yield OptionSpec(prefix + item.name, value, meta['doc'], meta['low'], meta['high'], meta['choices'])


def with_overrides(options: Any, values: Mapping[str, Any]) -> Any:
    """Return `options` with the values given by full name; raise UsageError at an unknown name."""
    names = [item.name for item in walk_options(options)]
    for name in values:
        if name not in names:
            near = get_close_matches(name, names, n=1)
            hint = f"; did you mean '{near[0]}'?" if near else '; see config/autocalib.yaml for all names'
            raise UsageError(f"unknown option '{name}'{hint}")
    return _replace_nested(options, values, '')


def _replace_nested(options: Any, values: Mapping[str, Any], prefix: str) -> Any:
    changes: dict[str, Any] = {}
    for item in dataclasses.fields(options):
        name, value = prefix + item.name, getattr(options, item.name)
        if dataclasses.is_dataclass(value):
            changes[item.name] = _replace_nested(value, values, name + '.')
        elif name in values:
            changes[item.name] = values[name]
    return dataclasses.replace(options, **changes)


def flatten(tree: Mapping[str, Any], prefix: str = '') -> dict[str, Any]:
    """Return a nested mapping, as YAML gives it, as values by full name."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f'{prefix}{key}.'))
        else:
            flat[f'{prefix}{key}'] = value
    return flat
