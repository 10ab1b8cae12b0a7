"""Fits the factors of a world to a recording of the robot."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from . import _harness
from ._arguments import name_tuple

if TYPE_CHECKING:
    from numpy.typing import NDArray


__all__ = ["Fit", "fit_world"]


STEP = 0.01
"""The step of finite differences, in parts of a factor. With contacts, errors change irregularly over much smaller steps."""


class Fit(NamedTuple):
    """Factors of a world that were fitted to a recording."""

    factors: dict[str, float]
    """The fitted values, as `harness judge SPEC simulator --world WORLD --factor NAME=VALUE` takes them."""
    before: float
    """Root mean squared error of the training episodes without factors, in standard deviations of each element."""
    after: float
    """The same with the fitted values."""
    at_bounds: tuple[str, ...]
    """The factors whose values are at an end of their range in the world file. A wider range may fit better."""


def fit_world(
    dataset: str,
    world: str | Path,
    factors: str | Sequence[str],
    output: str | Sequence[str],
    *,
    results: str | Path = "results",
) -> Fit:
    """Fits factors of a world, such as a stiffness, so that it repeats a recording.

    The actuators of the world go through the setpoints of the training episodes. The squared errors of the outputs are
    minimized with `mujoco.minimize.least_squares`, within the ranges that the world file gives the factors. The test
    episodes are not used.

    Args:
        dataset: the name of the dataset, or its beginning.
        world: the name of a built-in world, or the path of a world file.
        factors: the factors of variation to fit. Each has one value for all of its elements.
        output: the modalities that the world should repeat.
        results: the results folder.

    Raises:
        ValueError: if no factor or output is given, the world lacks one, or it moves by other setpoints.
        RuntimeError: if the dataset can't be read, or a simulation diverges.
    """
    from mujoco import minimize  # noqa: PLC0415, because it takes a second

    names, outputs = name_tuple(factors), name_tuple(output)
    for what, given in (("factors", names), ("output", outputs)):
        if not given or len(set(given)) < len(given):
            raise ValueError(f"{what}: name at least one, and each once; found {', '.join(given) or 'none'}")
    replays = _harness.Replays(Path(results) / "datasets", dataset, str(world), list(outputs))
    ranges = replays.ranges()
    if unknown := [name for name in names if name not in ranges]:
        raise ValueError(f"the world has no factor '{unknown[0]}'; it has {', '.join(ranges) or 'none'}")
    low, high = (np.array([ranges[name][end] for name in names]) for end in (0, 1))
    # A factor that scales is fitted by its logarithm, because a half is as far from 1 as a double.
    scales = low > 0
    start = np.clip(np.where(scales, 1.0, 0.0), low, high)

    def inner(values: "NDArray[np.float64]") -> "NDArray[np.float64]":
        return np.where(scales, np.log(np.where(scales, values, 1.0)), values)

    def outer(values: "NDArray[np.float64]") -> "NDArray[np.float64]":
        return np.clip(np.where(scales, np.exp(np.where(scales, values, 0.0)), values), low, high)

    def errors(values: "NDArray[np.float64]") -> "NDArray[np.float64]":
        return replays.errors(dict(zip(names, map(float, values), strict=True)))

    def residuals(points: "NDArray[np.float64]") -> "NDArray[np.float64]":
        return np.stack([errors(outer(point)) for point in points.T], axis=1)

    fitted, _ = minimize.least_squares(
        inner(start), residuals, bounds=[inner(low), inner(high)], eps=STEP, verbose=minimize.Verbosity.SILENT
    )
    values = outer(np.asarray(fitted).ravel())
    at_bounds = np.isclose(values, low, rtol=1e-3) | np.isclose(values, high, rtol=1e-3)
    return Fit(
        factors=dict(zip(names, map(float, values), strict=True)),
        before=_root_mean_square(replays.errors({})),
        after=_root_mean_square(errors(values)),
        at_bounds=tuple(name for name, is_at in zip(names, at_bounds, strict=True) if is_at),
    )


def _root_mean_square(errors: "NDArray[np.float64]") -> float:
    return float(np.sqrt(np.mean(errors**2)))
