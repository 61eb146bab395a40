"""The shape of the pixels: hypotheses by image size, and the test of them by the traffic."""
