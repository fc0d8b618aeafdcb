"""Relocalisation: detection of sweeps that do not fit the map, and the search for their pose."""

from loam_gtsam.registration.relocalization.doubtful_sweeps import RELOCALISED as RELOCALISED
from loam_gtsam.registration.relocalization.doubtful_sweeps import Doubt as Doubt
from loam_gtsam.registration.relocalization.doubtful_sweeps import Found as Found
from loam_gtsam.registration.relocalization.doubtful_sweeps import Lost as Lost
from loam_gtsam.registration.relocalization.doubtful_sweeps import accept as accept
from loam_gtsam.registration.relocalization.doubtful_sweeps import doubtful as doubtful
from loam_gtsam.registration.relocalization.doubtful_sweeps import found_at as found_at
from loam_gtsam.registration.relocalization.doubtful_sweeps import placed as placed
from loam_gtsam.registration.relocalization.doubtful_sweeps import search as search
from loam_gtsam.registration.relocalization.doubtful_sweeps import second_opinion as second_opinion
from loam_gtsam.registration.relocalization.doubtful_sweeps import unplaced as unplaced
from loam_gtsam.registration.relocalization.fits import Fit as Fit
from loam_gtsam.registration.relocalization.fits import FitMonitor as FitMonitor
from loam_gtsam.registration.relocalization.fits import distinct as distinct
from loam_gtsam.registration.relocalization.fits import same as same
from loam_gtsam.registration.relocalization.fits import same_optimum as same_optimum
from loam_gtsam.registration.relocalization.likely_poses import Field as Field
from loam_gtsam.registration.relocalization.likely_poses import likely_poses as likely_poses
from loam_gtsam.registration.relocalization.likely_poses import one_per_cell as one_per_cell
from loam_gtsam.registration.relocalization.likely_poses import sample_features as sample_features
from loam_gtsam.registration.relocalization.next_piece import CONTINUED as CONTINUED
from loam_gtsam.registration.relocalization.next_piece import Gap as Gap
from loam_gtsam.registration.relocalization.next_piece import NextPiece as NextPiece
from loam_gtsam.registration.relocalization.next_piece import goes_on as goes_on
from loam_gtsam.registration.relocalization.next_piece import spread_in_map as spread_in_map
from loam_gtsam.registration.relocalization.places import any_of as any_of
