"""The interface between data on disk and training: rays with what was measured along them."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from unmix_plugin.engine.configs import DataManagerConfig
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.engine.training.callbacks import TrainingCallback


class DataManager(ABC):
    """Reads one scene and serves batches of it.

    Sampling is a pure function of (seed, step): a step makes its own generator with `step_generator(seed, step)`, so
    that a resumed run sees the batches of a straight one.

    A batch is a dictionary of tensors with one row a ray (`next_train`), or with leading axes (height, width) for a
    whole image (`eval_image`).
    """

    train_cameras: Cameras
    """Cameras of the training views, model space."""
    eval_cameras: Cameras
    """Cameras of the evaluation views, model space."""
    scene_box: SceneBox
    """What the scene fits in, model space."""

    def __init__(self, config: DataManagerConfig, *, data: Path, device: torch.device, seed: int = 0) -> None:
        """Keep what every data manager needs; subclasses then read `data` and set cameras and scene box.

        Raises:
            SceneError: the scene is missing or malformed (raised by subclasses).
        """
        self.config = config
        self.data = data
        self.device = device
        self.seed = seed

    @abstractmethod
    def next_train(self, step: int) -> tuple[RayBundle, dict[str, Tensor]]:
        """Rays of training step `step` and what was measured along them."""

    @abstractmethod
    def eval_image(self, index: int) -> tuple[Cameras, dict[str, Tensor]]:
        """Camera (one) and whole image of evaluation view `index`."""

    @abstractmethod
    def get_train_rays_per_batch(self) -> int:
        """Rays that the next training batch will have."""

    @abstractmethod
    def set_train_rays_per_batch(self, num_rays: int) -> None:
        """Let the next training batches have `num_rays` rays."""

    @property
    def num_eval_images(self) -> int:
        """Number of images to evaluate on: the evaluation views, and after them others that a method may have, such as
        the same object under another light."""
        return len(self.eval_cameras)

    def eval_name(self, index: int) -> str:
        """Name of evaluation image `index`, unique and fit for file names."""
        summary = self.summary()
        frames, indices = summary.get("frames"), summary.get("eval_indices")
        if isinstance(frames, list) and isinstance(indices, list) and index < len(indices):
            return str(frames[indices[index]])
        return f"eval_{index:03d}"

    def metadata(self) -> dict[str, Any]:
        """What gives the model its shape beyond its config (say, the bands); kept in the run folder as JSON.

        Only dictionaries with string keys, lists, strings, finite numbers, booleans and None. Arrays that fill
        parameters belong in `initial_data`.
        """
        return {}

    def initial_data(self) -> Mapping[str, np.ndarray]:
        """Arrays from which a new model takes its first parameter values; read once when a run starts, never when
        one is loaded, since by then the values are in the checkpoint."""
        return {}

    def summary(self) -> dict[str, Any]:
        """What a person or a later command may ask about the scene (splits, normalisation, hashes); JSON like
        `metadata`, kept in the run folder."""
        return {}

    @classmethod  # noqa: B027
    def check_record(cls, metadata: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Refuse a `metadata` or `summary` read from a run folder that this class can't have written.

        Raises:
            KeyError, TypeError, ValueError, ConfigError: what is missing or wrong.
        """

    def warnings(self) -> list[str]:
        """What looks wrong with the data though it can be trained on; asked once, when a new run starts."""
        return []

    def identity(self, summary: Mapping[str, Any]) -> dict[str, Any]:
        """What of a `summary` makes it this scene and no other: compared, numbers with a tolerance, when a run is
        resumed or evaluated."""
        return {}

    def state_dict(self) -> dict[str, Tensor]:
        """What a resumed run needs beyond (seed, step) and the rays per batch; usually nothing."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:  # noqa: B027
        """Restore what `state_dict` gave."""

    def get_training_callbacks(self) -> list[TrainingCallback]:
        """Functions to call around each step."""
        return []
