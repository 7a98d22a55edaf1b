"""A fit begins where the prior does; the prior stays; the networks move if they may."""

import pytest
import torch

from tests.neumatex.object_factory import write_object
from unmix_plugin.engine import PipelineConfig
from unmix_plugin.neumatex.datamanager import ObjectDataManagerConfig
from unmix_plugin.neumatex.model import NeumatexModelConfig


@pytest.mark.parametrize("fit_networks", [False, True])
def test_a_fit_begins_at_the_prior_which_stays_as_it_is(tmp_path, fit_networks):
    folder = write_object(tmp_path / "ball")
    settings = NeumatexModelConfig(
        material="pbr", prior="small", fit_networks=fit_networks, samples=2, plane_resolution=32
    )
    pixels = ObjectDataManagerConfig(train_num_rays_per_batch=64)
    pipeline = PipelineConfig(datamanager=pixels, model=settings).setup(
        data=folder, device=torch.device("cpu")
    )
    pipeline.initialise()
    groups = pipeline.get_param_groups()
    assert bool(groups["networks"]) is fit_networks
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
    assert "triplane.planes" in moved
    assert (len(moved) > 1) is fit_networks
    assert all(name.startswith("triplane.") for name in moved)
