"""The pattern of lane lines: the period of their dashes along the road, and the width of the lanes across it."""
