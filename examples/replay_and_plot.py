# %% [markdown]
# Calibrate from a recording and plot what was found. Run it as a script,
#
#     python examples/replay_and_plot.py recording/ 8.0 plot.png
#
# or cell by cell in an editor that knows `# %%` (VS Code, Spyder, Jupytext).
"""Calibrate from a recording and plot tracks, ground grid and uncertainty."""

# %%
import sys

import matplotlib

matplotlib.use('Agg')  # leave this out in a notebook
import matplotlib.pyplot as plt
import numpy as np

from autocalib_ros.config import Options
from autocalib_ros.ground import Ground
from autocalib_ros.offline.replay_recording import replay

recording, camera_height, out = sys.argv[1], float(sys.argv[2]), sys.argv[3]

# %% Calibrate. The result is false if it is a refusal.
found = replay(recording, Options(camera_height=camera_height))
evidence, result = found.evidence, found.result
print(f'{evidence.track_count} tracks in {evidence.seconds:.0f} s')

# %% Every tracked point in the image.
figure, (image_axes, road_axes) = plt.subplots(1, 2, figsize=(12, 4.5))
width, height = evidence.image_size
image_axes.plot(*evidence.points_px.T, '.', markersize=1)
image_axes.set(xlim=(0, width), ylim=(height, 0), aspect='equal', xlabel='x, px', ylabel='y, px')
image_axes.set_title('tracked points')

# %% The same points on the road, if there is a metric ground plane.
if result and result.ground is not None and result.ground.metric:
    print(f'focal length {result.camera.focal_px:.1f} ± {result.stddev.focal_px or 0.0:.1f} px, grade {result.grade}')
    ground = Ground.of(result)
    grid_m = np.array([[x, y] for x in range(0, 45, 5) for y in range(-15, 20, 5)], float)
    pixels, seen = ground.pixels(grid_m)
    image_axes.plot(*pixels[seen].T, 'r+')
    on_road = ground.points(evidence.points_px)
    near = on_road.valid & (np.abs(on_road.points_m) < 60).all(axis=1)
    road_axes.plot(*on_road.points_m[near, :2].T, '.', markersize=1)
    road_axes.set(xlabel='x, m', ylabel='y, m', aspect='equal', title='on the road')
else:
    reason = result.ground_refusal if result else result
    message = 'the plane has no metric scale' if reason is None else f'{reason.code}: {reason.message}. {reason.remedy}'
    print(message)
    road_axes.text(0.5, 0.5, message, ha='center', va='center', wrap=True)
    road_axes.set_axis_off()

# %%
figure.savefig(out, dpi=100)
plt.close(figure)
