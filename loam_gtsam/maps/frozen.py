"""The maps of a mapper that come from a file, and into which no sweep goes."""

from __future__ import annotations

from collections.abc import Callable

from loam_gtsam.config import Config
from loam_gtsam.cubemap import CubeMap
from loam_gtsam.maps.map_file import LAYERS, SavedMap
from loam_gtsam.registration.frame_matcher import MapPair
from loam_gtsam.voxels.archive import Archive
from loam_gtsam.voxels.cubes import Cube, CubePoints
from loam_gtsam.voxels.grid import CubeIndex, Grid


class SavedCubes(Archive):
    """The cubes of one layer of a saved map: read when they are taken, and never changed."""

    def __init__(self, grid: Grid, saved: SavedMap, layer: str) -> None:
        super().__init__(grid, 0.0, None)
        self._saved, self._layer = saved, layer
        self._out: frozenset[CubeIndex] = frozenset()  # that were taken

    def __len__(self) -> int:
        return len(self._saved.layers[self._layer]) - len(self._out)

    def remember(self) -> Callable[[], None]:
        """See :meth:`Archive.remember`."""
        out = self._out

        def restore() -> None:
            self._out = out

        return restore

    def indices(self) -> list[CubeIndex]:
        """Cubes of the file that are not taken."""
        return [index for index in self._saved.layers[self._layer] if index not in self._out]

    def count(self) -> int:
        """Points in them."""
        counts = self._saved.layers[self._layer]
        return sum(counts[index] for index in self.indices())

    def store(self, index: CubeIndex, content: CubePoints) -> None:
        """Take a cube back, without what became of it."""
        self._out -= {index}

    def read(self, index: CubeIndex) -> CubePoints:
        """Points of a cube; DatasetError if the file is damaged."""
        return self._saved.cube(self._layer, index)

    def take(self, index: CubeIndex) -> Cube | None:
        """Read a cube, which then is not in the archive until it is stored."""
        if index not in self._saved.layers[self._layer] or index in self._out:
            return None
        cube = Cube.of(self.read(index), self._grid)
        self._out |= {index}
        return cube

    def settle(self, content: CubePoints) -> None:
        """Nothing: no point is added."""


class FrozenMaps(MapPair):
    """A saved map in the place of a mapper's own; the mapper then finds its poses in it.

    Parameters
    ----------
    config : as of the mapper; its ``map`` must have the voxels and cubes of the saved map
    saved : must stay open
    """

    frozen = True

    def __init__(self, config: Config, saved: SavedMap) -> None:
        self._saved = saved
        super().__init__(config)

    def clear(self) -> None:
        """Read anew what is needed."""
        maps = []
        for layer, config in zip(LAYERS, [c for c in self._configs for _ in "ep"], strict=True):
            size = config.map.edge_voxel if layer.endswith("edges") else config.map.plane_voxel
            archive = SavedCubes(Grid(config.map.cube_size, size), self._saved, layer)
            maps.append(CubeMap(config.map, size, archive if len(archive) else None))
        self._open, self._small = (maps[0], maps[1]), (maps[2], maps[3])
        self._thinned = None

    def insert(self, *_: object) -> None:
        """Nothing: the map stays as it is."""

    def move(self, *_: object) -> int:
        """Nothing: the map stays where it is."""
        return 0
