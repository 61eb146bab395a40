"""Camera models: Kannala-Brandt, OpenCV's, and CameraInfo."""
