"""Frames of pictures that a recording shows at some steps only, and their images of racks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Generic, Literal, Protocol, TypeVar

import numpy as np
import rerun as rr

from sdc_taichi.config import HallConfig
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.types import F64, I64, StepResult

from .colour_scales import ColourScale
from .hall_rasters import tile_grid

Entities = Iterator[tuple[str, Any]]
"""Entity paths, each with a static component or archetype of the entity."""
Columns = tuple[str, I64, Iterable[Any]]
"""Entity path, steps of its rows, (T,), and columns of Rerun with a row for each of these steps."""


class Pictures(Protocol):
    """Pictures of one data center in a recording. Paths are below that of the data center."""

    @property
    def size_bytes(self) -> int:
        """Size of the frames that ``take`` returns, in bytes."""

    def add(self, result: StepResult, active: Sequence[ActiveEvent]) -> None:
        """Add frames of a step, if any are due.

        Args:
            result: result of the step.
            active: events of the data center that are active in the step.
        """

    def entities(self, scales: Mapping[str, ColourScale]) -> Entities:
        """Yield the static entities.

        Args:
            scales: colour scales of the heat maps, keyed by quantity.
        """

    def take(self, scales: Mapping[str, ColourScale]) -> Iterator[Columns]:
        """Yield the columns of all frames that have not been written, and forget the frames.

        Args:
            scales: colour scales of the heat maps, keyed by quantity.
        """


T = TypeVar("T")


class Frames(Generic[T]):
    """Frames of a picture that wait to be written."""

    def __init__(self) -> None:
        self._frames: list[tuple[int, T]] = []

    def __len__(self) -> int:
        return len(self._frames)

    def append(self, step: int, frame: T) -> None:
        """Add the frame of a step, counted from 0 at reset."""
        self._frames.append((step, frame))

    def take(self) -> tuple[I64, list[T]]:
        """Return the steps of all frames, (T,), and the frames, and begin anew."""
        frames, self._frames = self._frames, []
        return np.array([step for step, _ in frames], np.int64), [frame for _, frame in frames]


def class_image(hall: HallConfig, datatype: Literal["U8", "U16"]) -> Any:
    """Return the static components of an image of the classes of racks, with a pixel per rack.

    The image covers the tiles of the heat maps.
    """
    grid = tile_grid(hall)
    pixel = grid.tile_width + grid.gap, grid.tile_height + grid.gap
    return placed(class_format((hall.rows, hall.racks_per_row), datatype), scale=pixel)


def placed(
    image: Any, *, scale: tuple[float, float], at: tuple[float, float] = (0.0, 0.0)
) -> list[Any]:
    """Return the components of an image with its scale and its place in the views, x and y.

    Args:
        image: components of the image.
        scale: size of a pixel of the image, in pixels of the heat maps.
        at: first corner of the image, in pixels of the heat maps.
    """
    transform = rr.Transform3D(translation=(*at, 0.0), scale=(*scale, 1.0))
    return [*image.as_component_batches(), *transform.as_component_batches()]


def class_format(shape: tuple[int, int], datatype: Literal["U8", "U16"] = "U8") -> Any:
    """Return Rerun's description of opaque images of classes of a height and width in pixels."""
    height, width = shape
    return rr.SegmentationImage.from_fields(
        format=rr.components.ImageFormat(
            width=width, height=height, color_model="L", channel_datatype=datatype
        ),
        opacity=1.0,
    )


def rgb(colour: int) -> tuple[int, int, int]:
    """Return red, green and blue of a colour 0xRRGGBBAA, 0..255 each."""
    return colour >> 24, colour >> 16 & 0xFF, colour >> 8 & 0xFF


def rack_pixels(hall: HallConfig, racks: I64) -> F64:
    """Return the middle of racks in the heat maps, x and y in pixels, (n, 2).

    Args:
        hall: config of the hall.
        racks: indices of the racks in the hall, (n,).
    """
    grid = tile_grid(hall)
    row, place = np.divmod(racks, hall.racks_per_row)
    x = place * (grid.tile_width + grid.gap) + grid.tile_width / 2.0
    y = row * (grid.tile_height + grid.gap) + grid.tile_height / 2.0
    return np.stack([x, y], axis=1)
