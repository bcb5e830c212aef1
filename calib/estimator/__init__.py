"""One estimator: unknowns, rows, one loop, one covariance."""
