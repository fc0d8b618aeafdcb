"""Saved maps: written after a run, opened again, localised in."""

from loam_gtsam.maps.cleaning import clean_map as clean_map
from loam_gtsam.maps.clouds import import_cloud as import_cloud
from loam_gtsam.maps.clouds import read_cloud as read_cloud
from loam_gtsam.maps.clouds import write_cloud as write_cloud
from loam_gtsam.maps.localizer import Localisation as Localisation
from loam_gtsam.maps.localizer import Localizer as Localizer
from loam_gtsam.maps.localizer import localise as localise
from loam_gtsam.maps.localizer import own_settings as own_settings
from loam_gtsam.maps.map_file import SavedMap as SavedMap
from loam_gtsam.maps.map_file import save_map as save_map
from loam_gtsam.maps.merging import MergedMaps as MergedMaps
from loam_gtsam.maps.merging import merge_maps as merge_maps
