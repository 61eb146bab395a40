"""Renderer: draws the movers of each frame over a backdrop."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import zip_longest

import cv2
import numpy as np

from autocalib_ros.offline.simulate import bodies, lamps, sensor
from autocalib_ros.offline.simulate.backdrop import draw_backdrop
from autocalib_ros.offline.simulate.bodies import body_faces, shadow_faces
from autocalib_ros.offline.simulate.camera_motion import CameraMotion
from autocalib_ros.offline.simulate.cyclist_actors import Cyclist, CyclistState, cyclist_faces
from autocalib_ros.offline.simulate.faces import NO_MAP, SAMPLES_PER_PIXEL, Canvas, Drawing, Faces, PixelRect
from autocalib_ros.offline.simulate.ground_surface import paint_ground
from autocalib_ros.offline.simulate.lens import CameraPose, KannalaBrandtLens
from autocalib_ros.offline.simulate.microbolometer import Microbolometer
from autocalib_ros.offline.simulate.moving_scenery import MovingScenery
from autocalib_ros.offline.simulate.network import Network
from autocalib_ros.offline.simulate.options import SimulationOptions
from autocalib_ros.offline.simulate.palette import palette_for
from autocalib_ros.offline.simulate.pedestrian_actors import Pedestrian, PedestrianState, pedestrian_faces
from autocalib_ros.offline.simulate.scenery import build_scenery, street_lamp_positions
from autocalib_ros.offline.simulate.vehicle_models import Vehicle, VehicleState
from autocalib_ros.offline.simulate.weather import FrameContext, Weather

_DRAWING_RANGE_M = 130.0  # vehicles are drawn within this distance
_VEHICLE_REACH_M = 14.0  # of a bus and its beam from its centre
_NEAR_MAP_M, _FAR_MAP_M = 48.0, 480.0  # half the side of the fine and the coarse ground map
_CELL_PX = 16  # spacing of the grid on which camera shake is computed
_SHADOW_RANGE_M = 50.0  # soft shadows are drawn within this distance
_NO_FACES = Faces(np.zeros((0, 3, 3)), ())


@dataclass(frozen=True)
class SceneState:
    """State of the scene in a frame: camera, vehicles, pedestrians, cyclists.

    shake: rotation (3, 3) in the camera frame, or None.
    """

    index: int
    time_s: float
    bumped: bool
    shake: np.ndarray | None
    vehicles: list[tuple[Vehicle, VehicleState]]
    pedestrians: list[tuple[Pedestrian, PedestrianState]]
    cyclists: list[tuple[Cyclist, CyclistState]]
    shutter_closed: bool = False


@dataclass(frozen=True)
class _Backdrop:
    """Static scene from one camera pose: samples and pixels (h, w, 3), both with a margin."""

    canvas: Canvas
    image: np.ndarray


class Renderer:
    """Renders frames; owns the large arrays, which are built once per process."""

    def __init__(self, options: SimulationOptions, network: Network, pose: CameraPose, bumped: CameraPose) -> None:
        self._options = options
        self._network = network
        self._lens = options.lens
        self._poses = {False: pose, True: bumped}
        self._noise = sensor.SensorNoise(options)
        self._motion = CameraMotion(options)
        self._microbolometer = Microbolometer(options)
        self._margin = math.ceil(4 * options.shake_px) + 2 if options.shake_px else 0
        self._canvas = Canvas(self._lens, options.width_px, options.height_px)
        self._texels_per_m = bodies.FINE_TEXELS_PER_M if options.focal_px > 350 else bodies.COARSE_TEXELS_PER_M
        self._backdrops: dict[bool, _Backdrop] = {}
        troubles, size = options.troubles, (options.width_px, options.height_px)
        self._weather = Weather(options, network, self._poses) if troubles else None
        self._moving_scenery = (
            MovingScenery(troubles, network, pose, self._lens, size, palette_for(options.thermal), options.seed)
            if troubles
            else None
        )

    def frame(self, scene: SceneState) -> np.ndarray:
        """Return BGR (h, w, 3) uint8, or counts (h, w) uint16 of a thermal camera."""
        pose = self._poses[scene.bumped]
        if scene.shake is not None:
            pose = pose.rotated(scene.shake)
        image, rects = self._image(scene, pose)
        context = None
        if self._weather is not None:
            context = FrameContext(
                image,
                self._depth(scene, rects),
                pose,
                self._visible_vehicles(scene, pose),
                scene.index,
                scene.time_s,
            )
            self._weather.apply_ground_effects(context, scene.bumped)
        noise = self._noise.of(scene.index)
        if self._options.thermal:
            image = self._motion.moved(image, scene.time_s)
            return self._microbolometer.counts(image, scene.time_s, noise, shutter_closed=scene.shutter_closed)
        if self._options.night:
            image = sensor.darken(image)
            lamps.add_lamps(image, self._canvas, pose, self._visible_vehicles(scene, pose))
        if self._weather is not None and context is not None:
            context = replace(context, image=image)
            self._weather.add_light_sources(context, scene.bumped)
            image = self._weather.apply_lens_effects(context)
        image = self._motion.lit(self._motion.moved(image, scene.time_s), scene.time_s)
        return cv2.add(image, noise, dtype=cv2.CV_8U)

    def prepare(self) -> None:
        """Render the backdrop ahead of the first frame, so that copies in other processes have it."""
        self._backdrop(bumped=False)

    def background_distance_m(self, bumped: bool, pixels: np.ndarray) -> np.ndarray:
        """Return the distance (n,) of the static scene at pixels (n, 2)."""
        distance = self._backdrop(bumped).canvas.distance
        columns, rows = (np.round(pixels).astype(int) + self._margin).T * SAMPLES_PER_PIXEL
        return distance[rows, columns]

    def _depth(self, scene: SceneState, rects: list[PixelRect]) -> np.ndarray:
        """Return the depth map (h, w) including movers; camera shake is ignored."""
        size = (self._options.height_px, self._options.width_px)
        inner = slice(self._margin * SAMPLES_PER_PIXEL, None, SAMPLES_PER_PIXEL)
        depth = self._backdrop(scene.bumped).canvas.distance[inner, inner][: size[0], : size[1]].copy()
        for rect in rects:
            rows, columns = (slice(s.start, s.stop, SAMPLES_PER_PIXEL) for s in rect.samples())
            depth[rect.pixels()] = self._canvas.distance[rows, columns]
        return depth

    def _image(self, scene: SceneState, pose: CameraPose) -> tuple[np.ndarray, list[PixelRect]]:
        """Draw all movers over the backdrop; return pixels (h, w, 3) and the rectangles with movers."""
        backdrop = _FrameBackdrop(self._backdrop(scene.bumped), self._lens, self._margin, scene.shake)
        image = backdrop.image(self._options.width_px, self._options.height_px)
        gains, solids = self._project_movers(scene, pose)
        empty: list[Drawing] = []
        pairs = zip_longest(gains, solids, fillvalue=empty)
        rects = [PixelRect.around(pair) for a, b in pairs if (pair := [*a, *b])]
        for rect in rects:
            backdrop.restore(self._canvas, rect)
        self._canvas.draw(drawing for group in gains for drawing in group)
        self._canvas.draw(drawing for group in solids for drawing in group)
        for rect in rects:
            image[rect.pixels()] = self._canvas.resolve(rect)
        return image, rects

    def _project_movers(self, scene: SceneState, pose: CameraPose) -> tuple[list[list[Drawing]], list[list[Drawing]]]:
        """Project shadows and beams (drawn as gains), and the movers themselves."""
        thermal = self._options.thermal
        solids, flats = [], []  # bodies, and shadows or beams on the ground
        for vehicle, state in self._visible_vehicles(scene, pose):
            position = (state.x, state.y, state.heading)
            body = body_faces(vehicle.kind, vehicle.colour, thermal, self._texels_per_m)
            solids.append(body.moved(*position))
            flat = shadow_faces(vehicle.kind, thermal)
            if self._options.night:
                flat = lamps.beam_faces(vehicle.kind)
            near = math.hypot(*(pose.position_m[:2] - position[:2])) < _SHADOW_RANGE_M
            flats.append(flat.moved(*position) if near or self._options.night else _NO_FACES)
        viewer = pose.position_m[:2]
        solids += [pedestrian_faces(*pedestrian, viewer, thermal) for pedestrian in scene.pedestrians]
        solids += [cyclist_faces(*cyclist, viewer, thermal) for cyclist in scene.cyclists]
        if self._moving_scenery is not None:
            solids += self._moving_scenery.at(scene.time_s)
        return self._canvas.project_faces(flats, pose, gain=True), self._canvas.project_faces(solids, pose)

    def _visible_vehicles(self, scene: SceneState, pose: CameraPose) -> list[tuple[Vehicle, VehicleState]]:
        """Return the vehicles within range that may reach into the image."""
        if not scene.vehicles:
            return []
        centres = np.array([(s.x, s.y, 1.0) for _, s in scene.vehicles])
        distance = np.linalg.norm(centres - pose.position_m, axis=1)
        pixels, _ = self._lens.project(pose.to_camera(centres))
        reach = (self._lens.focal_px * _VEHICLE_REACH_M / distance)[:, None] + 20.0
        size = np.array([self._options.width_px, self._options.height_px])
        visible = ((pixels > -reach) & (pixels < size + reach)).all(1) & (distance < _DRAWING_RANGE_M)
        return [scene.vehicles[i] for i in np.flatnonzero(visible)]

    def _backdrop(self, bumped: bool) -> _Backdrop:
        if bumped not in self._backdrops:
            self._backdrops[bumped] = self._draw_backdrop(self._poses[bumped])
        return self._backdrops[bumped]

    def _draw_backdrop(self, pose: CameraPose) -> _Backdrop:
        options = self._options
        palette = palette_for(options.thermal)
        # A texel of the near map covers about one pixel where the road is closest.
        texel_m = min(max(2.5 * options.camera_height_m / options.focal_px, 0.035), 0.5)
        grounds = (
            paint_ground(self._network, palette, _FAR_MAP_M, 16 * texel_m, options.seed),
            paint_ground(self._network, palette, _NEAR_MAP_M, texel_m, options.seed),
        )
        canvas = self._canvas.empty_copy()
        if self._margin:
            canvas = Canvas(self._lens, options.width_px, options.height_px, self._margin)
        scenery = build_scenery(self._network, pose.position_m[:2], palette, options.seed)
        draw_backdrop(canvas, pose, grounds, scenery, palette)
        if options.night:
            pools = [lamps.light_pool().moved(*position, 0.0) for position in street_lamp_positions(self._network)]
            canvas.draw(d for group in canvas.project_faces(pools, pose, gain=True) for d in group)
        rows, columns = (n // SAMPLES_PER_PIXEL for n in canvas.distance.shape)
        return _Backdrop(canvas, canvas.resolve(PixelRect(0, 0, columns, rows)))


class _FrameBackdrop:
    """The backdrop in one frame, rotated by the camera shake."""

    def __init__(self, backdrop: _Backdrop, lens: KannalaBrandtLens, margin: int, shake: np.ndarray | None) -> None:
        self._backdrop, self._lens, self._margin, self._shake = backdrop, lens, margin, shake
        self._shift: np.ndarray | None = None

    def image(self, width: int, height: int) -> np.ndarray:
        """Return the pixels (h, w, 3) without movers."""
        if self._shake is None:
            return self._backdrop.image.copy()
        self._shift = self._shifts(width, height, self._shake)
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
        positions = (grid + self._shift + self._margin).astype(np.float32)
        return cv2.remap(self._backdrop.image, positions, NO_MAP, cv2.INTER_CUBIC)

    def restore(self, canvas: Canvas, rect: PixelRect) -> None:
        """Restore the backdrop in a rectangle of the canvas, removing the movers of the last frame."""
        samples, source = rect.samples(), self._backdrop.canvas
        if self._shift is None:
            canvas.colour[samples] = source.colour[samples]
            canvas.distance[samples] = source.distance[samples]
            return
        shift = self._shift[rect.pixels()]
        shift = cv2.resize(shift, None, fx=SAMPLES_PER_PIXEL, fy=SAMPLES_PER_PIXEL) * SAMPLES_PER_PIXEL
        rows, columns = (np.arange(s.start, s.stop) for s in samples)
        grid = np.stack(np.meshgrid(columns, rows), -1)
        positions = (grid + shift + self._margin * SAMPLES_PER_PIXEL).astype(np.float32)
        canvas.colour[samples] = cv2.remap(source.colour, positions, NO_MAP, cv2.INTER_LINEAR)
        canvas.distance[samples] = cv2.remap(source.distance, positions, NO_MAP, cv2.INTER_NEAREST)

    def _shifts(self, width: int, height: int, shake: np.ndarray) -> np.ndarray:
        """Return the offset (h, w, 2) from each pixel to the same ray in the unshaken image.

        The field is smooth: computed every _CELL_PX pixels and interpolated linearly.
        """
        columns, rows = -(-width // _CELL_PX), -(-height // _CELL_PX)
        centre = (np.arange(max(columns, rows)) + 0.5) * _CELL_PX - 0.5
        grid = np.stack(np.meshgrid(centre[:columns], centre[:rows]), -1)
        rays = self._lens.bearings(grid) @ shake.T
        shift = (self._lens.project(rays)[0] - grid).astype(np.float32)
        shift = cv2.resize(shift, (columns * _CELL_PX, rows * _CELL_PX))
        return shift[:height, :width]
