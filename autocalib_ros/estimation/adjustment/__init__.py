"""The bundle adjustment: parameters, prior, noise, residual blocks, solver, covariance, model selection."""
