"""Sweeps with truth, and a peer that moves by itself, for comparisons."""

from __future__ import annotations

import numpy as np
from support.list_dataset import ListDataset

from loam_gtsam.datasets.base import DatasetInfo
from loam_gtsam.studies.peers import Peer


class Sweeps(ListDataset):
    """With truth, and a name that looks like markup."""

    name = "a <b>list</b> [red]"

    def __init__(self, items, truth=None):
        super().__init__(items)
        self.truth = truth

    def info(self):
        return DatasetInfo("list", "nowhere")


class FakePeer(Peer):
    """Moves a metre a sweep; raises at sweep ``fails_at``."""

    name, package, module = "fake", "fake", "fake"
    fails_at: int | None = None

    @classmethod
    def load(cls, name=""):
        return None

    @property
    def map_points(self):
        return 7

    def _register(self, stamp, sweep):
        if len(self.updates) == self.fails_at:
            raise RuntimeError("cannot [go] on")
        pose = np.eye(4)
        pose[0, 3] = len(self.updates)
        return pose, 0.0
