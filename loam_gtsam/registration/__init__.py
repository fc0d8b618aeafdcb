"""From features and a map to a pose: matches, solvers, degeneracy, covariance."""
