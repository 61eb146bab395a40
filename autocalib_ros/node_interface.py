"""Topics, services and diagnostics of the nodes, as tables for the reference page. Needs no ROS."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Endpoint:
    """One topic or service of a node."""

    name: str
    direction: str
    """'subscribed', 'published', 'served' or 'called'."""
    type: str
    """Package and name of the message or service."""
    doc: str


AUTOCALIB_NODE = (
    Endpoint(
        'image',
        'subscribed',
        'sensor_msgs/Image',
        'camera images; with `image_transport: compressed` a `sensor_msgs/CompressedImage` on '
        '`<image>/compressed`. The reliability follows the publisher',
    ),
    Endpoint(
        'camera_info_in',
        'subscribed',
        'sensor_msgs/CameraInfo',
        'the `CameraInfo` of the driver, only with `use_driver_camera_info: true`. Its binning and region of '
        'interest are copied to the published one, and its size is compared with that of the images',
    ),
    Endpoint('/tf', 'subscribed', 'tf2_msgs/TFMessage', 'checked for other publishers of the same frames'),
    Endpoint(
        '/tf_static',
        'published',
        'tf2_msgs/TFMessage',
        'the ground transform, if `tf2_msgs` is installed and no other publisher owns these frames. The node '
        'also subscribes to it. Latched',
    ),
    Endpoint(
        '~/camera_info',
        'published',
        'sensor_msgs/CameraInfo',
        'once calibrated: one message for each image, with the header of that image. While the calibration is '
        'withheld (see `on_move`) K, R and P are zero and D is empty. Latched',
    ),
    Endpoint(
        '~/ground_transform',
        'published',
        'geometry_msgs/TransformStamped',
        'pose of the camera in `<camera>_ground`; with `tf_parent: camera` the inverse. Latched',
    ),
    Endpoint(
        '~/status',
        'published',
        'diagnostic_msgs/DiagnosticStatus',
        'whether the calibration holds, for programs: state, grade, what is published, from when to when it holds, '
        'standard deviations, the newest move. On each change, latched',
    ),
    Endpoint(
        '~/map_transform',
        'published',
        'geometry_msgs/TransformStamped',
        'with `control_points`: pose of `<camera>_ground` in `map_frame`, for each new calibration. Latched',
    ),
    Endpoint(
        '~/markers',
        'published',
        'visualization_msgs/MarkerArray',
        'grid on the road, field of view, one-sigma ellipses 10, 20 and 40 m ahead, grade and numbers, in the '
        'ground frame. Latched',
    ),
    Endpoint(
        '~/debug_image',
        'published',
        'sensor_msgs/Image',
        'tracked points, tracks of the last solution, horizon, ground grid and state, drawn over the image',
    ),
    Endpoint(
        '~/top_view',
        'published',
        'sensor_msgs/Image',
        'the road from above with a scale bar, x of the ground frame to the right; stamp of the image, ground frame',
    ),
    Endpoint(
        '~/image_rect',
        'published',
        'sensor_msgs/Image',
        'the undistorted image by the matrix P of `~/camera_info`, with the header of the image',
    ),
    Endpoint(
        '/diagnostics',
        'published',
        'diagnostic_msgs/DiagnosticArray',
        'once a second: state, missing evidence, rates, estimates and their standard deviations',
    ),
    Endpoint(
        '~/calibrate', 'served', 'std_srvs/Trigger', 'solve now; the response reports the result, or what is missing'
    ),
    Endpoint(
        '~/save',
        'served',
        'std_srvs/Trigger',
        'write the published calibration, a restored one too; the response gives the path or the error. '
        '`NAME.report.html` follows within seconds',
    ),
    Endpoint(
        '~/reset',
        'served',
        'std_srvs/Trigger',
        'delete the collected evidence and withdraw the calibration. The stored file stays until the next save',
    ),
    Endpoint(
        'set_camera_info',
        'called',
        'sensor_msgs/SetCameraInfo',
        'the service of the camera driver, only with `upload_to_driver: true`; remap it',
    ),
)
"""Interface of `autocalib_node`."""

GROUND_POINTS_NODE = (
    Endpoint('camera_info', 'subscribed', 'sensor_msgs/CameraInfo', 'from `autocalib_node`; the newest is used'),
    Endpoint(
        'ground_transform', 'subscribed', 'geometry_msgs/TransformStamped', 'from `autocalib_node`; the newest is used'
    ),
    Endpoint(
        'pixels',
        'subscribed',
        'geometry_msgs/PolygonStamped',
        'header of the image; x and y in pixels, z in metres above the road, usually 0',
    ),
    Endpoint(
        'ground_points',
        'published',
        'sensor_msgs/PointCloud2',
        'the same points in the same order, in the ground frame, with the stamp of the image; `nan` where a '
        'pixel shows no ground',
    ),
)
"""Interface of `ground_points_node`."""

DIAGNOSTIC_VALUES = {
    'state': '`WAITING_FOR_IMAGES`, `COLLECTING`, `RESTORED`, `CALIBRATED`, `DEGRADED`, `MOVED`, `MENDED`, `BLIND` or '
    '`RECOVERED`',
    'evidence_percent': 'how much of the evidence for a first solution has been collected',
    'missing': 'what is missing for a first solution',
    'outlook': 'estimated time until then, or for how long there was no traffic',
    'image_topic': 'resolved name of the image topic',
    'encoding': 'encoding of the images',
    'image_age_s': 'seconds since the last image',
    'received_hz': 'rate of received images',
    'used_hz': 'rate of processed images',
    'received': 'images received since the start',
    'used': 'images processed',
    'dropped': 'images dropped because they arrived faster than they could be processed',
    'unreadable': 'images that could not be decoded',
    'late': 'images that came late or twice by their stamps: they get their `camera_info` and are not processed',
    'odd_size': 'images of another size than those before, skipped because that did not last for 3 s',
    'repeated': 'of the processed images, those that repeat an earlier one and so show nothing new',
    'lost': 'images lost by the middleware',
    'frame_period_s': 'frame period of the camera, fitted through the stamps; empty if they show none',
    'stamp_jitter_s': 'robust standard deviation of the stamps about regular times',
    'missing_frames': 'frames between the first image and the newest that did not arrive',
    'queued': 'images that another followed within half a period (doublets, bursts)',
    'odd_stamps': 'images whose stamp was wrong; they got the time of their place in the sequence',
    'clock_steps': 'times the clock of the stamps was set back while the images went on',
    'solver': '`IDLE`, `SOLVING`, `TIMED_OUT` or `CRASHED`: what the solver does, or how its last solution failed',
    'solving_s': 'for how long the present solution has been running',
    'usual_solve_s': 'median of the last durations',
    'solver_fault': 'why the last solution failed',
    'result_age_s': 'seconds since the newest result, accepted or refused',
    'view': 'whether the picture shows the calibrated view: `unknown`, `still`, `swaying`, `moved` or `blind`',
    'view_checked_s': 'stamp of the image in which that was seen last',
    'sway_deg': 'amplitude of the sway of the camera',
    'moved_s': 'stamp of the newest move of the camera',
    'move': 'its kind: `bump`, `re-aim`, `zoom` or `other view`',
    'moved_pan_deg': 'by how much the camera turned to the right then',
    'moved_tilt_deg': 'by how much it turned down',
    'moved_roll_deg': 'by how much it turned clockwise',
    'zoom': 'focal length after the move over that before',
    'pose': 'what is published: `calibrated`, `mended`, `withheld`, or `stale` with `on_move: keep`; empty without a '
    'calibration',
    'grade': 'grade of the published calibration: `full`, `fair`, `coarse`, `assumed`, `unit_scale` or `lens`',
    'focal_px': 'focal length',
    'focal_sigma_px': 'its standard deviation',
    'tilt_deg': 'tilt of the optical axis below the horizontal',
    'tilt_sigma_deg': 'its standard deviation',
    'roll_sigma_deg': 'standard deviation of the roll',
    'height_m': 'height of the camera above the road',
    'height_sigma_m': 'its standard deviation',
    'assumptions': 'assumptions of the calibration',
    'verification': 'how many checks passed, and [which failed](calibration-json.md#verification)',
    'no_ground_plane': 'why there is no ground plane',
    'newest_stamp_s': 'stamp of the newest image that the calibration rests on',
}
"""Key-value pairs of the status `<node>: calibration`, in their order."""

DIAGNOSTIC_LEVELS = (
    ('OK', '`CALIBRATED` and `RECOVERED`; `RESTORED` once the picture shows the stored view'),
    (
        'WARN',
        '`WAITING_FOR_IMAGES`, `COLLECTING`, `RESTORED`, `MENDED` and `DEGRADED`; no image for 5 s; images dropped, or '
        'without advancing stamps; another node publishes the same `camera_info`; two nodes publish the images; a '
        'solution that failed',
    ),
    (
        'ERROR',
        '`MOVED`, also for a minute after the pose was mended, and `BLIND`; a configuration error that waiting does '
        'not fix: images of another type, transport, reliability or encoding (the message names the parameter to '
        'set); a calibration withdrawn because the image size changed',
    ),
)
"""Levels of the status and when they are reported."""
