"""The maps of a mapper that were in a file before the first sweep."""

from __future__ import annotations

import gtsam

from loam_gtsam.config import Config
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.frontend.deskew import PosedSweep
from loam_gtsam.maps.map_file import SavedMap, grids
from loam_gtsam.registration.frame_matcher import MapPair
from loam_gtsam.registration.matches import ScanMatches
from loam_gtsam.voxels.archive import Archive
from loam_gtsam.voxels.cubes import Cube, CubePoints
from loam_gtsam.voxels.grid import CubeIndex, Grid


class SavedCubes(Archive):
    """The cubes of one layer of a saved map, read when they are taken.

    ``keep`` tells whether a cube of the file that is stored stays as it is then, in memory; else it
    is read again when it is next taken. Cubes that the file does not have stay.
    """

    def __init__(self, grid: Grid, saved: SavedMap, layer: str, *, keep: bool) -> None:
        super().__init__(grid, float("inf"), None)
        self._saved, self._layer, self._keep = saved, layer, keep
        self._out: frozenset[CubeIndex] = frozenset()  # of the file, that were taken

    def __len__(self) -> int:
        return len(self.indices())

    def _is_in_file(self, index: CubeIndex) -> bool:
        """Whether a cube of the file is not taken."""
        return index in self._saved.layers[self._layer] and index not in self._out

    def indices(self) -> list[CubeIndex]:
        """Cubes of the file that are not taken, and those that are kept."""
        return [*filter(self._is_in_file, self._saved.layers[self._layer]), *super().indices()]

    def count(self) -> int:
        """Points in them."""
        counts = self._saved.layers[self._layer]
        there = sum(count for index, count in counts.items() if self._is_in_file(index))
        return there + super().count()

    def store(self, index: CubeIndex, content: CubePoints) -> None:
        """Take a cube back."""
        if self._keep or index not in self._saved.layers[self._layer]:
            super().store(index, content)
        else:
            self._out -= {index}

    def read(self, index: CubeIndex) -> CubePoints | None:
        """Points of a cube; DatasetError if the file is damaged."""
        if self._is_in_file(index):
            return self._saved.cube(self._layer, index)
        return super().read(index)

    def take(self, index: CubeIndex) -> Cube | None:
        """Take a cube out, which then is not there until it is stored."""
        if not self._is_in_file(index):
            return super().take(index)
        cube = Cube.of(self._saved.cube(self._layer, index), self._grid)
        self._out |= {index}
        return cube


class SavedMaps(MapPair):
    """A saved map in the place of a mapper's own; the mapper then finds its poses in it.

    Parameters
    ----------
    config : as of the mapper; its ``map`` must have the voxels and cubes of the saved map
    saved : must stay open
    keep : whether what goes into the map stays there

    Attributes
    ----------
    grows : whether sweeps go into the maps now; off until it is set
    owners : numbers of the places of the map at which those of the drive are
    """

    given = True

    def __init__(self, config: Config, saved: SavedMap, *, keep: bool = False) -> None:
        self._saved, self._keep = saved, keep
        self.grows = False
        self.owners = [0]
        super().__init__(config)

    def clear(self) -> None:
        """Read anew what is needed."""
        maps = []
        for number, (layer, grid) in enumerate(grids(self._configs[0]).items()):
            archive = SavedCubes(grid, self._saved, layer, keep=self._keep)
            config = self._configs[number // 2].map
            maps.append(CubeMap(config, grid.voxel_size, archive))
        self._open, self._small = (maps[0], maps[1]), (maps[2], maps[3])
        self._thinned = None

    def insert(
        self,
        posed: PosedSweep,
        map_T_middle: gtsam.Pose3,
        keyframe: int,
        matches: ScanMatches | None = None,
    ) -> None:
        """Add a sweep, if the map grows."""
        if self.grows:
            owner = self.owners[keyframe]
            super().insert(posed, map_T_middle, owner, matches)

    def move(self, *_: object) -> int:
        """Nothing: the map stays where it is."""
        return 0
