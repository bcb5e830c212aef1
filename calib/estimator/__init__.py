"""The estimator of all fits: unknowns, kinds of rows, the search, the covariance."""
