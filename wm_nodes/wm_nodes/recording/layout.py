"""N images in one mosaic, as wm_msgs/TileLayout says. Shapes: N images, H W one tile, R C rows and columns of tiles."""

import math
from dataclasses import dataclass

import numpy as np

from wm_nodes.core.types import UInt8Array


@dataclass(frozen=True)
class Tiles:
    """Tile i lies at row i // cols, column i % cols; missing tiles are black."""

    rows: int
    """Rows of tiles."""
    cols: int
    """Columns of tiles."""
    tile_height: int
    """Height of one tile, px."""
    tile_width: int
    """Width of one tile, px."""

    @classmethod
    def of(cls, num_envs: int, height: int, width: int) -> "Tiles":
        """The nearly square layout of `num_envs` tiles: 16 give 4 x 4, 2 give 1 x 2."""
        cols = math.ceil(math.sqrt(num_envs))
        return cls(math.ceil(num_envs / cols), cols, height, width)

    @property
    def mosaic_shape(self) -> tuple[int, int]:
        """Height and width of the mosaic, px."""
        return self.rows * self.tile_height, self.cols * self.tile_width

    def tile(self, images: UInt8Array) -> UInt8Array:
        """(N, H, W, 3) to (R * H, C * W, 3)."""
        num_images, height, width, channels = images.shape
        if (height, width) != (self.tile_height, self.tile_width) or num_images > self.rows * self.cols:
            raise ValueError(f"cannot lay {images.shape} images into {self}")
        missing = self.rows * self.cols - num_images
        if missing:
            images = np.concatenate([images, np.zeros((missing, *images.shape[1:]), np.uint8)])
        grid = images.reshape(self.rows, self.cols, height, width, channels)
        return np.ascontiguousarray(grid.transpose(0, 2, 1, 3, 4)).reshape(*self.mosaic_shape, channels)

    def untile(self, mosaic: UInt8Array, num_images: int) -> UInt8Array:
        """(R * H, C * W, 3) to (N, H, W, 3); a view for one column, else a copy."""
        grid = mosaic.reshape(self.rows, self.tile_height, self.cols, self.tile_width, mosaic.shape[-1])
        images = grid.transpose(0, 2, 1, 3, 4).reshape(-1, self.tile_height, self.tile_width, mosaic.shape[-1])
        return images[:num_images]
