"""Motion models of vehicles: planar two-frame motion, and rigid bodies over several frames."""
