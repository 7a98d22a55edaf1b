"""With a prior only the planes move, and the fit begins where the prior does."""

import torch

from tests.neumatex.object_factory import write_object
from unmix_plugin.engine import PipelineConfig
from unmix_plugin.neumatex.datamanager import ObjectDataManagerConfig
from unmix_plugin.neumatex.model import NeumatexModelConfig


def test_a_fit_begins_at_the_prior_and_only_its_planes_are_fitted(tmp_path):
    folder = write_object(tmp_path / "ball")
    settings = NeumatexModelConfig(material="pbr", prior="small", samples=2, plane_resolution=32)
    pixels = ObjectDataManagerConfig(train_num_rays_per_batch=64)
    pipeline = PipelineConfig(datamanager=pixels, model=settings).setup(
        data=folder, device=torch.device("cpu")
    )
    pipeline.initialise()
    groups = pipeline.get_param_groups()
    assert [len(groups[name]) for name in ("planes", "networks", "response")] == [1, 0, 0]
    pipeline.train()
    pipeline.seed_step(0)
    _, losses, _ = pipeline.get_train_loss_dict(0)
    assert float(losses["prior"].detach()) == 0
    with torch.no_grad():
        pipeline.model.triplane.planes += 0.1
    _, losses, _ = pipeline.get_train_loss_dict(0)
    assert float(losses["prior"].detach()) > 0
    torch.stack(list(losses.values())).sum().backward()
    moved = {name for name, parameter in pipeline.model.named_parameters() if parameter.grad is not None}
    assert moved == {"triplane.planes"}
