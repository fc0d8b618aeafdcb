"""How wrong a pose may be: its own error, that of the map, and that of the motion between two."""

from loam_gtsam.registration.uncertainty.pose_errors import PoseErrors as PoseErrors
from loam_gtsam.registration.uncertainty.pose_errors import (
    relative_covariance as relative_covariance,
)
