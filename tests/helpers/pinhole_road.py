"""A straight road through a lens without distortion, for tests of what one road leaves open."""

from autocalib_ros.lens.camera import Camera
from autocalib_ros.offline.synthetic.junction import Junction, pose

SIZE = (1280, 720)
PINHOLE = Camera(*SIZE, 1000.0, (639.5, 359.5), (1 / 3, 2 / 15, 17 / 315, 62 / 2835))
ROAD = Junction(
    camera=PINHOLE,
    road_angles_deg=(0.0,),
    turning_fraction=0.0,
    vehicles=40,
    points_per_vehicle=2,
    camera_from_ground=pose(18.0, 0.5, 20.0),
    centre_m=(14.0, 0.0),
)
