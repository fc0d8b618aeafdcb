"""The start of a run: its first motion is searched for, its first sweeps are one estimate."""

from loam_gtsam.registration.start.first_sweeps import Start as Start
