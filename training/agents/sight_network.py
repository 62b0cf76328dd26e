"""Network that predicts the success of movements from what a sensor sees.

The readings are an image of one row or several. A convolutional network turns each pixel into features, which may hold
what usually stands behind such a front. A movement is a set of places of the arm's spheres. Inputs of one network for
all places are the features of the pixel in whose direction a place lies, its distance, and its depth behind the surface
(an implicit decoder, as in L. Mescheder et al., Occupancy networks, 2019). The greatest and the mean of its outputs
(C. R. Qi et al., PointNet, 2017), and the clearance that is computed with a belief, tell the logit of success.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import minimum_filter
from torch import Tensor, nn
from torch.nn import functional

from viapoint.envs.common.types import Single
from viapoint.envs.sensors import Sensor
from viapoint.envs.task import Task
from viapoint.training.planning.beliefs import Sight
from viapoint.training.planning.places import OUT_OF_VIEW, instants_of, places_of
from viapoint.training.planning.problem import Numbers, Problem, moves_of, worth_of
from viapoint.training.planning.search import plan_clearances

DEEP, SHALLOW = 0.4, 0.05  # Depths behind a surface at which two of the inputs saturate, [m]
# Pixels in whose square a place is compared with the nearest surface, to find the places that matter
NEIGHBOURS = 7
CLEAR = 0.05  # Clearance at which its input saturates, [m]
FEATURES = 9  # Inputs of a place besides the features of its pixel


class SightInputs(NamedTuple):
    """Inputs of the network for H movements in each of B scenes."""

    # Ranges relative to the greatest, hits, and places of the pixels in the image, shape (B, 4, rows, columns)
    image: Tensor
    pixel: Tensor  # Pixels in whose direction P places lie, shape (B, H, P), int64
    places: Tensor  # Other inputs of these places, shape (B, H, P, FEATURES)
    plans: Tensor  # Inputs of whole movements: clearance by the belief, reach, shape (B, H, 2)

    def take(self, chosen: Tensor) -> SightInputs:
        """Return the inputs of some of the movements, by indices of shape (B, h)."""
        scenes = torch.arange(len(chosen), device=chosen.device)[:, None]
        return SightInputs(
            self.image, self.pixel[scenes, chosen], self.places[scenes, chosen], self.plans[scenes, chosen]
        )

    def to(self, device: torch.device) -> SightInputs:
        """Return the same inputs on a device."""
        return SightInputs(*(each.to(device) for each in self))


def sight_inputs(
    task: Task, problem: Problem, sight: Sight, actions: Numbers, instants: int, nearest: int
) -> tuple[SightInputs, Single]:
    """Return the inputs of the network for actions, shape (B, H, m), and the rewards of those that succeed, (B, H).

    The problems have the obstacles that are believed to be there. Of all places at some instants, the network sees the
    ones that are nearest to surfaces, or deepest behind them.
    """
    sensor = task.sensor
    assert sensor is not None
    moves = moves_of(task, problem, actions)
    places = places_of(task, problem, moves, sight, instants_of(task, instants))
    number, plans = moves.duration.shape
    depth = places.depth(sight).reshape(number, plans, -1)
    pixel = places.ray.reshape(number, plans, -1)
    radius = np.broadcast_to(places.radius, places.ray.shape).reshape(number, plans, -1)
    distance = places.distance.reshape(number, plans, -1)
    # A place matters if it is behind, or hardly before, one of the surfaces around its pixel.
    around = _nearest_around(sensor, sight)
    beyond = np.take_along_axis(around, np.maximum(pixel, 0).reshape(number, -1), axis=1)
    beyond = distance + radius - beyond.reshape(distance.shape)
    beyond = np.where(pixel == OUT_OF_VIEW, -SHALLOW, beyond)
    nearest = min(nearest, beyond.shape[-1])
    some = np.argpartition(-beyond, nearest - 1, axis=-1)[..., :nearest]

    def chosen(values: Any) -> Any:
        return np.take_along_axis(values, some, axis=-1)

    centre = places.centre.reshape(number, plans, -1, 3)
    centre = np.take_along_axis(centre, some[..., None], axis=2)
    depth, pixel = chosen(depth), chosen(pixel)
    inputs = (
        chosen(distance),
        np.clip(depth, -DEEP, DEEP) / DEEP,
        np.clip(depth, -SHALLOW, SHALLOW) / SHALLOW,
        np.clip(chosen(beyond), -SHALLOW, SHALLOW) / SHALLOW,
        20.0 * chosen(radius),
        pixel == OUT_OF_VIEW,
        *np.moveaxis(centre, -1, 0),
    )
    clearance = plan_clearances(task, problem, actions, CLEAR, -CLEAR)
    plans_in = np.stack((np.clip(clearance / CLEAR, -1.0, 1.0), places.inside), axis=-1)
    found = SightInputs(
        _image(sensor, sight),
        torch.from_numpy(np.maximum(pixel, 0).astype(np.int64)),
        torch.from_numpy(np.stack(inputs, axis=-1).astype(np.float32)),
        torch.from_numpy(plans_in.astype(np.float32)),
    )
    return found, worth_of(task, problem, moves).astype(np.float32)


def _nearest_around(sensor: Sensor, sight: Sight) -> Single:
    """Return the least range around each pixel, shape (B, R), [m]."""
    image = sight.ranges.reshape(-1, sensor.rows, sensor.columns)
    size = 1, min(NEIGHBOURS, sensor.rows), NEIGHBOURS
    return np.asarray(minimum_filter(image, size, mode="nearest").reshape(sight.ranges.shape))


def _image(sensor: Sensor, sight: Sight) -> Tensor:
    """Return the readings as an image, see :class:`SightInputs`."""
    shape = len(sight.ranges), sensor.rows, sensor.columns
    row, column = np.meshgrid(
        np.linspace(-1.0, 1.0, sensor.rows), np.linspace(-1.0, 1.0, sensor.columns), indexing="ij"
    )
    channels = (
        sight.ranges.reshape(shape) / sensor.range,
        sight.hit.reshape(shape),
        np.broadcast_to(row, shape),
        np.broadcast_to(column, shape),
    )
    return torch.from_numpy(np.stack(channels, axis=1).astype(np.float32))


class SightNetwork(nn.Module):
    """Network of the logit of success; `width` is the number of features of a pixel, and of outputs of a place."""

    DILATIONS = (2, 4, 8, 1)

    def __init__(self, sensor: Sensor, *, width: int) -> None:
        super().__init__()
        self.columns = sensor.columns
        self.stride = 1 if sensor.rows == 1 else 2
        size = (1, 5) if sensor.rows == 1 else (3, 3)
        margin = size[0] // 2, size[1] // 2
        self.first = nn.Conv2d(4, width, size, padding=margin, stride=self.stride)
        layers = []
        for dilation in self.DILATIONS:
            padding = margin[0] * dilation, margin[1] * dilation
            layers.append(nn.Conv2d(width, width, size, padding=padding, dilation=dilation))
        self.layers = nn.ModuleList(layers)
        # The first layer for places is a sum of two: that of the pixels is computed once for each pixel.
        self.of_pixel = nn.Conv2d(width, 2 * width, 1)
        self.of_place = nn.Linear(FEATURES, 2 * width, bias=False)
        self.each = nn.Sequential(nn.ReLU(), nn.Linear(2 * width, width), nn.ReLU())
        self.last = nn.Sequential(nn.Linear(2 * width + 2, 2 * width), nn.ReLU(), nn.Linear(2 * width, 1))
        self.calibration: Tensor
        self.register_buffer("calibration", torch.tensor([1.0, 0.0]))
        """Slope and offset of the logit of the plan that is chosen; it is the best of many, and its logit too high."""

    def forward(self, inputs: SightInputs) -> Tensor:
        """Return the logits of success, shape (B, H)."""
        image = functional.relu(self.first(inputs.image))
        for layer in self.layers:
            image = image + functional.relu(layer(image))
        image = self.of_pixel(image)
        columns = image.shape[-1]
        features = image.flatten(2).transpose(1, 2)  # (B, pixels, features)
        row = inputs.pixel // self.columns
        column = inputs.pixel % self.columns
        pixel = (row // self.stride) * columns + column // self.stride
        first = torch.arange(len(pixel), device=pixel.device)[:, None, None] * features.shape[1]
        there = functional.embedding(first + pixel, features.flatten(0, 1))
        hidden = self.each(there + self.of_place(inputs.places))
        pooled = torch.cat((hidden.amax(dim=2), hidden.mean(dim=2), inputs.plans), dim=-1)
        logits: Tensor = self.last(pooled)[..., 0]
        return logits
