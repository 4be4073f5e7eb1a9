"""Reads recordings back, for tests."""

from __future__ import annotations

import os
import subprocess
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.cli.view import viewer_program

VIEWER_ENVIRONMENT = {"RERUN_ANALYTICS": "0", "RUST_LOG": "error"}


def read(path: Path) -> dict[str, dict[str, list[Any]]]:
    """Every entity's columns over the whole recording, in order of step; static ones too."""
    from rerun.chunk import RrdReader

    parts: dict[str, dict[str, list[Any]]] = {}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RRD file has no footer")  # of recordings cut short
        chunks = RrdReader(path).stream().to_chunks()
    for chunk in chunks:
        for name, column in chunk.to_record_batch().to_pydict().items():
            parts.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(column)
    for columns in parts.values():
        if "step" in columns:
            order = np.argsort(columns["step"], kind="stable")
            for name, values in columns.items():
                if len(values) == len(order):
                    columns[name] = [values[i] for i in order]
    return parts


def scalars(entity: dict[str, list[Any]]) -> npt.NDArray[np.float64]:
    """Lines of an entity, (T, lines)."""
    return np.array(entity["Scalars:scalars"], dtype=np.float64)


def classes(entity: dict[str, list[Any]]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint32]]:
    """Value and colour of every class of a map or a colour bar; class 0 has no value."""
    context = entity["AnnotationContext:context"][-1][0]  # the latest counts
    infos = [entry["class_description"]["info"] for entry in context]
    assert [info["id"] for info in infos] == list(range(len(infos)))
    values = [float(info["label"].split()[0]) for info in infos[1:]]
    return np.array([np.nan, *values]), np.array([info["color"] for info in infos], np.uint32)


def images(entity: dict[str, list[Any]]) -> npt.NDArray[np.float64]:
    """Values of a map's pixels, as the labels of their classes say them, (T, height, width)."""
    (((form,),)) = entity["SegmentationImage:format"]
    shape = form["height"], form["width"]
    raw = [bytes(buffer) for (buffer,) in entity["SegmentationImage:buffer"]]
    values, _ = classes(entity)
    return values.take(np.array([np.frombuffer(x, np.uint8).reshape(shape) for x in raw]))


def voxels(entity: dict[str, list[Any]]) -> npt.NDArray[np.uint32]:
    """Colours of an entity's voxels, (T, voxels)."""
    return np.array(entity["VoxelGridMap:colors"], dtype=np.uint32)


def texts(entity: dict[str, list[Any]]) -> list[str]:
    """Lines of a log."""
    return [text for (text,) in entity["TextLog:text"]]


def verify(path: Path) -> subprocess.CompletedProcess[str]:
    """What Rerun's own check says."""
    return subprocess.run(
        [viewer_program(), "rrd", "verify", path],
        env={**os.environ, **VIEWER_ENVIRONMENT},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
