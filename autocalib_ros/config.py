"""Every option of the program and its default: they live here and nowhere else.

The replay, the live node and `config/autocalib.yaml` walk these dataclasses. An option's full name is
its path, `tracking.max_points` say; an unknown name is an error.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any

from autocalib_ros.errors import UsageError


def option(
    default: Any, doc: str, *, low: float | None = None, high: float | None = None, choices: tuple[str, ...] = ()
) -> Any:
    """Declare a field with its default, description and permitted values."""
    return field(default=default, metadata={'doc': doc, 'low': low, 'high': high, 'choices': choices})


class _Validated:
    """Checks every field against its declared type, range and choices."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):  # type: ignore[arg-type]
            if 'doc' in item.metadata:
                object.__setattr__(self, item.name, _validated(item, getattr(self, item.name)))


def _validated(item: dataclasses.Field, value: Any) -> Any:
    """Return the value of `item` in its declared type, or say what would be accepted."""
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
    """Points on moving objects, followed by pyramidal Lucas-Kanade optical flow."""

    max_points: int = option(200, 'points followed at once', low=20, high=5000)
    window_px: int = option(11, 'side of the square patch that is followed', low=5, high=61)
    pyramid_levels: int = option(3, 'image pyramid levels above the full resolution', low=0, high=6)
    detect_every: int = option(6, 'frames between two searches for new points and segments', low=1, high=100)
    min_spacing_px: float = option(10.0, 'side of the cells of which each holds one point at the most', low=1, high=100)
    round_trip_px: float = option(0.7, 'a point is lost when following it back misses by more', low=0.05, high=10)
    max_samples: int = option(100, 'points kept of one track, spread evenly along it', low=8, high=500)


@dataclass(frozen=True, kw_only=True)
class MotionOptions(_Validated):
    """Vehicle mask by motion: what differs from a slowly learned background."""

    width_px: int = option(320, 'width at which motion is looked for', low=80, high=1920)
    history_s: float = option(20.0, 'time constant of the learned background', low=1, high=600)
    min_area: float = option(0.00015, 'least area of a moving region, share of the image', low=0, high=0.1)


@dataclass(frozen=True, kw_only=True)
class DetectorOptions(_Validated):
    """Vehicles by a detector in ONNX; auto goes by what the model says of itself, whatever else is set wins."""

    model: str = option('', "ONNX file of the detector; '' is none: vehicles are what moves")
    layout: str = option(
        'auto',
        'how the model says its boxes: auto tells by the shapes and names of its outputs',
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
        'longest side of the image for a model that takes any size, pixels; 0 is that of the '
        'camera up to 1280; smaller images are never enlarged',
        low=0,
        high=8192,
    )
    confidence: float = option(0.4, 'least score of a detection', low=0.01, high=1)
    nms_iou: float = option(
        0.5,
        'of two boxes whose overlap is a larger share of their union, one is left, whatever their classes',
        low=0.05,
        high=1,
    )
    class_ids: str = option(
        '',
        "numbers of the model's classes that are vehicles and, after a slash, people, as text: "
        "'2 3 5 7 / 0 1' is COCO; '' goes by the names in the model, else COCO",
    )
    channel_order: str = option(
        'auto',
        'order of the colours that the model takes; auto: bgr for yolox, else rgb',
        choices=('auto', 'bgr', 'rgb'),
    )
    input_scale: float = option(
        0.0, 'what the model takes for white, 255 or 1; 0 is auto: 255 for yolox, else 1', low=0, high=65535
    )
    mean_std: str = option(
        'auto',
        "whether colours are normalised by ImageNet's mean and standard deviation; auto: for detr",
        choices=('auto', 'none', 'imagenet'),
    )
    resize_mode: str = option(
        'auto',
        'how an image comes to the size of the model: padded at the right and below, padded all around, or '
        'stretched; auto goes by the layout',
        choices=('auto', 'top_left', 'centred', 'stretch'),
    )
    providers: str = option(
        'CPUExecutionProvider',
        'execution providers of onnxruntime, the preferred one first, as '
        "text: 'TensorrtExecutionProvider CUDAExecutionProvider' say",
    )
    threads: int = option(1, 'threads of one detection on the processor', low=1, high=256)
    every_s: float = option(
        0.2,
        'seconds between two detections: every sixth image at 30 Hz; in between boxes follow '
        'the points on their vehicles',
        low=0.01,
        high=10,
    )

    def __post_init__(self) -> None:
        if isinstance(self.class_ids, int) and not isinstance(self.class_ids, bool):
            object.__setattr__(self, 'class_ids', str(self.class_ids))  # YAML reads one class as a number
        super().__post_init__()
        _ = self.chosen_classes

    @property
    def chosen_classes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Classes of vehicles and of people in `class_ids`; two empty tuples where it is empty."""
        vehicles, _, people = self.class_ids.replace(',', ' ').partition('/')
        try:
            chosen = tuple(map(int, vehicles.split())), tuple(map(int, people.split()))
        except ValueError:
            chosen = (), (-1,)
        if min(sum(chosen, ()), default=0) < 0 or (self.class_ids.strip() and not chosen[0]):
            raise UsageError(
                "option 'class_ids' is whole numbers in one text, vehicles first and people after a "
                f"slash, '2 3 5 7 / 0 1' for example; got {self.class_ids!r}"
            )
        return chosen


@dataclass(frozen=True, kw_only=True)
class BufferOptions(_Validated):
    """The buffer of evidence, bounded in number."""

    seconds: float = option(
        900.0,
        'evidence older than this is forgotten where enough newer vehicles went the same way through the same '
        'part of the image, and all of it when the camera moved',
        low=5,
        high=86400,
    )
    max_tracks: int = option(
        8000, 'tracks kept at the most; vehicles that add least to newer ones go first', low=50, high=100000
    )
    max_segments: int = option(
        20000, 'segments kept at the most; vehicles that add least to newer ones go first', low=100, high=1000000
    )
    max_edges: int = option(
        10000,
        'straight edges on vehicles kept at the most; vehicles that add least to newer ones go first',
        low=100,
        high=1000000,
    )
    max_outlines: int = option(
        8000,
        'outlines of what moves kept at the most, by which cyclists are told; those that '
        'add least to newer ones go first',
        low=100,
        high=1000000,
    )


@dataclass(frozen=True, kw_only=True)
class PaperOptions(_Validated):
    """Constants of Jain & Saunier's method as published."""

    window_s: float = option(6.0, 'observed interval that a track has to fill', low=1, high=600)
    min_lifetime: float = option(0.8, 'least share of the interval that a track lived', low=0, high=1)
    max_path_ratio: float = option(1.2, 'largest path length / displacement', low=1, high=10)
    longest: int = option(10, 'number of tracks used for the focal length', low=1, high=10000)
    focal_steps: int = option(300, 'trial focal lengths up to the image diagonal', low=10, high=10000)
    cluster_deg: float = option(5.0, 'half width of a cluster of orientations', low=0.5, high=30)
    min_separation_deg: float = option(25.0, 'least angle between the two orientations', low=5, high=90)
    vote_share: float = option(0.8, 'a cell counts when it has this share of the most votes', low=0.1, high=1)
    vote_sigmas: float = option(2.0, 'the vanishing point lies so many sigmas outwards of the mean', low=0, high=5)


@dataclass(frozen=True, kw_only=True)
class JointOptions(_Validated):
    """The robust method."""

    max_tracks: int = option(1500, 'tracks in one solution, spread over image, roads and time', low=20, high=10000)
    noise_px: float = option(0.3, 'standard deviation of a tracked position', low=0.01, high=10)
    wander_m: float = option(0.06, "standard deviation of a driver's way from a straight line, metres", low=0, high=2)
    drift_px: float = option(
        0.05,
        'where tracked points drift: standard deviation after a way of one pixel, which grows with the root of the way',
        low=0,
        high=1,
    )
    heading_deg: float = option(
        0.25, "where tracked points drift: standard deviation of a track's heading from that of its road", low=0, high=5
    )
    lens_prior: str = option(
        'auto',
        'family of the lens: let the traffic choose, near equidistant, free of distortion, or any in between',
        choices=('auto', 'equidistant', 'distortion_free', 'kannala_brandt'),
    )
    focal_prior_px: float = option(0.0, 'focal length that is known beforehand; 0 is unknown', low=0, high=1e6)
    focal_sigma_px: float = option(0.0, 'standard deviation of focal_prior_px; 0 holds it', low=0, high=1e6)
    k1_sigma: float = option(0.03, "standard deviation of k1 about its family's; 0 holds it", low=0, high=1)
    principal_point_sigma_px: float = option(
        -1.0,
        'standard deviation of the principal point about the image centre; 0 holds it there, negative is 1 % '
        'of the width',
        low=-1,
        high=10000,
    )
    road_angle: str = option(
        'auto',
        'angle between the two busiest roads: auto tests whether it is 90 degrees, free never uses it, a '
        'number of degrees asserts it',
    )
    roll_prior_deg: float = option(
        0.0,
        'where one road alone is seen: standard deviation of the roll of a camera that is taken for level, in '
        'degrees; it then gives a ground plane of grade assumed; 0 does not allow that',
        low=0,
        high=10,
    )
    transverse_edges: bool = option(
        True,
        'where one road alone is seen: take bumpers, windscreens and roof lines of vehicles for square to it; '
        'they then give a ground plane of grade assumed',
    )
    road_markings: bool = option(
        True,
        'where the traffic alone gives no full result: take lane lines, stop lines, crosswalks and kerbs for '
        'parallel or square to each other; where the traffic agrees they give lens and ground plane, of grade assumed',
    )

    def __post_init__(self) -> None:
        if isinstance(self.road_angle, (int, float)) and not isinstance(self.road_angle, bool):
            object.__setattr__(self, 'road_angle', f'{self.road_angle:g}')  # YAML reads degrees as a number
        super().__post_init__()
        if self.road_angle not in ('auto', 'free') and self.crossing_deg is None:
            raise UsageError(
                f"option 'road_angle' is auto, free, or degrees between 10 and 170; got {self.road_angle!r}"
            )

    @property
    def crossing_deg(self) -> float | None:
        """The asserted angle between the roads in degrees, None where none is."""
        try:
            angle = float(self.road_angle)
        except ValueError:
            return None
        return angle if 10.0 <= angle <= 170.0 else None


MIN_PIXEL_SEPARATION_SIGMAS = 10.0
"""Pixels that bound a known length are at least so many of their standard deviations apart."""


@dataclass(frozen=True, kw_only=True)
class ScaleOptions(_Validated):
    """What tells the scale of the ground plane when scale_from is not height."""

    distance_px: str = option(
        '', "two pixels of the full image on the road a known distance apart, as text: 'u1 v1 u2 v2'"
    )
    distance_m: float = option(0.0, 'metres between them, straight over the road; 0 is unknown', low=0, high=1000)
    distance_sigma_m: float = option(0.05, 'standard deviation of distance_m', low=0, high=100)
    pixel_sigma_px: float = option(1.0, 'standard deviation of each coordinate of distance_px', low=0, high=100)
    speed_km_h: float = option(
        0.0,
        'mean speed of the traffic that flows on the busiest road, as a loop or a radar counts it; 0 is unknown',
        low=0,
        high=300,
    )
    speed_sigma_km_h: float = option(5.0, 'standard deviation of speed_km_h, as a mean', low=0, high=100)
    point_height_m: float = option(
        0.75, 'mean height above the road of the points tracked on vehicles: half the height of a car', low=0, high=5
    )
    point_height_sigma_m: float = option(0.3, 'standard deviation of point_height_m, as a mean', low=0, high=5)

    def __post_init__(self) -> None:
        pixels = self.pixels
        super().__post_init__()
        apart = math.dist(*pixels) if pixels else math.inf
        if apart < max(MIN_PIXEL_SEPARATION_SIGMAS * self.pixel_sigma_px, 1.0):
            raise UsageError(
                f"the pixels of 'scale.distance_px' are {apart:.1f} px apart, which tells no scale when "
                f'each is known to {self.pixel_sigma_px:g} px: take two that are far from each other'
            )

    @property
    def pixels(self) -> tuple[tuple[float, float], ...]:
        """The two pixels (u, v) of `distance_px`; none where it is empty."""
        try:
            numbers = [float(word) for word in self.distance_px.replace(',', ' ').split()]
        except (ValueError, AttributeError):  # words, or what is no text at all
            numbers = [math.nan]
        if len(numbers) not in (0, 4) or not all(map(math.isfinite, numbers)):
            raise UsageError(
                "option 'scale.distance_px' is four numbers in one text, '412 530 888 530' for example; "
                f'got {self.distance_px!r}'
            )
        return tuple(zip(numbers[::2], numbers[1::2], strict=True))

    def require_inside(self, width: int, height: int) -> None:
        """Raise UsageError when a pixel lies outside images of that size."""
        for u, v in self.pixels:
            if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
                raise UsageError(
                    f"pixel ({u:g}, {v:g}) of 'scale.distance_px' lies outside the images, which have "
                    f'{width}x{height}: give pixels of the full image as the camera sends it'
                )


@dataclass(frozen=True, kw_only=True)
class GateOptions(_Validated):
    """What has to hold before a calibration is accepted."""

    min_tracks: int = option(40, 'tracks needed', low=4, high=100000)
    min_tracks_per_road: int = option(10, 'tracks needed of each of two roads', low=2, high=100000)
    min_coverage: float = option(0.15, 'share of image cells that tracks have crossed', low=0, high=1)
    max_sigma_focal_rel: float = option(0.05, 'largest standard deviation of the focal length, relative', low=0, high=1)
    max_sigma_tilt_deg: float = option(1.5, 'largest standard deviation of the ground normal', low=0, high=45)
    max_sigma_height_rel: float = option(
        0.2, "largest standard deviation of the camera's height, relative", low=0, high=1
    )
    max_drift_px: float = option(3.0, 'background drift that a fixed camera stays below, at 1280 px width', low=0.1)


@dataclass(frozen=True, kw_only=True)
class Options(_Validated):
    """All that the core is told from outside."""

    method: str = option('joint', "'joint' is the robust method, 'paper' the published one", choices=('joint', 'paper'))
    scale_from: str = option(
        'height',
        "what tells the scale: the camera's height, a distance on the road, or the mean speed of the traffic",
        choices=('height', 'distance', 'speed'),
    )
    camera_height: float = option(0.0, 'height of the camera above the road, metres; 0 is unknown', low=0, high=500)
    camera_height_sigma: float = option(
        0.0, 'standard deviation of camera_height, metres; 0 takes it as exact', low=0, high=100
    )
    allow_unit_scale: bool = option(False, 'without a height, give the ground plane in units of the height')
    distortion_model: str = option(
        'auto',
        'how camera_info says the lens: auto is equidistant, which is exact; the others are fitted to what the '
        'image shows, and refused where they are off by more than 0.5 px',
        choices=('auto', 'equidistant', 'rational_polynomial', 'plumb_bob'),
    )
    rectified_balance: float = option(
        0.0,
        'P of camera_info, the camera of the rectified image: at 0 it holds valid pixels only, at 1 all that the '
        'lens shows up to 80 degrees from its axis',
        low=0,
        high=1,
    )
    tf_parent: str = option(
        'ground',
        'parent frame of the ground transform: with ground, the child is the camera; '
        'with camera, for a camera whose frame has a parent already, it is the ground',
        choices=('ground', 'camera'),
    )
    max_image_width: int = option(1280, 'wider images are reduced to this width for tracking', low=160, high=16384)
    ignore_regions: str = option(
        '',
        "polygons in pixels of the full image, as text 'u1 v1 u2 v2 u3 v3; ...', that are never tracked, and black "
        'in every picture that is written',
    )
    random_seed: int = option(0, 'seed of the consensus searches', low=0)
    first_solve_s: float = option(10.0, 'seconds of recording before the first solution is tried', low=0)
    solve_growth: float = option(1.2, 'a new solution is tried when the evidence has grown by this factor', low=1.01)
    solve_interval_s: float = option(5.0, 'least seconds of recording between two solutions', low=0.1)
    tracking: TrackingOptions = field(default_factory=TrackingOptions)
    motion: MotionOptions = field(default_factory=MotionOptions)
    detector: DetectorOptions = field(default_factory=DetectorOptions)
    buffer: BufferOptions = field(default_factory=BufferOptions)
    paper: PaperOptions = field(default_factory=PaperOptions)
    joint: JointOptions = field(default_factory=JointOptions)
    scale: ScaleOptions = field(default_factory=ScaleOptions)
    gate: GateOptions = field(default_factory=GateOptions)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require_one_scale()
        _ = self.ignored_polygons

    @property
    def ignored_polygons(self) -> tuple[tuple[tuple[float, float], ...], ...]:
        """The polygons of `ignore_regions`, each of three points (u, v) or more; none where it is empty."""
        return tuple(
            _polygon(text) for text in self.ignore_regions.strip().rstrip(';').split(';') if self.ignore_regions.strip()
        )

    def _require_one_scale(self) -> None:
        """Raise UsageError unless what is given of the scale is what `scale_from` names, whole."""
        scale = self.scale
        given = {
            'height': {'camera_height': self.camera_height > 0},
            'distance': {'scale.distance_px': bool(scale.pixels), 'scale.distance_m': scale.distance_m > 0},
            'speed': {'scale.speed_km_h': scale.speed_km_h > 0},
        }
        for source, parts in given.items():
            extra = [name for name, there in parts.items() if there]
            if source != self.scale_from and extra:
                raise UsageError(
                    f"the scale comes from one source: 'scale_from' is {self.scale_from}, and "
                    f"'{extra[0]}' is given too; leave that out, or set 'scale_from' to {source} and give "
                    'nothing else'
                )
        missing = [name for name, there in given[self.scale_from].items() if not there]
        if self.scale_from != 'height' and missing:
            raise UsageError(f"'scale_from' is {self.scale_from}, which needs '{missing[0]}': give it")
        if self.camera_height_sigma > 0 and not self.camera_height > 0:
            raise UsageError("'camera_height_sigma' is given without 'camera_height': give both or neither")
        if self.scale_from == 'speed' and self.method == 'paper':
            raise UsageError(
                "the published method tells no road's traffic apart: with 'method' paper, 'scale_from' is "
                'height or distance'
            )


@dataclass(frozen=True, kw_only=True)
class NodeOptions(_Validated):
    """What only the live node needs; the replay accepts these names in a shared file and ignores them."""

    image_transport: str = option(
        'raw', 'image topic: sensor_msgs/Image or CompressedImage on <image>/compressed', choices=('raw', 'compressed')
    )
    image_reliability: str = option(
        'auto',
        "reliability of the image subscription; 'auto' matches the publisher",
        choices=('auto', 'reliable', 'best_effort'),
    )
    camera_name: str = option('', "name used for frames and files; '' takes the namespace or the image's frame_id")
    camera_frame: str = option('', "frame of the camera; '' takes the image's frame_id")
    ground_frame: str = option('', "frame of the ground plane; '' is <camera_name>_ground")
    camera_info_file: str = option(
        '', "file with the lens, as camera_info_manager writes it: only the pose is then solved; '' finds the lens too"
    )
    publish_tf: bool = option(True, 'publish the ground transform on /tf_static too, where tf2_msgs is there')
    camera_info_url: str = option(
        '',
        "where the calibration is kept, in camera_info_manager's syntax: file:///..., "
        "package://PACKAGE/..., with ${NAME} and ${ROS_HOME}; '' is "
        'file://${ROS_HOME}/camera_info/${NAME}.yaml',
    )
    autosave: bool = option(
        True, 'keep each new calibration at camera_info_url, at most once a minute; off: only ~/save writes'
    )
    upload_to_driver: bool = option(
        False, "send each new calibration to the driver's set_camera_info, at most once a minute"
    )
    use_driver_camera_info: bool = option(
        False,
        "subscribe the driver's CameraInfo on camera_info_in: its binning and roi are published too, and its "
        'size is compared with that of the images',
    )
    camera_info_mode: str = option(
        'per_image', 'publish camera_info with each image or when it changes', choices=('per_image', 'latched_only')
    )
    debug_rate_hz: float = option(
        5.0,
        'most pictures a second on each of debug_image, top_view and image_rect, drawn while somebody subscribes',
        low=0.1,
        high=1000,
    )
    idle_solve_s: float = option(3.0, 'when no image came for this long, what is left is solved', low=0.1)


MAX_PIXEL_COORDINATE = 1e5
"""No image has a pixel beyond."""


def _polygon(text: str) -> tuple[tuple[float, float], ...]:
    """Read one polygon of `ignore_regions`, or say what is wrong with it."""
    try:
        numbers = [float(word) for word in text.replace(',', ' ').split()]
    except ValueError:
        numbers = []
    if len(numbers) < 6 or len(numbers) % 2 or not all(abs(number) <= MAX_PIXEL_COORDINATE for number in numbers):
        raise UsageError(
            "option 'ignore_regions' is polygons of at least three pixels u v each, with ; between them, "
            f"'0 0 200 0 0 150; 900 0 1279 0 1279 90' for example; got {text.strip()!r} for a polygon"
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
    'joint',
    'scale',
    'gate',
    'camera_info_mode',
    'debug_rate_hz',
    'idle_solve_s',
)
"""Options, and groups of them, that are read anew at each solution or publication, so that they may change while a
node runs; all others shape the evidence from the first image on, or name what others rely on."""


def is_reconfigurable(name: str) -> bool:
    """Say whether an option, by its full name, may change while a node runs."""
    return name in RECONFIGURABLE or name.partition('.')[0] in RECONFIGURABLE


@dataclass(frozen=True)
class OptionSpec:
    """One option by its full name, as the node's parameters and the documented YAML need it."""

    name: str
    default: Any
    doc: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]


def walk_options(options: Any, prefix: str = '') -> Iterator[OptionSpec]:
    """Walk an option dataclass instance, yielding each option with its present value as the default."""
    for item in dataclasses.fields(options):
        value = getattr(options, item.name)
        if dataclasses.is_dataclass(value):
            yield from walk_options(value, f'{prefix}{item.name}.')
        else:
            meta = item.metadata
            yield OptionSpec(prefix + item.name, value, meta['doc'], meta['low'], meta['high'], meta['choices'])


def with_overrides(options: Any, values: Mapping[str, Any]) -> Any:
    """Return `options` with the values given by full name, or raise UsageError at an unknown name."""
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
    """Turn a nested mapping, as YAML gives it, into values by full name."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            flat.update(flatten(value, f'{prefix}{key}.'))
        else:
            flat[f'{prefix}{key}'] = value
    return flat
